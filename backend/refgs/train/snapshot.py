"""Save and restore the state of a training: everything that the next iteration depends on."""

from pathlib import Path

import numpy as np
import torch

from refgs.errors import InputError
from refgs.formats.mesh import Mesh
from refgs.geometry.visibility import Occluder
from refgs.train import checkpoint, coarse, needs, poses
from refgs.train.state import State, why_not_traced


def save(state: State) -> None:
    """Write a checkpoint into the run folder."""
    tensors = {f"parameter.{name}": value for name, value in state.parameters.items()}
    tensors |= {f"constant.{name}": value for name, value in state.constant.items()}
    tensors |= {
        "environment": state.light,
        "motion.total": state.motion.total,
        "motion.views": state.motion.views,
    }
    if state.exposures is not None:
        tensors |= {"exposure": state.exposures}
    if state.poses is not None:
        tensors |= {"poses": state.poses}
    if state.light_shown is not None:
        tensors |= {"mirrored": state.light_shown}
    if state.occluder is not None:
        mesh = state.occluder.mesh
        tensors |= {"occluder.vertices": torch.from_numpy(mesh.vertices)}
        tensors |= {"occluder.faces": torch.from_numpy(mesh.faces.astype(np.int32))}
    for group in state.optimizer.param_groups:
        moments = state.optimizer.state.get(group["params"][0], {})
        tensors |= {f"adam.{group['name']}.{key}": torch.as_tensor(value) for key, value in moments.items()}
    facts = {"seconds": state.seconds, "total": state.total, "initial": state.initial, "decided": state.decided}
    facts |= {"parts": state.clock.seconds, "spent": state.plan.spent}
    facts |= {"processor_seconds": state.processor_seconds, "needs": state.needs, "metals_set": state.metals_set}
    facts |= {"poses_judged": state.poses_judged, "reduced": state.reduced.factor if state.reduced else 1}
    checkpoint.save(state.folder / "checkpoints", state.iteration, tensors, facts)


def restore(state: State, run: Path) -> None:
    """Take over the last complete checkpoint of a run that is not damaged.

    Raises `checkpoint.NoCheckpoint` if there is none, and InputError if another release of RefGS wrote it.
    """
    tensors, facts = checkpoint.load(run / "checkpoints", state.report)
    state.total = facts["total"]
    needs.restore(state, facts.get("needs", {}))
    for name in state.constant:  # left out after this checkpoint, where the training goes back to it
        if f"parameter.{name}" in tensors:
            tensors[f"constant.{name}"] = tensors[f"parameter.{name}"][:1]
    count = len(tensors["parameter.position"])
    for name in state.parameters:  # left out at this checkpoint, and learned again after it
        if f"parameter.{name}" not in tensors and f"constant.{name}" in tensors:
            row = tensors[f"constant.{name}"]
            tensors[f"parameter.{name}"] = row.expand(count, *row.shape[1:]).clone()
    needed = {f"parameter.{name}" for name in state.parameters} | {f"constant.{name}" for name in state.constant}
    if not needed <= tensors.keys():
        raise InputError(f"{run} was begun by another release of RefGS: train again into a new folder")
    mesh = {name: tensors.pop(name).numpy() for name in list(tensors) if name.startswith("occluder.")}
    tensors = {name: value.to(state.device) for name, value in tensors.items()}
    state.iteration, state.seconds = facts["iteration"], facts["seconds"]
    state.clock.resume(facts.get("parts", {}))
    state.plan.before = facts.get("spent", state.seconds)
    state.processor_seconds = facts.get("processor_seconds", 0.0)
    state.initial, state.metals_set = facts.get("initial", state.initial), facts.get("metals_set", True)
    state.poses_judged = facts.get("poses_judged", True)
    for about, what in facts.get("decided", {}).items():
        state.announce(about, what)
    state.motion.total, state.motion.views = tensors["motion.total"], tensors["motion.views"]
    state.optimizer.state.clear()
    if "exposure" not in tensors:
        state.without_exposures()
    for group in state.optimizer.param_groups:
        name = group["name"]
        value = tensors[name if name in ("environment", "exposure") else f"parameter.{name}"]
        value.requires_grad_()
        group["params"][0] = value
        if name == "environment":
            state.light = value
        elif name == "exposure":
            state.exposures = value
        else:
            state.parameters[name] = value
        prefix = f"adam.{name}."
        moments = {key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}
        if moments:
            state.optimizer.state[value] = moments | {"step": int(moments["step"])}
    state.light_shown = tensors.get("mirrored")
    poses.restore(state, tensors["poses"].cpu() if "poses" in tensors else None)
    coarse.set_factor(state, facts.get("reduced", 1))
    state.constant = {name: tensors[f"constant.{name}"] for name in state.constant}
    state.occluder = None
    if mesh and not why_not_traced(state):
        state.occluder = Occluder(Mesh(mesh["occluder.vertices"], mesh["occluder.faces"]))
