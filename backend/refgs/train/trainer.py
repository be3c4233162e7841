"""The training loop: one view, one step, until the iterations are done."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.capture import Capture, load_view
from refgs.clock import Clock, timed
from refgs.compare.metrics import decibels, psnr
from refgs.compare.pictures import composite
from refgs.errors import InputError
from refgs.geometry.mesh import clean
from refgs.geometry.visibility import Occluder
from refgs.model import cubemap
from refgs.model.adam import Adam
from refgs.model.environment import Environment
from refgs.model.surfels import Parameters, Surfels, activate
from refgs.render.extract import extract
from refgs.render.relight import received
from refgs.render.renderer import Rendering, near_plane, render
from refgs.render.volume import with_normals_last
from refgs.settings import LossSettings, RenderSettings, Settings
from refgs.train import history, needs, snapshot
from refgs.train.densify import ScreenGradient, densify, faint, propagate_normals, reset_opacity, thin
from refgs.train.guard import Guard, limits, running
from refgs.train.light import light_frame, mirrored
from refgs.train.losses import Photo, departure, objective
from refgs.train.measures import Measures
from refgs.train.plan import Plan, growth
from refgs.train.probe import Way
from refgs.train.start import AROUND, GEOMETRY, start_appearance, start_parameters

Report = Callable[[str, dict[str, Any]], None]
"""Called with an event's name and its facts: "stage", "decided", "progress", "measured", "warning"."""

REPORT_EVERY = 10  # iterations
EXPOSURES_KNOWN = 0.3  # part of the training after which exposures are known well enough to say whether there are any
EXPOSURES_ALIKE = (
    math.log(2) / 3
)  # a third of a stop, which is what cameras step by: what shading lacks can look like less
TRACED = 24  # views at the least for the mesh that inter-reflection is traced on; all where there are fewer
LIGHT_REFINED = 0.2  # part of the training after which the light has all its texels
LEAST_LIGHT = 16  # texels along a side
DIFFUSED = 64  # texels along a side at which the light diffuses as fast as its setting says, and as far on the sphere at any other
REFLECTING = ("albedo", "metallic", "roughness", "indirect_dc", "indirect_rest", "environment", "exposure")
FEWER = 0.8  # of the surfels, where there is no memory for all
LEAST_SURFELS = 1000
MIRROR = 7.0  # logit of a mirror's base colour, and the negative of its roughness's


def full_card() -> InputError:
    """What to say where a card's memory does not do."""
    return InputError("the card's memory is too small: close what else uses it, or take --device cpu")


class Trainer:
    """A capture being learned. State is on the run folder's disk after every checkpoint."""

    def __init__(
        self,
        capture: Capture,
        settings: Settings,
        folder: Path,
        report: Report,
        plan: Plan | None = None,
        device: str = "cpu",
    ):
        self.device = torch.device(device)
        self.total, self.plan = settings.train.iterations, plan or Plan(None)
        self.budget = settings.surfels.budget
        self.capture, self.settings, self.folder, self.report = capture, settings, folder, report
        side = settings.image.max_side
        self.clock = Clock(self.device)
        with self.clock.part("reading"):
            self.views = [load_view(view, side) for view in capture.train_views]
            self.test = [load_view(view, side) for view in capture.test_views]
        self.background = torch.tensor(settings.image.background, device=self.device)
        self.from_hull = all(view.alpha is not None for view in self.views)
        self.chosen: dict[str, str] = {}  # by a setting that asked for it: what was chosen, and why
        self.decided: dict[str, str] = {}  # the same as lines for the artist: of the light, exposures, what is needed
        self.needs: dict[str, dict[str, Any]] = {}  # the decisions of `refgs.train.needs`
        for view in reversed(needs.twins(self)):
            del self.views[view]
        self.photos = [Photo.of(view, self.device) for view in self.views]
        self.near = near_plane(capture.radius)
        self.iteration, self.seconds = 0, 0.0
        self.processor_seconds = 0.0  # of all threads: what other work on the machine hardly changes
        self._order: tuple[int, list[int]] = (-1, [])

        with self.clock.part("start"):
            start, shown, source = start_parameters(capture, self.views, settings)
        self._choose_light_frame(start, shown)
        with self.clock.part("reading"):
            self.measures = Measures(capture, self.test, self.settings, self.device, report)
        self.parameters = {name: value.detach().to(self.device).requires_grad_() for name, value in start.items()}
        report("stage", {"what": source})
        self.light = torch.empty(6 * self._light_resolution(0) ** 2, 3, device=self.device)
        self.light.fill_(self._start_light()).requires_grad_()
        self._drop_unused()
        groups = [{"params": [value], "name": name} for name, value in self.parameters.items()]
        if settings.render.shading != "sh":
            groups.append({"params": [self.light], "name": "environment"})
        self.exposures: Tensor | None = None  # natural logarithms (views,), where photos have any of their own
        if settings.render.shading != "sh" and settings.light.exposure != "off":
            self.exposures = torch.zeros(len(self.views), device=self.device).requires_grad_()
            groups.append({"params": [self.exposures], "name": "exposure"})
        display = settings.render.color_space == "display"
        self.optimizer = Adam([g | {"limits": limits(g["name"], capture.radius, display)} for g in groups])
        self.guard = Guard(self.device)
        self.motion = ScreenGradient(len(self.parameters["position"]), self.device)
        self.occluder: Occluder | None = None
        self.light_shown: Tensor | None = None  # which part of the light the object shows
        self.initial = settings.render.shading == "deferred" and settings.initial.until > 0  # its stage is not over
        self.crops: list[tuple[slice, slice]] | None = None  # the parts of the photos that training looks at
        needs.before(self)

    def _rate(self, name: str) -> float:
        if name == "sh_rest" and self.residual_start < 1:
            name = "residual"
        rate = getattr(self.settings.rates, name, 0.0)  # "received" is traced and does not learn
        return rate * self.capture.radius if name == "position" else rate

    def _choose_light_frame(self, start: Parameters, shown: int) -> None:
        """Where the settings leave it to the photos. They say which it is from here on. So many of the first surfels are on the hull."""
        light, lit = self.settings.light, self.settings.render.shading != "sh"
        if light.frame != "auto":
            return
        frame, why = "world", "there is no light" if not lit else "not every photo has a mask of the object"
        if lit and self.from_hull:
            with torch.no_grad():
                points = activate(start)
                found = points.positions[:shown].numpy(), points.normals()[:shown].numpy()
            frame, why = light_frame(self.views, *found, self.capture.radius)
        self.settings = self.settings.model_copy(update={"light": light.model_copy(update={"frame": frame})})
        self.chosen["light.frame"] = f"{frame}: {why}"
        if lit:
            where = "turns with the camera" if frame == "camera" else "stands still"
            self.decide("light", f"the light {where}: {why}")

    def decide(self, about: str, what: str) -> None:
        """Say how something came out that was left to the photos, where that is new; a run that is gone on with says it again."""
        if self.decided.get(about) != what:
            self.decided[about] = what
            self.report("decided", {"about": about, "what": what})

    def _drop_unused(self) -> None:
        """What this run's shading never reads does not learn."""
        render = self.settings.render
        unused = []
        if render.shading == "sh":
            unused = ["albedo", "metallic", "roughness"]
        elif render.diffuse == "irradiance":
            unused = ["sh_dc"] if self.residual_start < 1 else ["sh_dc", "sh_rest"]
        if why := self.without_reflection():
            unused += ["indirect_dc", "indirect_rest"]
            if render.shading == "deferred" and self.settings.indirect.start < 1:
                self.decide("reflections", f"without inter-reflection: {why}")
        if why or render.diffuse == "sh":
            unused += ["received"]
        mirror = (
            {"albedo": MIRROR, "roughness": -MIRROR} if render.reflection == "mirror" and render.shading != "sh" else {}
        )
        self.constant = {name: self.parameters.pop(name).detach()[:1] for name in [*unused, *mirror]}
        for name, value in mirror.items():
            self.constant[name].fill_(value)

    def leave_out(self, *names: str) -> None:
        """From here on these do not learn; the first surfel's values stand for all."""
        for name in names:
            if name in self.parameters:
                value = self.parameters.pop(name)
                self.optimizer.state.pop(value, None)
                self.constant[name] = value.detach()[:1].clone()
        self.optimizer.param_groups = [g for g in self.optimizer.param_groups if g["name"] not in names]

    def shorten(self, name: str, count: int) -> None:
        """Of harmonics learn only so many coefficients from here on."""
        group = next(g for g in self.optimizer.param_groups if g["name"] == name)
        old, new = self.parameters[name], self.parameters[name].detach()[:, :count].contiguous().requires_grad_()
        state = self.optimizer.state.pop(old, {})
        group["params"][0] = self.parameters[name] = new
        if state:
            moments = {key: state[key][:, :count].contiguous() for key in ("exp_avg", "exp_avg_sq")}
            self.optimizer.state[new] = state | moments

    def without_reflection(self) -> str:
        """Why this run looks for no inter-reflection, or ""."""
        settings = self.settings
        if settings.render.shading != "deferred":
            return f"shading = {settings.render.shading}"
        if settings.indirect.start >= 1:
            return "its setting leaves it out (indirect.start = 1)"
        if not self.needs.get("reflections", {}).get("needed", True):
            return self.needs["reflections"]["why"]
        if settings.render.reflection == "none":
            return "nothing is mirrored"
        if not self.from_hull:  # the mesh would be of the surroundings too
            return "not every photo has a mask of the object"
        if settings.light.frame == "camera":  # surfels have no light of their own to show others
            return "the light turns with the camera: what the object mirrors of itself changes from photo to photo"
        return ""

    @property
    def residual_start(self) -> float:
        """The part of the training after which colour by direction learns what material and light leave over; 1 where it never does."""
        render = self.settings.render
        return self.settings.residual.start if render.shading == "deferred" and render.diffuse == "irradiance" else 1.0

    def surfels(self) -> Surfels:
        """The activated surfels, with what does not learn filled in."""
        count, render, late = len(self.parameters["position"]), self.settings.render, self.residual_start
        values = activate({**self.parameters, **self.constant})
        if (
            render.shading != "sh"
            and render.diffuse == "irradiance"
            and (late == 1 or self.iteration < late * self.total)
        ):
            values = values.without_directions()
        return Surfels(*(v if len(v) == count else v.expand(count, *v.shape[1:]) for v in values))

    def wanted(self) -> Tensor:
        """Which surfels (N,) are in the region that is wanted, all where there is none. The others show what photos show beside it."""
        position, box = self.parameters["position"], self.capture.box
        if box is None:
            return torch.ones(len(position), dtype=torch.bool, device=self.device)
        return torch.from_numpy(box.contains(position.numpy(force=True))).to(self.device)

    def environment(self) -> Environment | None:
        """The light as it is now; none where nothing is lit."""
        if self.settings.render.shading == "sh":
            return None
        reference = self.views[0].camera if self.settings.light.frame == "camera" else None
        display = self.settings.render.color_space == "display"
        return Environment(
            torch.sigmoid(self.light) if display else torch.nn.functional.softplus(self.light), reference
        )

    def _start_light(self) -> float:
        """What `environment` makes the radiance at the start of."""
        radiance = self.settings.environment.radiance
        display = self.settings.render.color_space == "display"
        return math.log(radiance / (1 - radiance)) if display else math.log(math.expm1(radiance))

    def _light_resolution(self, progress: float) -> int:
        """Fewer texels learn sooner, each being seen more often: at first the light has half as many along each side."""
        finest = self.settings.environment.resolution
        return finest if progress >= LIGHT_REFINED else max(finest // 2, LEAST_LIGHT)

    @torch.no_grad()
    def _refine_light(self) -> None:
        """Go on with twice as many texels along each side."""
        side = math.isqrt(len(self.light) // 6)
        directions = cubemap.texel_directions(2 * side).float()
        finer = cubemap.sample(self.light.cpu(), (side,), directions, torch.zeros(len(directions)))
        self._replace_light(finer.to(self.device))

    @torch.no_grad()
    def coarsen_light(self, side: int) -> None:
        """Go on with so many texels along each side, means of those there are."""
        fine = math.isqrt(len(self.light) // 6) // side
        self._replace_light(self.light.view(6, side, fine, side, fine, 3).mean(dim=(2, 4)).reshape(-1, 3))

    def _replace_light(self, texels: Tensor) -> None:
        self.optimizer.state.pop(self.light, None)
        self.light = texels.requires_grad_()
        next(g for g in self.optimizer.param_groups if g["name"] == "environment")["params"] = [self.light]

    @timed("optimiser")
    @torch.no_grad()
    def _diffuse_light(self) -> None:
        """Let texels flow into their neighbours on the face, beside the optimiser's step and in proportion to its rate, as decoupled
        weight decay is (Loshchilov and Hutter 2019). What photos agree on moves by the whole rate, and stays sharp; what only
        noise moves evens out. The mean stays."""
        group = next(g for g in self.optimizer.param_groups if g["name"] == "environment")
        side = math.isqrt(len(self.light) // 6)
        part = min(group["lr"] * self.settings.environment.diffusion * (side / DIFFUSED) ** 2, 0.25)
        if part == 0:
            return
        texels = self.light.view(6, side, side, 3)
        for axis in (1, 2):
            flow = part * texels.diff(dim=axis)
            texels.narrow(axis, 0, side - 1).add_(flow)
            texels.narrow(axis, 1, side - 1).sub_(flow)

    def mean_light(self, light: Environment) -> Tensor | None:
        """The light's mean radiance (3,) over what the object mirrors of it, if that is held to be grey."""
        if self.settings.loss.light == 0:
            return None
        if self.light_shown is None or len(self.light_shown) != len(light.radiance):
            cameras = [view.camera for view in self.views[:: max(1, len(self.views) // TRACED)]]
            with torch.no_grad():
                self.light_shown = mirrored(self.surfels(), cameras, light, self.settings.render, self.near)
        return self.light_shown @ light.radiance

    def _shading(self) -> RenderSettings:
        """How pictures are made at this stage."""
        settings = self.settings.render
        return settings.model_copy(update={"shading": "splat"}) if self.initial else settings

    def way(self) -> Way:
        """What pictures are made from, as it is now."""
        return Way(self.surfels(), self.environment(), self._shading(), self.occluder)

    @property
    def losses(self) -> LossSettings:
        """The weights of what training lowers."""
        weights = self.settings.loss
        if self.settings.render.reflection == "none":  # no surfel has a metallic or a roughness of its own
            return weights.model_copy(update={"even": 0.0, "metallic": 0.0, "matte": 0.0})
        return weights

    def photo(self, view: int, whole: bool = False) -> Photo:
        """What training looks at of a view, or all of it."""
        return self.photos[view] if whole or self.crops is None else self.photos[view].part(*self.crops[view])

    def exposure(self, view: int) -> Tensor | None:
        """The factor of a photo's radiance; None where photos have none of their own."""
        return None if self.exposures is None else self.exposures[view].exp()

    def render(self, camera: Camera, surfels: Surfels | None = None) -> Rendering:
        """Render a camera without gradients: all surfels, or those given."""
        with torch.no_grad():
            return self._render(self.surfels() if surfels is None else surfels, self.environment(), camera)

    def _render(
        self, surfels: Surfels, environment: Environment | None, camera: Camera, exposure: Tensor | None = None
    ) -> Rendering:
        settings = self._shading()
        return render(surfels, environment, camera, self.background, settings, self.near, self.occluder, exposure)

    def test_psnr(self, most: int = 4) -> float | None:
        """Mean PSNR over at most this many of the held-out views; None where there are none."""
        chosen = self.test[:: max(1, len(self.test) // most)][:most]
        if not chosen:
            return None
        pairs = ((self.render(v.camera).color.clamp(0, 1), composite(v, self.background)) for v in chosen)
        return float(np.mean([psnr(*(image.numpy(force=True) for image in pair)) for pair in pairs]))

    def step(self) -> dict[str, Tensor]:
        """One iteration. Returns its loss and mean squared error, which are still being computed where there is a card."""
        settings = self.settings
        view = self._next_view()
        photo = self.photo(view, whole=self.iteration % needs.WHOLE_EVERY == 0)
        progress = min(self.iteration / self.total, 1.0)
        if self.initial and progress >= settings.initial.until:
            self._begin_deferred()
        self._set_rates(progress)
        if settings.render.shading != "sh" and len(self.light) < 6 * self._light_resolution(progress) ** 2:
            self._refine_light()

        surfels, environment = self.surfels(), self.environment()
        rendering = self._render(surfels, environment, photo.camera, self.exposure(view))
        mean = None if environment is None else self.mean_light(environment)
        loss, square = objective(rendering, mean, photo, self.background, self.losses, progress)
        if self.exposures is not None:
            loss = loss + settings.loss.exposure * departure(self.exposures[view])
        loss.backward()
        position = self.parameters["position"]
        accepted = self.guard.judge(loss, self.optimizer)
        self.motion.add(position.detach(), position.grad, self.photos[view].camera, accepted)
        self.optimizer.step(accepted)
        if environment is not None:
            self._diffuse_light()
        self.forget_gradients()
        self.iteration += 1
        learns = settings.indirect.start <= progress < self.residual_start  # later, materials would not make up for it
        due = learns and self.iteration % settings.indirect.every == 0 and not self.faint(needs.SEEN)
        # A mesh, and decisions, come before what makes all surfels faint.
        if not self.without_reflection() and not self.initial and due and self.iteration < self.total:
            with self.clock.part("visibility"):
                self._trace()
        with self.clock.part("deciding"):
            needs.weigh(self, progress)
        self._densify(progress)
        self._reshape()
        self._weigh_exposures(progress)
        return {"loss": loss.detach(), "square": square}

    def _set_rates(self, progress: float) -> None:
        settings, rates, frozen = self.settings, self.settings.rates, []
        if self.from_hull and self.iteration < settings.train.light_first and settings.render.shading == "deferred":
            frozen += GEOMETRY
        since = self._since_propagation()
        if since is not None and since < settings.propagation.rest:
            frozen += ["opacity"]
        # What material and light leave over is not taken from them: they have cooled by then, and stay.
        late = self.residual_start
        if late < 1 and progress >= late:
            frozen += REFLECTING
        for group in self.optimizer.param_groups:
            name, decay = group["name"], rates.decay**progress
            if name == "position":
                decay = rates.position_decay ** min(progress / rates.position_until, 1)
            elif name in REFLECTING:
                decay = rates.decay ** min(progress / late, 1)
            elif name == "sh_rest" and late < 1:
                decay = rates.decay ** (max(progress - late, 0) / (1 - late))
            group["lr"] = 0.0 if name in frozen else self._rate(name) * decay

    def _since_propagation(self) -> int | None:
        """Iterations since normals were last propagated, if they are at this stage."""
        settings = self.settings.propagation
        if not settings.every or self.iteration < settings.every or self.settings.render.shading == "sh":
            return None
        last = self.iteration // settings.every * settings.every
        return self.iteration - last if last / self.total < settings.stop else None

    @torch.no_grad()
    def _begin_deferred(self) -> None:
        """End the stage in which surfels are shaded one by one: on the geometry that it leaves, colour, material and light
        start anew (paper §3.3)."""
        self.initial = False
        for name, row in start_appearance(self.settings).items():
            if name in self.parameters:
                self.parameters[name][:] = row
                self.optimizer.state.pop(self.parameters[name], None)
        self.light.fill_(self._start_light())
        self.optimizer.state.pop(self.light, None)
        if self.exposures is not None:  # learned against that light
            self.exposures.zero_()
            self.optimizer.state.pop(self.exposures, None)
        self.report("stage", {"what": "shading what is blended: colour, material and light start anew"})

    def forget_gradients(self) -> None:
        for group in self.optimizer.param_groups:
            group["params"][0].grad = None

    def _next_view(self) -> int:
        """Every view once an epoch, in an order that depends on the seed and the epoch alone, so that a resumed run goes on alike."""
        epoch, place = divmod(self.iteration, len(self.views))
        if self._order[0] != epoch:
            generator = torch.Generator().manual_seed(self.settings.train.seed * 1_000_003 + epoch)
            self._order = epoch, torch.randperm(len(self.views), generator=generator).tolist()
        return self._order[1][place]

    def faint(self, opacity: float) -> bool:
        """Whether all surfels were made faint so lately that they may not be back at an opacity."""
        return faint(self.settings.densify, self.settings.rates, self.iteration, self.total, opacity)

    def _densify(self, progress: float) -> None:
        settings = self.settings.densify
        if self.iteration % settings.every or progress < settings.start:
            return
        if self.faint(settings.prune_opacity):
            return
        gradient = self.motion.mean()
        if self.capture.box is not None:  # what is beside it gets no more than its share
            wanted = self.wanted()
            ranked = torch.where(wanted, torch.inf, gradient).argsort(descending=True)
            count = int(wanted.sum())
            room = max(int(AROUND * self.budget) - (len(wanted) - count), 0)
            gradient[ranked[count + room :]] = 0
        with self.clock.part("densification"):
            densify(
                self.parameters,
                self.optimizer,
                gradient,
                settings,
                self.budget,
                divide=progress < settings.stop,
            )
        self.motion = ScreenGradient(len(self.parameters["position"]), self.device)

    def _reshape(self) -> None:
        """What is done to all surfels now and then: mirrors' normals spread, or all grow faint."""
        densify, due = self.settings.densify, self.iteration % max(self.settings.densify.reset_every, 1) == 0
        if self._since_propagation() == 0:
            with self.clock.part("densification"):
                propagate_normals(self.constant | self.parameters, self.optimizer, self.settings.propagation)
        elif densify.reset_every and due and self.iteration / self.total < densify.stop:
            reset_opacity(self.parameters, self.optimizer)

    @torch.no_grad()
    def _weigh_exposures(self, progress: float) -> None:
        """Leave the exposures out, where that is asked for, once it is seen that the photos have none of their own."""
        settings = self.settings
        if self.exposures is None or settings.light.exposure != "auto" or self.initial:
            return
        if self.iteration % settings.densify.every or progress < EXPOSURES_KNOWN or self.faint(needs.SEEN):
            return
        spread = float((self.exposures - self.exposures.median()).abs().max())  # a card waits here, once in a while
        if spread < EXPOSURES_ALIKE:
            self.optimizer.param_groups = [g for g in self.optimizer.param_groups if g["name"] != "exposure"]
            self.optimizer.state.pop(self.exposures, None)
            self.exposures = None
            self.decide("exposures", "the photos have no exposures of their own: they agree within a third of a stop")

    @torch.no_grad()
    def _trace(self) -> None:
        """Extract the mesh that inter-reflection is traced on; do without where the object hardly mirrors itself."""
        capture, settings = self.capture, self.settings.indirect
        cameras = [view.camera for view in self.views[:: max(1, len(self.views) // TRACED)]]
        surfels, environment, self.occluder = self.surfels(), self.environment(), None
        inside = surfels.chosen(self.wanted())
        with self.clock.part("mesh"):
            mesh, _ = extract(inside, cameras, self.near, capture.centre, capture.radius, settings.resolution)
            try:
                self.occluder = Occluder(clean(mesh, triangles=len(mesh.faces)))
            except InputError:  # there is no surface yet
                return
        hidden, solid = 0.0, 1e-9
        for camera in cameras[::3]:
            looked = self._render(inside, environment, camera)
            opaque = looked.alpha > 0.5
            hidden += float((1 - looked.visibility)[opaque].sum())
            solid += float(opaque.sum())
        if not self.optimizer.state.get(self.parameters["indirect_dc"]):
            # What the surfels mirrored until now, so that the picture changes little.
            start, rest = environment.harmonics, self.parameters["indirect_rest"]
            self.parameters["indirect_dc"][:], rest[:] = start[:1], start[1 : 1 + rest.shape[1]]
        with self.clock.part("deciding"):
            needs.reflections(self, hidden / solid)
        if self.occluder is not None and "received" in self.parameters:
            # Anew each time, for light and mesh are better known; until the next it stays.
            traced = Surfels(*(value.cpu() for value in with_normals_last(surfels)))
            light = Environment(environment.radiance.cpu())  # it stands in the world, or nothing would be traced
            self.parameters["received"][:] = received(traced, self.occluder, light)

    @property
    def ended(self) -> bool:
        return self.iteration >= self.total

    def run(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Train to the end, or until `stop` says so; a checkpoint is written either way. True when the end was reached."""
        means, before, first = {}, self.seconds, self.iteration
        self.plan.begin(self.iteration, growth(len(self.parameters["position"]), self.budget))
        while not self.ended and not self._waited(stop):
            figures = self.iterate()
            views = len(self.views) + len(self.test)
            self.total = self.plan.total(self.iteration, views) or self.total
            # Running means, read now and then: a card need not wait.
            means = {name: running(means.get(name, figure), figure) for name, figure in figures.items()}
            if self.iteration % REPORT_EVERY == 0 or self.iteration == self.total:
                self.guard.look(self, whole=self.ended)
                loss, quality = float(means["loss"]), decibels(float(means["square"]))
                pace = (self.seconds - before) / max(self.iteration - first, 1)  # it may have gone back
                self.report(
                    "progress",
                    {
                        "iteration": self.iteration,
                        "total": self.total,
                        "seconds": self.seconds,
                        "seconds_left": pace * (self.total - self.iteration),
                        "loss": loss,
                        "psnr": quality,
                        "splats": len(self.parameters["position"]),
                    },
                )
            if history.due(self.iteration) and not self.ended:
                history.record(self, float(means["loss"]), decibels(float(means["square"])))
            if self.iteration % self.settings.train.checkpoint_every == 0 and self.iteration < self.total:
                self.save()
        if self.ended and means:
            history.record(self, float(means["loss"]), decibels(float(means["square"])))
        self.save()
        return self.ended

    def iterate(self) -> dict[str, Tensor]:
        """A `step` whose seconds are counted, within what memory a card has."""
        begun, used = time.perf_counter(), time.process_time()
        figures = self._step_within_memory()
        self.seconds += time.perf_counter() - begun
        self.processor_seconds += time.process_time() - used
        return figures

    def _step_within_memory(self) -> dict[str, Tensor]:
        """One iteration; where the card's memory does not hold it, with fewer surfels from here on."""
        while True:
            try:
                with self.clock.iteration(self.iteration):
                    return self.step()
            except torch.OutOfMemoryError:
                self.budget = int(FEWER * len(self.parameters["position"]))
                if self.budget < LEAST_SURFELS:
                    raise full_card() from None
            self.forget_gradients()
            torch.cuda.empty_cache()
            thin(self.parameters, self.optimizer, self.budget)
            self.motion = ScreenGradient(self.budget, self.device)
            self.report(
                "warning", {"what": f"the card's memory is full: going on with {self.budget:,} surfels at the most"}
            )

    def _waited(self, stop: Callable[[], bool]) -> bool:
        """Ask `stop`, which may hold the training up."""
        begun = time.perf_counter()
        stopped = stop()
        self.plan.wait(time.perf_counter() - begun)
        return stopped

    def save(self) -> None:
        """Write a checkpoint of everything that the next iteration depends on, once all of it is finite."""
        self.guard.look(self, whole=True)
        with self.clock.part("writing"):
            snapshot.save(self)

    def resume(self) -> None:
        """Go back to the last complete checkpoint."""
        snapshot.restore(self)
        history.trim(self.folder, self.iteration)
