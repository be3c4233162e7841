"""The run folder: what a training leaves, and the only thing that rendering, evaluation, export and Blender read."""

import platform
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tomli_w
import torch

from refgs import __version__
from refgs.camera import Camera
from refgs.capture import Capture, read_run_cameras, write_cameras
from refgs.color import srgb_encode
from refgs.errors import InputError
from refgs.export.environment import read_environment
from refgs.export.splats import Splats, read_splats
from refgs.geometry.mesh import read_mesh
from refgs.geometry.visibility import Occluder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels, from_splats
from refgs.paths import whole
from refgs.render.relight import Progress, Transport, relit
from refgs.render.renderer import Rendering, near_plane, render
from refgs.settings import Settings, recorded_settings

OCCLUDER = "occluder.ply"  # the mesh that inter-reflection was traced on, where there was any


@dataclass(frozen=True)
class Run:
    """A finished run, ready to render. Cameras are in the run's frame and of the photos' full size."""

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
    exposed: bool  # photos were found to have exposures of their own
    splats: Splats
    environment: Environment | None
    occluder: Occluder | None
    _traced: dict = field(default_factory=dict, repr=False, compare=False)

    def surfels(self) -> Surfels:
        """The asset's surfels as tensors."""
        return from_splats(self.splats)

    def training_cameras(self) -> list[Camera]:
        """The cameras of the photos that were trained on, at the size they were trained at."""
        side = self.settings.image.max_side
        return [c.fitted(side) for c, split in zip(self.cameras, self.splits, strict=True) if split == "train"]

    def light(self, panorama: np.ndarray) -> Environment:
        """Another light for `render`: an equirectangular picture (H, W, 3) of linear radiance, in Blender's orientation."""
        return light_of(panorama, self.settings)

    def relit(self, light: Environment, progress: Progress = lambda done, total: None) -> Surfels:
        """The surfels under another light, with what they receive of each other where the run has a mesh to trace that on:
        seconds for the first light, less for others, nothing for the last one again. `progress` hears how much is traced."""
        if self.occluder is None:
            return self.surfels().without_directions()  # they were true under the recovered light
        with torch.no_grad():
            if "transport" not in self._traced:
                surfels = self.surfels()
                inward = (surfels.normals() * torch.from_numpy(self.splats.normals)).sum(dim=-1) < 0
                self._traced["transport"] = Transport(surfels.turned(inward), self.occluder, progress=progress)
            if self._traced.get("light") is not light:
                # Drawn as they were learned: near the horizon it matters which way a surfel's normal points.
                found = relit(self._traced["transport"], light)._replace(rotations=self.surfels().rotations)
                self._traced.update(light=light, surfels=found)
        return self._traced["surfels"]

    def render(self, camera: Camera, environment: Environment | None = None, exposure: float = 1.0) -> Rendering:
        """Render a camera of the run's frame, under another light where one is given; the picture is exposed so much more."""
        surfels, settings = self.surfels(), self.settings.render
        if environment is not None:
            surfels = self.relit(environment)
            diffuse = "irradiance" if self.occluder is None else "sh"
            reflection = "none" if settings.reflection == "none" else "microfacet"
            settings = settings.model_copy(update={"diffuse": diffuse, "reflection": reflection})
        light, background = environment or self.environment, torch.tensor(self.settings.image.background)
        with torch.no_grad():
            return render(
                surfels, light, camera, background, settings, self.near, self.occluder, torch.tensor(exposure)
            )


def create_run(
    folder: Path, capture: Capture, settings: Settings, preset: str, device: str, chosen: dict[str, str] | None = None
) -> None:
    """Make a new run folder with its run.toml and cameras.json. Raises InputError where the folder is taken.

    `chosen` says of a setting that was "auto" what was chosen, and why; `settings` have it already.
    """
    check_free(folder)
    try:
        (folder / "checkpoints").mkdir(parents=True)
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
    write_text(folder / "run.toml", tomli_w.dumps(facts))
    write_cameras(folder / "cameras.json", capture, settings.light.frame)


def record_changes(folder: Path, rows: dict[str, dict]) -> None:
    """Add to run.toml's [changed] what else changed a setting. What was asked stays as the first process recorded it."""
    if not rows:
        return
    tables = tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))
    known = tables.get("changed", {})
    rows = {key: row | {"asked": known.get(key, row)["asked"]} for key, row in rows.items()}
    write_text(folder / "run.toml", tomli_w.dumps(tables | {"changed": known | rows}))


def check_free(folder: Path) -> None:
    """Raise InputError unless a new run can go into the folder."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        what = "holds another run" if (folder / "run.toml").exists() else "is not empty"
        raise InputError(f"{folder} {what}: choose another folder with --out, or go on with that run with --resume")


def read_run_facts(folder: Path) -> tuple[dict, Settings]:
    """What run.toml says: its [run] table and its settings. Raises InputError for none, and for that of a newer release."""
    file = folder / "run.toml"
    try:
        facts = tomllib.loads(file.read_text(encoding="utf-8"))
        made_by = facts["run"]["refgs"]
        if _release(made_by) > _release(__version__):
            raise InputError(
                f"{folder} was made by RefGS {made_by}, which is newer than this, {__version__}: update RefGS"
            )
        return facts["run"], recorded_settings(facts["settings"], str(file))
    except FileNotFoundError:
        raise InputError(f"{folder} is not a run folder: there is no run.toml in it") from None
    except (OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{file} is broken ({error}): train again") from None


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in version.split(".")[:2])  # the third only mends


def open_run(folder: Path) -> Run:
    """Read a finished run. Raises InputError naming what is missing."""
    facts, settings = read_run_facts(folder)
    if not (folder / "splats.ply").exists():
        raise InputError(f"{folder}: the training has not ended: go on with `refgs train … --out {folder} --resume`")
    cameras, splits, to_capture, exposures = read_run_cameras(folder / "cameras.json")
    splats, environment = read_splats(folder / "splats.ply"), None
    if (
        settings.render.reflection != "mirror"
    ):  # the splats say whether anything is mirrored: edits may have changed that
        reflection = "none" if splats.constants.get("specular") == 0 else "microfacet"
        settings = settings.model_copy(update={"render": settings.render.model_copy(update={"reflection": reflection})})
    if settings.render.shading != "sh":
        reference = next(c for c, split in zip(cameras, splits, strict=True) if split == "train")
        panorama = read_environment(folder / "environment.exr")
        environment = light_of(panorama, settings, reference if settings.light.frame == "camera" else None)
    return Run(
        folder=folder,
        settings=settings,
        capture_folder=Path(facts["capture"]),
        fingerprint=facts["fingerprint"],
        centre=np.array(facts["centre"]),
        radius=facts["radius"],
        bounded=facts["bounded"],
        near=near_plane(facts["radius"]),
        cameras=cameras,
        splits=splits,
        to_capture=to_capture,
        exposed=any(exposure != 1 for exposure in exposures),
        splats=splats,
        environment=environment,
        occluder=Occluder(read_mesh(folder / OCCLUDER)) if (folder / OCCLUDER).exists() else None,
    )


def light_of(panorama: np.ndarray, settings: Settings, reference: Camera | None = None) -> Environment:
    """An equirectangular picture (H, W, 3) of linear radiance, in Blender's orientation, as the light of a run with these settings."""
    display = settings.render.color_space == "display"
    panorama = srgb_encode(panorama) if display else panorama
    return Environment.from_panorama(panorama, settings.environment.resolution, reference)


def write_text(file: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with whole(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
