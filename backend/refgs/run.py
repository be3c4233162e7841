"""Create run folders, and open a finished run to render it. A run folder holds all results of one training.

Rendering, evaluation, export and Blender read only the run folder.
"""

import platform
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tomli_w
import torch

from refgs import __version__
from refgs.camera import Camera
from refgs.capture import Capture, read_run_cameras, write_cameras
from refgs.capture.contents import write_hashes
from refgs.errors import InputError
from refgs.formats.mesh import read_mesh
from refgs.formats.panorama import read_environment
from refgs.formats.run_toml import RunFile
from refgs.formats.splats import Splats, read_splats
from refgs.formats.validate import read_tables, validated
from refgs.geometry.visibility import Occluder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels, from_splats
from refgs.paths import write_text
from refgs.render.baselines import method_of
from refgs.render.relight import Progress, Relit, Transport, relit
from refgs.render.renderer import Rendering, near_plane, render
from refgs.run_folder import CHECKPOINTS, SPLATS, check_finished, check_free
from refgs.settings import Settings

OCCLUDER = "occluder.ply"  # the mesh that inter-reflection was traced on; absent without inter-reflection


@dataclass(frozen=True)
class Run:
    """Results of a finished training, ready to render: surfels, light and cameras.

    Cameras are in the run's frame, the world coordinates used in training, and have the full size of the photos.
    """

    folder: Path
    settings: Settings
    capture_folder: Path
    fingerprint: str
    centre: np.ndarray
    radius: float
    bounded: bool
    near: float
    cameras: list[Camera]
    splits: list[str]
    to_capture: np.ndarray
    refined: bool  # the training refined the poses of its photos
    exposed: bool  # at least one photo has an exposure of its own
    splats: Splats
    environment: Environment | None
    occluder: Occluder | None
    _traced: dict = field(default_factory=dict, repr=False, compare=False)

    def surfels(self) -> Surfels:
        """Return the trained surfels as tensors."""
        return from_splats(self.splats)

    def training_cameras(self) -> list[Camera]:
        """Return the cameras of the training photos, at the image size used in training."""
        side = self.settings.image.max_side
        return [c.fitted(side) for c, split in zip(self.cameras, self.splits, strict=True) if split == "train"]

    def light(self, panorama: np.ndarray) -> Environment:
        """Make a light for `render` from an equirectangular image (H, W, 3) of linear radiance."""
        return light_of(panorama, self.settings)

    def relit(self, light: Environment, progress: Progress = lambda done, total: None) -> Relit | None:
        """Relight the surfels by another light, with the object's reflections of itself. Return None if the run has no inter-reflection.

        Rays are traced against the run's mesh. The first call traces the rays, which takes seconds. Later calls reuse them. The result for
        the last light is cached. progress(done, total) is called while rays are traced.
        """
        if self.occluder is None:
            return None
        with torch.no_grad():
            if "transport" not in self._traced:
                surfels = self.surfels()
                inward = (surfels.normals() * torch.from_numpy(self.splats.normals)).sum(dim=-1) < 0
                self._traced["transport"] = Transport(surfels.turned(inward), self.occluder, progress=progress)
            if self._traced.get("light") is not light:
                # Render with the learned rotations: near the horizon the side that a normal points to matters.
                found = relit(self._traced["transport"], light)
                found = found._replace(surfels=found.surfels._replace(rotations=self.surfels().rotations))
                self._traced.update(light=light, relit=found)
        return self._traced["relit"]

    def render(
        self, camera: Camera, environment: Environment | None = None, exposure: float | np.ndarray = 1.0
    ) -> Rendering:
        """Render an image from a camera in the run's frame. Radiance is multiplied by `exposure`, one factor or (3,).

        If `environment` is given, the surfels are relit by it; otherwise the light recovered in training is used.
        """
        surfels, settings, lit = self.surfels(), self.settings.render, None
        if environment is not None:
            lit = self.relit(environment)
            # Colours by direction were learned under the recovered light: they are wrong under this one.
            surfels = surfels.without_directions() if lit is None else lit.surfels
            diffuse = "irradiance" if lit is None else "sh"
            reflection = "none" if settings.reflection == "none" else "microfacet"
            settings = settings.model_copy(update={"diffuse": diffuse, "reflection": reflection})
        light, background = environment or self.environment, torch.tensor(self.settings.image.background)
        with torch.no_grad():
            factors = torch.tensor(np.broadcast_to(exposure, 3), dtype=torch.float32)
            return render(surfels, light, camera, background, settings, self.near, self.occluder, factors, lit)


def create_run(
    folder: Path,
    capture: Capture,
    settings: Settings,
    preset: str,
    device: str,
    chosen: dict[str, str] | None = None,
    changed: dict[str, dict] | None = None,
) -> None:
    """Create a run folder with cameras.json and capture.json, and then run.toml. Raise InputError if the folder holds a run or other files.

    `settings` are the values in use. Two tables are written to run.toml for the user. `chosen` has the chosen value and the reason of each
    setting that was "auto". `changed` has the rows of changed settings (see `record_changes`).
    """
    check_free(folder)
    try:
        (folder / CHECKPOINTS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: the folder cannot be made ({error.strerror}): choose another with --out") from None
    facts = {
        "run": {
            "refgs": __version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
            "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
            "threads": torch.get_num_threads(),
            "preset": preset,
            "capture": str(capture.folder.resolve()),
            "fingerprint": capture.fingerprint(),
            "layout": capture.layout,
            "centre": [float(x) for x in capture.centre],
            "radius": float(capture.radius),
            "bounded": bool(capture.bounded),
        },
        "settings": settings.model_dump(mode="json"),
        "chosen": chosen or {},
    }
    if changed:
        facts["changed"] = changed
    write_hashes(folder, capture.hashes)
    write_cameras(folder / "cameras.json", capture, settings.light.frame)
    write_text(folder / "run.toml", tomli_w.dumps(facts))


def record_changes(folder: Path, rows: dict[str, dict]) -> None:
    """Add changed settings to the table [changed] of run.toml.

    `rows` maps a setting's key to a dict: `asked` is the value that the user asked for, `became` the new value. If a setting is changed
    again, its first `asked` is kept.
    """
    if not rows:
        return
    file, again = folder / "run.toml", "Train again."
    tables = read_tables(file, again)
    known = validated(tables, RunFile, str(file), again).changed
    rows = {key: row | ({"asked": known[key].asked} if key in known else {}) for key, row in rows.items()}
    write_text(file, tomli_w.dumps(tables | {"changed": tables.get("changed", {}) | rows}))


def open_run(folder: Path) -> Run:
    """Open the run folder of a finished training. Raise InputError naming what is missing."""
    facts, settings = check_finished(folder)
    cameras, splits, to_capture, exposures, refined = read_run_cameras(folder / "cameras.json")
    splats, environment = read_splats(folder / SPLATS), None
    method = method_of(settings.render)
    if not method.mirror:  # edits may have added or removed specular shading: the splats know
        reflection = "none" if splats.constants.get("specular") == 0 else "microfacet"
        settings = settings.model_copy(update={"render": settings.render.model_copy(update={"reflection": reflection})})
    if method.lit:
        reference = next(c for c, split in zip(cameras, splits, strict=True) if split == "train")
        panorama = read_environment(folder / "environment.exr")
        environment = light_of(panorama, settings, reference if settings.light.frame == "camera" else None)
    return Run(
        folder=folder,
        settings=settings,
        capture_folder=Path(facts.capture),
        fingerprint=facts.fingerprint,
        centre=np.array(facts.centre),
        radius=facts.radius,
        bounded=facts.bounded,
        near=near_plane(facts.radius),
        cameras=cameras,
        splits=splits,
        to_capture=to_capture,
        refined=refined,
        exposed=any(exposure != 1 for exposure in exposures),
        splats=splats,
        environment=environment,
        occluder=Occluder(read_mesh(folder / OCCLUDER)) if (folder / OCCLUDER).exists() else None,
    )


def light_of(panorama: np.ndarray, settings: Settings, reference: Camera | None = None) -> Environment:
    """Make a light from an equirectangular image (H, W, 3) of linear radiance, in Blender's orientation.

    Without `reference`, the light stands still in the world. With `reference`, the light turns with the camera. The image then shows how
    the light is oriented in the world when the photo of the camera `reference` is taken.
    """
    panorama = method_of(settings.render).light.from_linear(panorama)
    return Environment.from_panorama(panorama, settings.environment.resolution, reference)
