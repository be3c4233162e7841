"""Hold the state of a training: the capture, the parameters that it learns, and the decisions that it has made."""

from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.capture import Capture, load_views
from refgs.clock import Clock
from refgs.effective import By, Effective
from refgs.events import Report
from refgs.formats.needs import Found
from refgs.geometry.visibility import Occluder
from refgs.model.environment import Environment
from refgs.model.learned import Learned
from refgs.model.surfels import Surfels, activate
from refgs.render.baselines import Method, initial_stage, method_of
from refgs.render.renderer import Rendering, near_plane, render
from refgs.run_folder import PHOTOS
from refgs.settings import LossSettings, RenderSettings, Settings
from refgs.train.photo import Crop, Photo
from refgs.train.plan import Plan

P = TypeVar("P")


class RenderInputs(NamedTuple):
    """Hold everything that a picture is rendered from, except the camera and the camera's exposure."""

    surfels: Surfels
    environment: Environment | None
    settings: RenderSettings
    occluder: Occluder | None

    @property
    def light(self) -> Environment:
        """Return the environment's light. Raises ValueError if the rendering method uses none."""
        if self.environment is None:
            raise ValueError("this rendering method uses no light")
        return self.environment


class Lines(dict[str, str]):
    """Hold lines for the artist by what was decided. `details` are the topics whose lines only the log has."""

    def __init__(self):
        super().__init__()
        self.details: set[str] = set()


class State:
    """Hold the state of a training: the capture, what it learns, and the decisions that it has made.

    The constructor only reads the photos; `train/setup.py` makes the surfels, and `train/trainer.py` trains them. A fact that only one
    module of the training needs is in that module's own `Part` object, which `part` returns.
    """

    def __init__(
        self, capture: Capture, effective: Effective, folder: Path, report: Report, plan: Plan, device: str
    ) -> None:
        self.capture, self.effective, self.folder, self.report = capture, effective, folder, report
        self.device = torch.device(device)
        self.background = torch.tensor(self.settings.image.background, device=self.device)
        self.clock, self.plan = Clock(self.device), plan
        with self.clock.part("reading"):
            views = [*capture.train_views, *capture.test_views]
            loaded = load_views(views, self.settings.image.max_side, folder / PHOTOS)
            self.views, self.test = loaded[: len(capture.train_views)], loaded[len(capture.train_views) :]
        self.photos: list[Photo] = []  # photos of `views`
        self.crops: list[Crop] | None = None  # the parts of the photos that are trained on; None: all of them
        self.iteration, self.total = 0, self.settings.train.iterations
        self.seconds = 0.0
        self.decided = Lines()
        self.needs: dict[str, Found] = {}  # the decisions of `train/decide`, by the need's name
        self.initial = self.method.deferred and self.settings.initial.until > 0  # the initial stage is not over yet
        self.residual = False  # the residual learns (see `residual_start`)
        self.learned = Learned()  # surfels, "environment" (raw texels of the light), and "exposure" (one row a view)
        self.occluder: Occluder | None = None
        self.told_light: Tensor | None = None  # which texels of the light metals mirror (see `Environment`)
        self.parts: dict[type, Any] = {}

    def part(self, kind: type[P]) -> P:
        """Return the object of class `kind`, which holds one training module's own facts."""
        return self.parts[kind]

    def needed(self, name: str) -> bool:
        """Tell whether the scene needs the optional feature `name`, true until that is decided."""
        return name not in self.needs or self.needs[name].needed

    @property
    def near(self) -> float:
        """Return the distance from a camera within which surfels are not drawn."""
        return near_plane(self.capture.radius)

    @property
    def from_hull(self) -> bool:
        """Tell whether surfels start on the visual hull: all photos have masks."""
        return all(view.alpha is not None for view in self.views)

    @property
    def settings(self) -> Settings:
        """Return the settings that the training uses now (see `Effective`)."""
        return self.effective.settings

    @property
    def method(self) -> Method:
        """Return the method that renders pictures from surfels and light, as the settings select it."""
        return method_of(self.settings.render)

    @property
    def ended(self) -> bool:
        return self.iteration >= self.total

    @property
    def residual_start(self) -> float:
        """Return the progress (0..1) from which on the residual learns, or 1 if it never learns.

        The residual is a colour that changes with the viewing direction. It is added to the shaded colour, and learns what material and
        light do not explain in the photos.
        """
        settings = self.settings
        return settings.residual.start if self.method.deferred and settings.render.diffuse == "irradiance" else 1.0

    @property
    def losses(self) -> LossSettings:
        """Return the loss weights, 0 for terms of metals and roughness without specular shading."""
        weights = self.settings.loss
        if self.settings.render.reflection == "none":
            return weights.model_copy(update={"even": 0.0, "metallic": 0.0, "matte": 0.0, "outlines": 0.0, "mesh": 0.0})
        return weights

    def surfels(self) -> Surfels:
        """Compute all surfels from the raw parameters (before activation)."""
        count = self.learned.count
        values = activate(self.learned.by_row | self.learned.constant)
        if self.method.lit and self.settings.render.diffuse == "irradiance" and not self.residual:
            values = values.without_directions()
        return Surfels(*(v if len(v) == count else v.expand(count, *v.shape[1:]) for v in values))

    def environment(self) -> Environment | None:
        """Make the light from its raw texels; None if the method uses no light."""
        if not self.method.lit:
            return None
        reference = self.views[0].camera if self.settings.light.frame == "camera" else None
        radiance = self.method.light.radiance(self.learned["environment"])
        return Environment(radiance, reference, self.told_light)

    def inputs(self) -> RenderInputs:
        """Gather the surfels, light, settings and mesh for a rendering."""
        settings = self.settings.render
        settings = initial_stage(settings) if self.initial else settings
        return RenderInputs(self.surfels(), self.environment(), settings, self.occluder)

    def picture(self, inputs: RenderInputs, camera: Camera, exposure: Tensor | None = None) -> Rendering:
        """Render with gradients; `exposure` (3,) are factors for linear red, green and blue."""
        surfels, environment, settings, occluder = inputs
        return render(surfels, environment, camera, self.background, settings, self.near, occluder, exposure)

    @torch.no_grad()
    def render(self, camera: Camera, surfels: Surfels | None = None) -> Rendering:
        """Render without gradients, from `surfels` or, if None, from all surfels."""
        inputs = self.inputs()
        return self.picture(inputs if surfels is None else inputs._replace(surfels=surfels), camera)

    def photo(self, view: int, whole: bool = False) -> Photo:
        """Return a view's photo as loaded, cropped to the pixels in use unless `whole`."""
        photo = self.photos[view]
        return photo if whole or self.crops is None else photo.part(*self.crops[view])

    def spread_cameras(self, least: int) -> list[Camera]:
        """Return at least `least` evenly spaced training cameras, or all if there are fewer."""
        return [view.camera for view in self.views[:: max(1, len(self.views) // least)]]

    def wanted(self) -> Tensor:
        """Tell for each surfel (N,) whether it lies in the region to train, a box that the user may set. Without a box, all surfels do.

        Surfels outside the region only exist to reproduce the background of the photos.
        """
        position, box = self.learned["position"], self.capture.box
        if box is None:
            return torch.ones(len(position), dtype=torch.bool, device=self.device)
        return torch.from_numpy(box.contains(position.numpy(force=True))).to(self.device)

    def announce(self, about: str, what: str, detail: bool = False) -> None:
        """Report the decision `about` to the user, unless the same `what` was reported before.

        A `detail` is only logged (see `events.Report`), unless it replaces a line that was shown.
        """
        if self.decided.get(about) != what:
            detail = detail and (about in self.decided.details or about not in self.decided)
            (self.decided.details.add if detail else self.decided.details.discard)(about)
            self.decided[about] = what
            self.report("decided", {"about": about, "what": what, "detail": detail})

    def change(self, key: str, value: Any, by: By, why: str) -> None:
        """Change the setting `key` ("section.name") from now on, recording its cause `by` and `why`."""
        self.effective = self.effective.changed(key, value, by, why)


def why_not_traced(state: State) -> str:
    """Return the reason why this run does not trace inter-reflection, or "" if it does."""
    settings = state.settings
    if not state.method.deferred:
        return f"shading = {settings.render.shading}"
    if settings.indirect.start >= 1:
        return "its setting leaves it out (indirect.start = 1)"
    if not state.needed("reflections"):
        return state.needs["reflections"].why
    if settings.render.reflection == "none":
        return "nothing is mirrored"
    if not state.from_hull:  # the mesh would include the surroundings
        return "not every photo has a mask of the object"
    if settings.light.frame == "camera":  # surfels have no fixed radiance that others could mirror
        return "the light turns with the camera: what the object mirrors of itself changes from photo to photo"
    return ""
