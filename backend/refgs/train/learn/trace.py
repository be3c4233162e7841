"""Trace inter-reflection on a mesh made from the surfels."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from refgs.errors import InputError
from refgs.formats.mesh import Mesh
from refgs.geometry.mesh import clean
from refgs.geometry.visibility import Occluder
from refgs.memory import trim
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.extract import extract
from refgs.render.relight import received
from refgs.render.rendering import SOLID
from refgs.render.volume import with_normals_last
from refgs.train.part import Fact, Part
from refgs.train.state import State, why_not_traced
from refgs.train.timeline import Step

MESH_VIEWS = 24  # views from which the mesh is fused, at least; all, if there are fewer


class TracedMesh(Part):
    """Keep `state.occluder`, the mesh on which inter-reflection is traced, in checkpoints."""

    name = "occluder"

    def facts(self, state: State) -> dict[str, Fact]:
        if state.occluder is None:
            return {}
        mesh = state.occluder.mesh
        return {"vertices": torch.from_numpy(mesh.vertices), "faces": torch.from_numpy(mesh.faces.astype(np.int32))}

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        state.occluder = None
        if facts and not why_not_traced(state):
            state.occluder = Occluder(Mesh(*(facts[name].numpy(force=True) for name in ("vertices", "faces"))))


@torch.no_grad()
def mesh_of(state: State, surfels: Surfels) -> Occluder | None:
    """Make a mesh of `surfels`, on which rays are traced. Return None if there is no surface yet."""
    trim()  # free memory for the depth maps of all cameras
    capture, cameras = state.capture, state.spread_cameras(MESH_VIEWS)
    with state.clock.part("mesh"):
        side = state.settings.indirect.resolution
        mesh, _ = extract(surfels, cameras, state.near, capture.centre, capture.radius, side)
        try:
            return Occluder(clean(mesh, triangles=len(mesh.faces)))
        except InputError:
            return None


@torch.no_grad()
def make_mesh(state: State, step: Step) -> None:
    """Make the mesh `state.occluder`, and `step.hidden`, the fraction of pixels that mirror the object."""
    if why_not_traced(state):
        return
    with state.clock.part("visibility"):
        cameras = state.spread_cameras(MESH_VIEWS)
        state.occluder = None
        inputs = state.inputs()
        inside = inputs.surfels.chosen(state.wanted())
        state.occluder = mesh_of(state, inside)
        if state.occluder is None:
            return
        inputs, hidden, solid = inputs._replace(surfels=inside, occluder=state.occluder), 0.0, 1e-9
        for camera in cameras[::3]:
            seen = state.picture(inputs, camera)
            opaque = seen.alpha > SOLID
            hidden += float((1 - seen.visibility)[opaque].sum()) if seen.visibility is not None else 0.0
            solid += float(opaque.sum())
        step.hidden = hidden / solid
        if not state.learned.has_learned("indirect_dc"):
            # Start from the light that the surfels mirrored until now, so that the picture changes little.
            start, rest = inputs.light.harmonics, state.learned["indirect_rest"]
            state.learned["indirect_dc"][:], rest[:] = start[:1], start[1 : 1 + rest.shape[1]]


@torch.no_grad()
def trace_received(state: State, step: Step) -> None:
    """Trace each surfel's `received`: its irradiance relative to that of an unoccluded surface."""
    if state.occluder is None or "received" not in state.learned:
        return
    traced = Surfels(*(value.cpu() for value in with_normals_last(state.surfels())))
    # In the world's frame: nothing is traced if the light turns with the camera.
    light = Environment(state.inputs().light.radiance.cpu())
    state.learned["received"][:] = received(traced, state.occluder, light)
