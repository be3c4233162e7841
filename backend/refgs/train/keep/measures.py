"""Measure a training's errors against held-out photos, and against the capture's ground truth if it has any."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from refgs.capture import LoadedView, View
from refgs.compare import metrics
from refgs.compare.pictures import composite, maps
from refgs.compare.published import published_truth
from refgs.compare.truth import FOLDER, PASSES, GroundTruth, errors, known_maps
from refgs.errors import InputError
from refgs.model.environment import Environment
from refgs.render.renderer import Rendering, render
from refgs.run import light_of
from refgs.spread import spread
from refgs.train.state import State

MEASURED_VIEWS = 4  # held-out views that are measured, at most
SLOW_VIEWS = 2  # of these, views for slow measures: relighting, and FLIP, which takes as long as ten renderings
ROWS = 128  # rows of the panoramas that are compared


def held_out_psnr(state: State, most: int = MEASURED_VIEWS) -> float | None:
    """Average the PSNR over at most `most` held-out views; None without such views."""
    chosen = spread(state.test, most)
    if not chosen:
        return None
    pairs = ((state.render(v.camera).color.clamp(0, 1), composite(v, state.background)) for v in chosen)
    return float(np.mean([metrics.psnr(*(image.numpy(force=True) for image in pair)) for pair in pairs]))


class _TestView(NamedTuple):
    """Hold a held-out view and its true maps, coverage (0..1) and relit picture (linear RGBA)."""

    view: LoadedView
    known: dict[str, np.ndarray]
    alpha: np.ndarray
    relit: np.ndarray | None


class Measures:
    """Measure a few fixed held-out views against their photos and their ground truth.

    Ground truth is the capture's folder `ground_truth` (see `compare.truth.GroundTruth`), or the files of a published data set (see
    `published_truth`). If it cannot be read, or differs in size from the photos, a warning is reported and it is not used.
    """

    def __init__(self, state: State) -> None:
        capture = state.capture
        self.settings, self._background = state.settings, torch.tensor(state.settings.image.background)
        self._method = state.method
        chosen = spread(list(zip(capture.test_views, state.test, strict=True)), MEASURED_VIEWS)
        folder = capture.folder / FOLDER
        self._light = self._panorama = None
        try:
            read = GroundTruth(folder, capture.to_capture) if folder.is_dir() else None
            truth = read or published_truth(capture, capture.to_capture)
            self._test_views = [self._test_view(view, loaded, truth, capture.to_capture) for view, loaded in chosen]
            if truth:
                self._read_lights(truth, state.device)
        except InputError as error:
            state.report("warning", {"what": f"errors against the ground truth are not recorded: {error}"})
            self._test_views = [self._test_view(view, loaded, None, None) for view, loaded in chosen]

    def _test_view(
        self, view: View, loaded: LoadedView, truth: GroundTruth | None, to_capture: np.ndarray | None
    ) -> _TestView:
        camera, known, alpha, relit = loaded.camera, {}, np.zeros(0), None
        if to_capture is not None:
            known, alpha = known_maps(truth, view, camera, to_capture)
        left = {"visibility"}
        # Base colour is computed from SH colours only when the training has ended.
        if self.settings.render.diffuse == "sh":
            left |= {"albedo"}
        elif truth and truth.hdris and self._method.lit:
            relit = truth.relit(truth.hdris[0], camera)
        known = {name: known[name] for name in PASSES if name in known and name not in left}
        return _TestView(loaded, known, alpha, relit)

    def _read_lights(self, truth: GroundTruth, device: torch.device) -> None:
        """Read the true light, and the light of the relit pictures, if they exist."""
        if not self._method.lit:
            return
        # Else the training's light turns with the camera, and the true one does not.
        if truth.has_light and self.settings.light.frame != "camera":
            self._panorama = metrics.resized(truth.panorama("light"), ROWS)
        if any(test.relit is not None for test in self._test_views):
            light = light_of(truth.panorama(f"relight/{truth.hdris[0]}"), self.settings)
            self._light = Environment(light.radiance.to(device))

    def errors(self, state: State) -> dict[str, float]:
        """Measure the errors of the training now, averaged over the held-out views. Returns them by name.

        `psnr_test` is measured against the held-out photos. The others need ground truth: `normal_mae_degrees`, `albedo_psnr`,
        `metallic_mae`, `metallic_wrong` (fraction of pixels off by more than 0.5), `roughness_mae`, `light_log_rmse` (natural logarithm)
        and `relit_psnr` (without inter-reflection). Some values are first scaled to fit the truth best: each channel of the linear albedo
        by its own factor, and the light and the relit pictures each by one factor for all channels.
        """
        rows: dict[str, list] = {}
        for test in self._test_views:
            rendering = state.render(test.view.camera)
            figures = {"psnr_test": self._against_photo(metrics.psnr, rendering, test)}
            figures |= errors(maps(rendering), test.known, test.alpha)
            for name, value in figures.items():
                rows.setdefault(name, []).append(value)
        found = {}
        if "albedo" in rows:
            found["albedo_psnr"] = metrics.aligned_psnr(rows.pop("albedo"))["psnr_aligned"]
        found = {name: float(np.mean(values)) for name, values in rows.items()} | found
        if self._panorama is not None:
            light = self._method.light.to_linear(state.inputs().light.panorama(ROWS))
            found["light_log_rmse"] = metrics.environment_log_rmse(light, self._panorama)[0]
        if self._light is not None:
            found["relit_psnr"] = self._relit(state)
        return found

    def flip(self, state: State) -> dict[str, float]:
        """Average FLIP over the first SLOW_VIEWS held-out views, under the name `flip_test`."""
        chosen = self._test_views[:SLOW_VIEWS]
        values = [self._against_photo(metrics.flip, state.render(test.view.camera), test) for test in chosen]
        return {"flip_test": float(np.mean(values))} if values else {}

    def _against_photo(
        self, measure: Callable[[np.ndarray, np.ndarray], float], rendering: Rendering, test: _TestView
    ) -> float:
        photo = composite(test.view, self._background).numpy()
        return measure(rendering.color.clamp(0, 1).numpy(force=True), photo)

    @torch.no_grad()
    def _relit(self, state: State) -> float:
        """Return the PSNR of relit held-out views, after scaling all by the best factor."""
        settings = self.settings.render.model_copy(update={"reflection": "microfacet"})
        surfels = state.surfels().without_directions()
        pairs = []
        for test in self._test_views[:SLOW_VIEWS]:
            given = test.view.camera, state.background, settings, state.near
            image = render(surfels, self._light, *given)
            pairs.append((maps(image)["color"], test.relit))
        return metrics.relit(lambda: pairs, (metrics.psnr,))["psnr_aligned"]
