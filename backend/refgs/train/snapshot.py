"""A trainer's state as a checkpoint: everything that the next iteration depends on."""

from typing import TYPE_CHECKING

import numpy as np
import torch

from refgs.errors import InputError
from refgs.formats.mesh import Mesh
from refgs.geometry.visibility import Occluder
from refgs.train import checkpoint, needs

if TYPE_CHECKING:
    from refgs.train.trainer import Trainer


def save(trainer: "Trainer") -> None:
    """Write a checkpoint into the run folder."""
    tensors = {f"parameter.{name}": value for name, value in trainer.parameters.items()}
    tensors |= {f"constant.{name}": value for name, value in trainer.constant.items()}
    tensors |= {
        "environment": trainer.light,
        "motion.total": trainer.motion.total,
        "motion.views": trainer.motion.views,
    }
    if trainer.exposures is not None:
        tensors |= {"exposure": trainer.exposures}
    if trainer.light_shown is not None:
        tensors |= {"mirrored": trainer.light_shown}
    if trainer.occluder is not None:
        mesh = trainer.occluder.mesh
        tensors |= {"occluder.vertices": torch.from_numpy(mesh.vertices)}
        tensors |= {"occluder.faces": torch.from_numpy(mesh.faces.astype(np.int32))}
    for group in trainer.optimizer.param_groups:
        state = trainer.optimizer.state.get(group["params"][0], {})
        tensors |= {f"adam.{group['name']}.{key}": torch.as_tensor(value) for key, value in state.items()}
    facts = {"seconds": trainer.seconds, "total": trainer.total, "initial": trainer.initial, "decided": trainer.decided}
    facts |= {"parts": trainer.clock.seconds, "spent": trainer.plan.spent}
    facts |= {"processor_seconds": trainer.processor_seconds, "needs": trainer.needs}
    checkpoint.save(trainer.folder / "checkpoints", trainer.iteration, tensors, facts)


def restore(trainer: "Trainer") -> None:
    """Go back to the last complete checkpoint. Raises InputError where there is none, or it was written by another release."""
    tensors, facts = checkpoint.load(trainer.folder / "checkpoints")
    # What was decided since, where the training has gone back, stays.
    trainer.needs = facts.get("needs", {}) | trainer.needs
    trainer.total = facts["total"]
    for name in trainer.needs:
        needs.apply(trainer, name)
    for name in trainer.constant:  # left out since, where the training has gone back
        if f"parameter.{name}" in tensors:
            tensors[f"constant.{name}"] = tensors[f"parameter.{name}"][:1]
    needed = {f"parameter.{name}" for name in trainer.parameters} | {f"constant.{name}" for name in trainer.constant}
    if not needed <= tensors.keys():
        raise InputError(f"{trainer.folder} was begun by another release of RefGS: train again into a new folder")
    mesh = {name: tensors.pop(name).numpy() for name in list(tensors) if name.startswith("occluder.")}
    tensors = {name: value.to(trainer.device) for name, value in tensors.items()}
    trainer.iteration, trainer.seconds = facts["iteration"], facts["seconds"]
    trainer.clock.resume(facts.get("parts", {}))
    trainer.plan.before = facts.get("spent", trainer.seconds)
    trainer.processor_seconds = facts.get("processor_seconds", 0.0)
    trainer.initial = facts.get("initial", trainer.initial)
    for about, what in facts.get("decided", {}).items():
        trainer.decide(about, what)
    trainer.motion.total, trainer.motion.views = tensors["motion.total"], tensors["motion.views"]
    trainer.optimizer.state.clear()
    if "exposure" not in tensors:  # they have been left out since
        trainer.exposures = None
        trainer.optimizer.param_groups = [g for g in trainer.optimizer.param_groups if g["name"] != "exposure"]
    for group in trainer.optimizer.param_groups:
        name = group["name"]
        value = tensors[name if name in ("environment", "exposure") else f"parameter.{name}"]
        value.requires_grad_()
        group["params"][0] = value
        if name == "environment":
            trainer.light = value
        elif name == "exposure":
            trainer.exposures = value
        else:
            trainer.parameters[name] = value
        prefix = f"adam.{name}."
        state = {key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}
        if state:
            trainer.optimizer.state[value] = state | {"step": int(state["step"])}
    trainer.light_shown = tensors.get("mirrored")
    trainer.constant = {name: tensors[f"constant.{name}"] for name in trainer.constant}
    trainer.occluder = None
    if mesh and not trainer.without_reflection():
        trainer.occluder = Occluder(Mesh(mesh["occluder.vertices"], mesh["occluder.faces"]))
