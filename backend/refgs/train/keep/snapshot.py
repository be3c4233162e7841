"""Save and restore the state of a training: everything that the next iteration depends on."""

from pathlib import Path

import numpy as np
import torch

from refgs.errors import InputError
from refgs.formats.checkpoint import Facts
from refgs.formats.mesh import Mesh
from refgs.formats.validate import validated
from refgs.geometry.visibility import Occluder
from refgs.train.decide import needs
from refgs.train.keep import checkpoint
from refgs.train.learn import coarse, poses
from refgs.train.state import State, why_not_traced


def save(state: State) -> None:
    """Write a checkpoint into the run folder."""
    tensors = state.learned.save()
    tensors |= {"motion.total": state.motion.total, "motion.views": state.motion.views}
    if state.poses is not None:
        tensors |= {"poses": state.poses}
    if state.light_shown is not None:
        tensors |= {"mirrored": state.light_shown}
    if state.occluder is not None:
        mesh = state.occluder.mesh
        tensors |= {"occluder.vertices": torch.from_numpy(mesh.vertices)}
        tensors |= {"occluder.faces": torch.from_numpy(mesh.faces.astype(np.int32))}
    facts = {"seconds": state.seconds, "total": state.total, "initial": state.initial, "decided": state.decided}
    facts |= {"parts": state.clock.seconds, "spent": state.plan.spent}
    facts |= {"processor_seconds": state.processor_seconds, "needs": state.needs, "metals_set": state.metals_set}
    facts |= {"poses_judged": state.poses_judged, "reduced": state.reduced.factor if state.reduced else 1}
    checkpoint.save(state.folder / "checkpoints", state.iteration, tensors, facts)


def restore(state: State, run: Path) -> None:
    """Take over the last complete checkpoint of a run that is not damaged.

    Raises `checkpoint.NoCheckpoint` if there is none, and InputError if another release of RefGS wrote it.
    """
    tensors, tables = checkpoint.load(run / "checkpoints", state.report)
    facts = validated(tables, Facts, str(run / "checkpoints"), "Train again into a new folder.")
    _check_tensors(tensors, run)
    state.total = facts.total
    needs.restore(state, {name: found.model_dump(exclude_unset=True) for name, found in facts.needs.items()})
    mesh = {name: tensors.pop(name).numpy() for name in list(tensors) if name.startswith("occluder.")}
    tensors = {name: value.to(state.device) for name, value in tensors.items()}
    try:
        state.learned.load(tensors)
    except KeyError:
        raise InputError(f"{run} was begun by another release of RefGS: train again into a new folder") from None
    state.iteration, state.seconds = facts.iteration, facts.seconds
    state.clock.resume(facts.parts)
    state.plan.before = state.seconds if facts.spent is None else facts.spent
    state.processor_seconds = facts.processor_seconds
    state.initial = state.initial if facts.initial is None else facts.initial
    state.metals_set, state.poses_judged = facts.metals_set, facts.poses_judged
    for about, what in facts.decided.items():
        state.announce(about, what)
    state.motion.total, state.motion.views = tensors["motion.total"], tensors["motion.views"]
    state.light_shown = tensors.get("mirrored")
    poses.restore(state, tensors["poses"].cpu() if "poses" in tensors else None)
    coarse.set_factor(state, facts.reduced)
    state.occluder = None
    if mesh and not why_not_traced(state):
        state.occluder = Occluder(Mesh(mesh["occluder.vertices"], mesh["occluder.faces"]))


def _check_tensors(tensors: dict[str, torch.Tensor], run: Path) -> None:
    """Raise InputError if tensors of a checkpoint are missing, or do not belong together: they have other rows or types."""
    fine = {"environment", "motion.total", "motion.views", "parameter.position"} <= tensors.keys()
    rows = tensors["parameter.position"].shape[:1] if fine else ()
    for name, value in tensors.items():
        kind, _, rest = name.partition(".")
        if kind in ("parameter", "constant", "motion"):
            fine &= value.shape[:1] == ((1,) if kind == "constant" else rows)
        if kind in ("parameter", "constant", "environment", "exposure"):
            fine &= value.dtype == (torch.bool if rest == "held" else torch.float32)
        if kind == "adam":
            of, _, moment = rest.rpartition(".")
            learned = tensors.get(of if of in ("environment", "exposure") else f"parameter.{of}")
            fine &= all(f"adam.{of}.{each}" in tensors for each in ("step", "exp_avg", "exp_avg_sq"))
            fine &= learned is not None and (value.numel() == 1 if moment == "step" else value.shape == learned.shape)
    if not fine:
        raise InputError(f"{run / 'checkpoints'}: the tensors of the checkpoint do not belong together: train again")
