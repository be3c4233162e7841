"""Trace inter-reflection on a mesh made from the surfels. For trainings that do not trace it, give the user the reason."""

import torch

from refgs.errors import InputError
from refgs.geometry.mesh import clean
from refgs.geometry.visibility import Occluder
from refgs.memory import trim
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.extract import extract
from refgs.render.relight import received
from refgs.render.volume import with_normals_last
from refgs.train.decide import needs
from refgs.train.state import State, why_not_traced
from refgs.train.timeline import faint_now

VIEWS = 24  # at least, that the mesh is fused from; all where there are fewer


def trace_due(state: State, progress: float) -> None:
    """Extract a new mesh and trace inter-reflection on it, if this iteration is scheduled for it."""
    settings = state.settings.indirect
    # Materials would no longer adapt to a mesh that is made after the residual has started to learn.
    learns = settings.start <= progress < state.residual_start
    if not learns or state.iteration % settings.every or state.initial or state.ended or faint_now(state):
        return
    if not why_not_traced(state):
        with state.clock.part("visibility"):
            _trace(state)


@torch.no_grad()
def _trace(state: State) -> None:
    """Make a new mesh from the surfels, and decide whether inter-reflection is needed.

    If it is, trace rays to find out how much the mesh shadows and lights each surfel.
    """
    capture, cameras = state.capture, state.spread_cameras(VIEWS)
    state.occluder = None
    trim()  # before the depth maps of all cameras are held
    inputs = state.inputs()
    surfels, environment = inputs.surfels, inputs.environment
    inside = surfels.chosen(state.wanted())
    with state.clock.part("mesh"):
        side = state.settings.indirect.resolution
        mesh, _ = extract(inside, cameras, state.near, capture.centre, capture.radius, side)
        try:
            state.occluder = Occluder(clean(mesh, triangles=len(mesh.faces)))
        except InputError:  # there is no surface yet
            return
    inputs, hidden, solid = inputs._replace(surfels=inside, occluder=state.occluder), 0.0, 1e-9
    for camera in cameras[::3]:
        seen = state.picture(inputs, camera)
        opaque = seen.alpha > 0.5
        hidden += float((1 - seen.visibility)[opaque].sum())
        solid += float(opaque.sum())
    if "indirect_dc" not in state.learned.moments:
        # Start from the light that the surfels mirrored until now, so that the picture changes little.
        start, rest = environment.harmonics, state.learned["indirect_rest"]
        state.learned["indirect_dc"][:], rest[:] = start[:1], start[1 : 1 + rest.shape[1]]
    with state.clock.part("deciding"):
        needs.evaluate_mesh(state, hidden / solid)
    if state.occluder is not None and "received" in state.learned:
        # Traced anew with each mesh, for light and mesh are better known by then.
        traced = Surfels(*(value.cpu() for value in with_normals_last(surfels)))
        light = Environment(environment.radiance.cpu())  # in the world's frame: in the camera's nothing is traced
        state.learned["received"][:] = received(traced, state.occluder, light)
