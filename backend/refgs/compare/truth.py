"""Read the ground truth of a capture (normals, light and so on), and measure the errors of renderings against it."""

from pathlib import Path

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.capture import View, published_normals
from refgs.capture.poses import split_similarity
from refgs.capture.reduce import reduced_map
from refgs.compare import metrics
from refgs.errors import InputError
from refgs.formats.exr import read_exr
from refgs.formats.mesh import Mesh, read_mesh
from refgs.formats.panorama import directions, read_environment, sample
from refgs.render.rendering import SOLID

FOLDER = "ground_truth"  # in a capture that has its own
PASSES = ("normal", "albedo", "roughness", "metallic", "visibility")


class GroundTruth:
    """Read a folder of ground truth: true pictures, lights and mesh of a captured object. Every file is optional.

    - light.exr: the light, as a panorama
    - mesh.ply: the mesh
    - normal/VIEW.exr: the normals of the view named VIEW. The folders of the other maps have the names in PASSES.
    - alpha/VIEW.exr: the object's alpha in this view; views with maps must have it
    - color/VIEW.exr: the view under the photos' light
    - relight/HDRI.exr: another light, named HDRI
    - relight/HDRI/VIEW.exr: the view under this light

    `scripts.demo.capture` writes these files. Normals, lights and the mesh are converted to the coordinates of the training. `to_capture`
    is the matrix (4, 4) from these coordinates to the capture's.
    """

    def __init__(self, folder: Path, to_capture: np.ndarray):
        self.folder, self._to_run = folder, np.linalg.inv(to_capture)
        self._turn = self._to_run[:3, :3] / np.cbrt(np.linalg.det(self._to_run[:3, :3]))
        self.passes: list[str] = []
        self.hdris: list[str] = []
        self.has_light = self.has_mesh = False
        self._find()

    def _find(self) -> None:
        """Find the folder's maps, lights and mesh. Raises InputError if it has none."""
        self.passes = [name for name in PASSES if (self.folder / name).is_dir()]
        relit = (self.folder / "relight").iterdir() if (self.folder / "relight").is_dir() else ()
        self.hdris = sorted({file.stem for file in relit if file.is_dir() or file.suffix == ".exr"})
        self.has_light, self.has_mesh = ((self.folder / name).exists() for name in ("light.exr", "mesh.ply"))
        if not (self.passes or self.hdris or self.has_light or self.has_mesh):
            known = ", ".join([f"{name}/" for name in PASSES] + ["relight/", "light.exr", "mesh.ply"])
            raise InputError(f"{self.folder}: there is no ground truth in it; known are {known}")

    def maps(self, camera: Camera) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Read the true maps of the camera's view by name, float32 (h, w) or (h, w, 3), and the object's alpha (h, w).

        Larger maps are reduced. If the folder has no maps, return {} and an alpha of 0. Raises InputError in these cases:

        - A file is missing or has too few channels.
        - A map has another size than the alpha.
        - A size does not fit the view (see `check_size`).
        """
        size = camera.height, camera.width
        if not self.passes:
            return {}, np.zeros(size, np.float32)
        known, alpha = {name: self._read(name, camera) for name in self.passes}, self._read("alpha", camera)
        if different := [name for name, pixels in known.items() if pixels.shape[:2] != alpha.shape]:
            raise InputError(
                f"{self.folder}: {different[0]}/{camera.name}.exr is not as large as the alpha of this view"
            )
        if alpha.shape != size:
            known = {name: reduced_map(pixels, alpha, camera)[0] for name, pixels in known.items()}
            alpha = cv2.resize(alpha, size[::-1], interpolation=cv2.INTER_AREA)
            if "normal" in known:  # the mean of unit vectors is shorter
                known["normal"] /= np.maximum(np.linalg.norm(known["normal"], axis=-1, keepdims=True), 1e-6)
        if "normal" in known:
            known["normal"] = known["normal"] @ self._turn.T.astype(np.float32)
        return known, alpha

    def _read(self, name: str, camera: Camera) -> np.ndarray:
        file = self.folder / name / f"{camera.name}.exr"
        pixels = read_exr(file, is_data=name != "albedo")
        check_size(file, pixels, camera)
        channels = {"normal": 3, "albedo": 3}.get(name, 1)
        if pixels.ndim == 2 and channels > 1:
            raise InputError(f"{file}: it has one channel where there should be {channels}")
        if channels == 1:
            return pixels if pixels.ndim == 2 else pixels[..., 0]
        return pixels[..., :3]

    def panorama(self, name: str) -> np.ndarray:
        """Read the light in the file `name`.exr; `name` is "light" or "relight/HDRI". Return a panorama (H, W, 3) of linear radiance.

        The panorama is equirectangular, in Blender's orientation, and rotated to the coordinates of the training.
        """
        panorama = read_environment(self._light_file(name))
        return sample(panorama, directions(*panorama.shape[:2]) @ self._turn.astype(np.float32))

    def _light_file(self, name: str) -> Path:
        return self.folder / f"{name}.exr"

    def mesh(self) -> Mesh:
        mesh = read_mesh(self.folder / "mesh.ply")
        return Mesh(mesh.vertices @ self._to_run[:3, :3].T + self._to_run[:3, 3], mesh.faces)

    def relit(self, hdri: str, camera: Camera) -> np.ndarray:
        """Read the true view under the light `hdri` as premultiplied linear RGBA (h, w, 4)."""
        return self._picture(f"relight/{hdri}", camera)

    def color(self, camera: Camera) -> np.ndarray:
        """Read the true view under the photos' light as premultiplied linear RGBA (h, w, 4)."""
        return self._picture("color", camera)

    def _picture(self, folder: str, camera: Camera) -> np.ndarray:
        file = self.folder / folder / f"{camera.name}.exr"
        pixels = read_relit(file)
        check_size(file, pixels, camera)
        return cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def check_size(file: Path, pixels: np.ndarray, camera: Camera) -> None:
    """Raise InputError unless a true picture has its view's size or is proportionally larger."""
    (height, width), size = pixels.shape[:2], f"{camera.width}×{camera.height}"
    fitted = camera.resized(width, height).fitted(max(camera.width, camera.height))
    if (fitted.width, fitted.height) != (camera.width, camera.height):
        raise InputError(f"{file} has {width}×{height} pixels, which does not fit its view of {size}")


def read_relit(file: Path) -> np.ndarray:
    """Read a relit picture as premultiplied linear RGBA (H, W, 4). Raises InputError without alpha."""
    pixels = read_exr(file)
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        raise InputError(f"{file} has no alpha: an RGBA picture is needed to put it over a background")
    return pixels


def known_maps(
    truth: GroundTruth | None, view: View, camera: Camera, to_capture: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Read one view's true maps, such as normals and base colour, by name. Returns them, and the object's alpha (h, w).

    If `truth` is None or has no maps, read the true normals that some published captures contain. If the capture has no true normals
    either, return {} and an alpha of 0. `camera` is the view's camera, resized to the rendering. `to_capture` is the matrix (4, 4) from the
    training's coordinates to the capture's.
    """
    known, alpha = truth.maps(camera) if truth else ({}, np.zeros((camera.height, camera.width), np.float32))
    if not known and (published := published_normals(view, max(camera.width, camera.height))):
        turn = split_similarity(to_capture)[1].astype(np.float32)
        known, alpha = {"normal": published[0] @ turn}, published[1]
    return known, alpha


def errors(images: dict[str, np.ndarray], known: dict[str, np.ndarray], true_alpha: np.ndarray) -> dict:
    """Measure the errors of one view's rendered maps against the true maps. Returns them by name; {} if the object covers no pixel.

    `images` are the rendered maps (see `pictures.maps`), `known` the true ones (see `known_maps`). The entry `albedo` is not an error, but
    the view's result of `metrics.channel_products`. From these results, `metrics.aligned_psnr` computes one error of base colour for all
    views.
    """
    figures, covered, alpha = {}, true_alpha >= SOLID, images["alpha"]
    for name, true in known.items() if covered.any() else ():
        if name == "normal":
            figures["normal_mae_degrees"] = metrics.normal_mae_degrees(images["normal"], true, alpha, true_alpha)
        elif name == "visibility":
            free, truly = (v[covered] >= 0.5 for v in (images.get(name, np.ones_like(alpha)), true))
            figures |= {"visibility_agreement": float((free == truly).mean()), "visibility_free": float(truly.mean())}
        elif name == "albedo" and name in images:
            figures[name] = metrics.channel_products(images[name], true, covered)
        elif name in images:
            difference = np.abs(images[name] - true)[covered]
            figures[f"{name}_mae"] = float(difference.mean(dtype=np.float64))
            if name == "metallic":  # the part taken for the other kind
                figures["metallic_wrong"] = float((difference > 0.5).mean())
    return figures
