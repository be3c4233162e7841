"""How far a training is, as it goes, from photos that were held out and from the ground truth that a capture brings."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from refgs.capture import Capture, LoadedView, View
from refgs.color import srgb_decode
from refgs.compare import metrics
from refgs.compare.pictures import composite, maps
from refgs.compare.truth import FOLDER, PASSES, GroundTruth, errors, known_maps
from refgs.errors import InputError
from refgs.model.environment import Environment
from refgs.render.renderer import Rendering, render
from refgs.run import light_of
from refgs.settings import Settings

if TYPE_CHECKING:
    from refgs.train.trainer import Trainer

VIEWS = 4  # that are looked at
FEWER = 2  # of them for what is dear: FLIP, which takes as long as ten renderings, and another light
ROWS = 128  # of the lights that are compared


class _Look(NamedTuple):
    """A view; maps that are known of it, with the object's coverage; under another light."""

    view: LoadedView
    known: dict[str, np.ndarray]
    alpha: np.ndarray
    relit: np.ndarray | None


class Measures:
    """A few fixed views of those that were held out, and what is known of them.

    Ground truth is the capture's folder `ground_truth`, as `compare.truth.GroundTruth` reads it, or the normals of its data set;
    where that is not of the size that is trained at, it is said to `report` and left out.
    """

    def __init__(
        self,
        capture: Capture,
        loaded: list[LoadedView],
        settings: Settings,
        device: torch.device,
        report: Callable[[str, dict[str, Any]], None],
    ):
        self.settings, self._background = settings, torch.tensor(settings.image.background)
        views = list(zip(capture.test_views, loaded, strict=True))
        chosen = views[:: max(1, len(views) // VIEWS)][:VIEWS]
        folder = capture.folder / FOLDER
        self._light = self._panorama = None
        try:
            truth = GroundTruth(folder, capture.to_capture) if folder.is_dir() else None
            self._looks = [self._look(*pair, truth, capture.to_capture) for pair in chosen]
            if truth:
                self._read_lights(truth, device)
        except InputError as error:
            report("warning", {"what": f"errors against the ground truth are not recorded: {error}"})
            self._looks = [self._look(*pair, None, None) for pair in chosen]

    def _look(self, view: View, loaded: LoadedView, truth: GroundTruth | None, to_capture: np.ndarray | None) -> _Look:
        camera, known, alpha, relit = loaded.camera, {}, np.zeros(0), None
        if to_capture is not None:
            known, alpha = known_maps(truth, view, camera, to_capture)
        left = {"visibility"}
        if self.settings.render.diffuse == "sh":  # base colour is recovered from it when the training has ended
            left |= {"albedo"}
        elif truth and truth.hdris and self.settings.render.shading != "sh":
            relit = truth.relit(truth.hdris[0], camera)
        known = {name: known[name] for name in PASSES if name in known and name not in left}
        return _Look(loaded, known, alpha, relit)

    def _read_lights(self, truth: GroundTruth, device: torch.device) -> None:
        """The true light, and the first of those that views are known under: the one that is held out here."""
        if self.settings.render.shading == "sh":
            return
        if truth.has_light and self.settings.light.frame != "camera":  # the true light stands still
            self._panorama = metrics.resized(truth.panorama("light"), ROWS)
        if any(look.relit is not None for look in self._looks):
            light = light_of(truth.panorama(f"relight/{truth.hdris[0]}"), self.settings)
            self._light = Environment(light.radiance.to(device))

    def errors(self, trainer: "Trainer") -> dict[str, float]:
        """Mean errors of a training as it is: `psnr_test`; against ground truth `normal_mae_degrees`, `albedo_psnr` (linear, one scale
        a channel aligned), `metallic_mae`, `roughness_mae`, `light_log_rmse` (natural logarithm, one scale aligned) and `relit_psnr` (one
        scale aligned; what the object sends itself of the other light is not traced). Those that there are."""
        rows: dict[str, list] = {}
        for look in self._looks:
            rendering = trainer.render(look.view.camera)
            figures = {"psnr_test": self._against_photo(metrics.psnr, rendering, look)}
            figures |= errors(maps(rendering), look.known, look.alpha)
            for name, value in figures.items():
                rows.setdefault(name, []).append(value)
        found = {}
        if "albedo" in rows:
            found["albedo_psnr"] = metrics.aligned_psnr(rows.pop("albedo"))["psnr_aligned"]
        found = {name: float(np.mean(values)) for name, values in rows.items()} | found
        if self._panorama is not None:
            light = trainer.environment().panorama(ROWS)
            light = srgb_decode(light) if self.settings.render.color_space == "display" else light
            found["light_log_rmse"] = metrics.environment_log_rmse(light, self._panorama)[0]
        if self._light is not None:
            found["relit_psnr"] = self._relit(trainer)
        return found

    def flip(self, trainer: "Trainer") -> dict[str, float]:
        """Mean FLIP, `flip_test`, of the first views."""
        looks = self._looks[:FEWER]
        values = [self._against_photo(metrics.flip, trainer.render(look.view.camera), look) for look in looks]
        return {"flip_test": float(np.mean(values))} if values else {}

    def _against_photo(
        self, measure: Callable[[np.ndarray, np.ndarray], float], rendering: Rendering, look: _Look
    ) -> float:
        photo = composite(look.view, self._background).numpy()
        return measure(rendering.color.clamp(0, 1).numpy(force=True), photo)

    @torch.no_grad()
    def _relit(self, trainer: "Trainer") -> float:
        """PSNR of the first views under the light that was held out, one scale aligned."""
        settings = self.settings.render.model_copy(update={"reflection": "microfacet"})
        surfels = trainer.surfels().without_directions()
        pairs = []
        for look in self._looks[:FEWER]:
            given = look.view.camera, trainer.background, settings, trainer.near
            image = render(surfels, self._light, *given)
            pairs.append((maps(image)["color"], look.relit))
        return metrics.relit(lambda: pairs, (metrics.psnr,))["psnr_aligned"]
