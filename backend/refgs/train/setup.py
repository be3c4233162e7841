"""Set up a training: load the photos, decide whether the light turns with the camera, and make the surfels and the optimiser.

Also start the second stage of a training, in which pixels are shaded instead of surfels.
"""

from pathlib import Path

import torch

from refgs.capture import Capture
from refgs.capture.light_frame import light_frame
from refgs.effective import Effective
from refgs.events import Report
from refgs.model.learned import Learned
from refgs.model.surfels import Parameters, activate
from refgs.train.decide import needs
from refgs.train.decide.object_size import limit_sizes, object_size
from refgs.train.keep.progress import Means
from refgs.train.learn import coarse, light, outlines, priors
from refgs.train.learn.coarse import Coarse
from refgs.train.learn.densify import Densification
from refgs.train.learn.exposures import EXPOSURE, Exposures
from refgs.train.learn.light import MirroredLight
from refgs.train.learn.mesh_normals import MeshNormals
from refgs.train.learn.outlines import Outlines
from refgs.train.learn.poses import Poses
from refgs.train.learn.priors import Priors
from refgs.train.learn.trace import TracedMesh
from refgs.train.material import base_colors
from refgs.train.material.changing_light import ChangingLight
from refgs.train.material.metals import Metals
from refgs.train.part import Part
from refgs.train.photo import Photo
from refgs.train.plan import SHAPES, Plan
from refgs.train.start import Start, start_appearance, start_parameters
from refgs.train.state import State, why_not_traced
from refgs.train.timeline import Step

# Time for carving the visual hull's hollows, and for finding normals by outlines, in times of the hull without hollows.
HOLLOWS, OUTLINES = 50, 2

PARTS: tuple[type[Part], ...] = (
    Metals, ChangingLight, Densification, Poses, Exposures, MirroredLight, TracedMesh, Coarse, Outlines, MeshNormals, Priors, Means,
)  # fmt: skip
"""The parts of a training that remember something, in the order in which a checkpoint restores them."""


def set_up(capture: Capture, effective: Effective, folder: Path, report: Report, plan: Plan, device: str) -> State:
    """Read a capture's photos, and make all parameters and the optimiser."""
    state = State(capture, effective, folder, report, plan, device)
    needs.evaluate(state, "photos")
    size = object_size(state)
    limit_sizes(state, size)
    state.photos = [Photo.of(view, state.device) for view in state.views]
    with state.clock.part("start"):
        start = start_parameters(capture, state.views, state.settings)
    _choose_light_frame(state, start)
    hull = state.clock.seconds["start"]
    still = state.from_hull and state.method.lit and state.settings.light.frame == "world"
    if still and plan.pays_at_start("hollows of the visual hull", HOLLOWS * hull, SHAPES):
        with state.clock.part("start"):
            start = start_parameters(capture, state.views, state.settings, hollows=True)
    report("stage", {"what": start.said, "detail": True})
    _start_learning(state, start.parameters)
    if not state.initial:
        with state.clock.part("start"):
            base_colors.start(state, start.points.positions, start.points.normals)
    state.parts = {kind: kind() for kind in PARTS}
    for part in state.parts.values():
        part.start(state)
    needs.evaluate(state, "start")
    coarse.begin(state, size.span, refined=state.part(Poses).values is not None)
    if plan.pays_at_start("normals that outlines tell", OUTLINES * hull):
        outlines.load(state, start.points.hull)
    priors.load(state)
    return state


def _choose_light_frame(state: State, start: Start) -> None:
    """If `light.frame` is "auto", decide whether the light turns with the camera."""
    lit = state.method.lit
    if state.settings.light.frame != "auto":
        return
    frame, why = "world", "there is no light" if not lit else "not every photo has a mask of the object"
    if lit and state.from_hull:
        with torch.no_grad():
            points = activate(start.parameters)
            found = points.positions[: start.on_hull].numpy(), points.normals()[: start.on_hull].numpy()
        frame, why = light_frame(state.views, *found, state.capture.radius)
    state.change("light.frame", frame, "photos", why)
    if lit:
        where = "turns with the camera" if frame == "camera" else "stands still"
        state.announce("light", f"the light {where}: {why}", detail=frame == "world")


def _start_learning(state: State, start: Parameters) -> None:
    """Start learning the surfels (from the parameters `start`), the light and the photos' exposures."""
    settings, method = state.settings, state.method
    state.learned = Learned(state.capture.radius, method.light.brightest)
    for name, value in start.items():
        state.learned.learn(name, value.to(state.device))
    texels = torch.empty(6 * light.first_resolution(settings) ** 2, 3, device=state.device)
    state.learned.learn("environment", texels.fill_(light.start_value(state)), by_row=False)
    if method.lit and settings.light.exposure != "off":
        exposures = torch.zeros(len(state.views), len(EXPOSURE), device=state.device)
        state.learned.learn("exposure", exposures, by_row=False)
    state.learned.drop(*_unused(state), *method.constants)
    for name, value in method.constants.items():
        state.learned.constant[name].fill_(value)


def _unused(state: State) -> list[str]:
    """Return the names of the surfels' parameters that do not affect this run's pictures."""
    method, diffuse = state.method, state.settings.render.diffuse
    unused = [*method.unread]
    if method.lit and diffuse == "irradiance":
        unused += ["sh_dc"] if state.residual_start < 1 else ["sh_dc", "sh_rest"]
    if why := why_not_traced(state):
        unused += ["indirect_dc", "indirect_rest"]
        if method.deferred and state.settings.indirect.start < 1:
            state.announce("reflections", f"without inter-reflection: {why}")
    if why or diffuse == "sh":
        unused += ["received"]
    return unused


def start_residual(state: State, step: Step) -> None:
    """Start to learn the residual: view-dependent colour that material and light do not explain."""
    state.residual = True


@torch.no_grad()
def start_deferred(state: State, step: Step) -> None:
    """Start the second stage of a training, deferred shading: pixels are shaded after blending. The first stage shades each surfel.

    The surfels' geometry is kept. Colours, materials and light are reset and learned anew (Ref-Gaussian paper, §3.3).
    """
    state.initial = False
    for name, row in start_appearance(state.settings).items():
        if name in state.learned:
            state.learned.fill(name, row)
    state.learned.fill("environment", light.start_value(state))
    if "exposure" in state.learned:  # exposures were learned with the earlier light
        state.learned.fill("exposure", 0.0)
    state.report("stage", {"what": "pixels are shaded now: colour, material and light start anew", "detail": True})
