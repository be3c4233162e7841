"""Read the ground truth of two published data sets, TensoIR-Synthetic and Stanford-ORB. `refgs.compare.truth` reads other ground truth.

`refgs.capture.tensoir` and `refgs.capture.stanford_orb` describe the files, and name the sources of these descriptions.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.capture import Capture, View
from refgs.capture.images import read_image, read_mask
from refgs.capture.poses import in_frame
from refgs.capture.stanford_orb import novel_views
from refgs.capture.tensoir import LIGHTS, light_folder
from refgs.color import srgb_decode
from refgs.compare.truth import GroundTruth, check_size
from refgs.errors import InputError
from refgs.formats.arrays import read_array
from refgs.formats.panorama import directions, read_environment, sample

# OpenCV's camera axes to those in which `refgs.formats.panorama` has its directions: forward, left, up.
_FORWARD_LEFT_UP = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float32)


class TensoIRTruth(GroundTruth):
    """Read the true normals and base colour of a scene of TensoIR-Synthetic, and its views under other lights.

    `folder` is the scene's folder. It has a folder for each view, with the view's name.
    """

    def _find(self) -> None:
        first, lights = self.folder / "train_000", light_folder(self.folder)
        self.passes = [name for name in ("normal", "albedo") if (first / f"{name}.png").is_file()]
        if lights is not None:
            self._lights = lights
            known = [light for light in LIGHTS if self._light_file(light).is_file()]
            self.hdris = [light for light in known if (first / f"rgba_{light}.png").is_file()]

    def _read(self, name: str, camera: Camera) -> np.ndarray:
        pixels, alpha = self._pixels(self.passes[0] if name == "alpha" else name, camera)
        if name == "alpha":
            return alpha
        if name == "albedo":
            return pixels
        normals = (2 * pixels - 1) * (alpha > 0)[..., None]
        return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)

    def _light_file(self, name: str) -> Path:
        return self._lights / f"{Path(name).name}.hdr"

    def relit(self, hdri: str, camera: Camera) -> np.ndarray:
        pixels, alpha = self._pixels(f"rgba_{hdri}", camera)
        linear = np.dstack([srgb_decode(pixels) * alpha[..., None], alpha]).astype(np.float32)
        return cv2.resize(linear, (camera.width, camera.height), interpolation=cv2.INTER_AREA)

    def _pixels(self, name: str, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Read `name`.png of a view as float32 pixels and alpha in 0..1. Raises InputError."""
        file = self.folder / camera.name / f"{name}.png"
        pixels, alpha = read_image(file, is_data=True)
        check_size(file, pixels, camera)
        alpha = np.full(pixels.shape[:2], 255, np.uint8) if alpha is None else alpha
        return pixels.astype(np.float32) / 255, alpha.astype(np.float32) / 255


class StanfordORBTruth(GroundTruth):
    """Read the true normals, depths and base colour of a scene of Stanford-ORB, and photos of its object under the lights of other scenes.

    `folder` is the scene's folder. The scene's test photos have true maps. In the files of the maps, normals are in OpenGL's camera axes
    (`scripts/preprocess/mesh_to_depth.py` in Stanford-ORB's repository). Base colour is sRGB-encoded (`orb/utils/test.py`).
    """

    def _find(self) -> None:
        self._truths = truth_folder(self.folder)
        files = {"normal": "surface_normal/*.npy", "albedo": "pseudo_gt_albedo/*.png"}
        self.passes = [name for name, some in files.items() if any((self._truths / self.folder.name).glob(some))]

    def _read(self, name: str, camera: Camera) -> np.ndarray:
        if name == "albedo":
            file = self._file("pseudo_gt_albedo", f"{camera.name}.png")
            pixels = srgb_decode(read_image(file)[0].astype(np.float32) / 255)
        elif name == "normal":
            file = self._file("surface_normal", f"{camera.name}.npy")
            seen = _load(file, 3) @ np.diag([1.0, -1, -1])  # by OpenCV's axes
            pixels = (seen @ camera.world_to_camera[:3, :3] @ self._turn).astype(
                np.float32
            )  # in the capture's coordinates
        else:
            file = self.folder / "test_mask" / f"{camera.name}.png"
            pixels = read_mask(file).astype(np.float32) / 255
            if "normal" in self.passes:  # the scanned mesh does not fill the mask everywhere
                pixels *= np.linalg.norm(self._read("normal", camera), axis=-1) > 0.5
        check_size(file, pixels, camera)
        return pixels

    def depth(self, camera: Camera) -> np.ndarray | None:
        """Read a view's true depth (h, w) in the capture's units, or None."""
        file = self._file("z_depth", f"{camera.name}.npy")
        if not file.parent.is_dir():
            return None
        depth = _load(file, 1)
        check_size(file, depth, camera)
        return cv2.resize(depth.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)

    def novel_views(self) -> list[View]:
        """Return views in other scenes whose light is known, in the training's coordinates."""
        found = [view for scene, view in novel_views(self.folder) if (self._truths / scene / "env_map").is_dir()]
        return [replace(view, camera=in_frame(view.camera, self._to_run)) for view in found]

    def light(self, view: View) -> np.ndarray:
        """Read the light under which a view's photo was taken. Return a panorama (H, W, 3), rotated to the coordinates of the training.

        The panorama in the file is in the camera's coordinates. Its middle shows the direction in which the camera looks. Its top is the
        camera's top, and its right side is the camera's right. This is the convention of `env_map_to_cam_to_world_by_convention` in
        `orb/utils/env_map.py` of Stanford-ORB's repository.
        """
        scene = view.image_path.resolve().parent.parent.name
        panorama = read_environment(self._truths / scene / "env_map" / f"{view.image_path.stem}.exr")
        turn = _FORWARD_LEFT_UP @ view.camera.world_to_camera[:3, :3].astype(np.float32)
        return sample(panorama, directions(*panorama.shape[:2]) @ turn.T)

    def _file(self, kind: str, name: str) -> Path:
        return self._truths / self.folder.name / kind / name


def published_truth(capture: Capture, to_capture: np.ndarray) -> GroundTruth | None:
    """Return the ground truth of a capture that is a scene of a published data set. Return None for other captures.

    `to_capture` is the matrix (4, 4) from the training's coordinates to the capture's.
    """
    if capture.layout == "tensoir":
        return TensoIRTruth(capture.folder, to_capture)
    if capture.layout == "stanford-orb" and truth_folder(capture.folder).is_dir():
        return StanfordORBTruth(capture.folder, to_capture)
    return None


def truth_folder(folder: Path) -> Path:
    """Return the folder `ground_truth` of Stanford-ORB, for a scene's folder in blender_HDR or blender_LDR."""
    return folder.resolve().parent.parent / "ground_truth"


def _load(file: Path, channels: int) -> np.ndarray:
    """Load an array (H, W) or (H, W, channels) from a .npy file. Raises InputError."""
    try:
        pixels = read_array(file, "Download the data set again.")
    except FileNotFoundError:
        raise InputError(f"{file} is missing") from None
    pixels = np.squeeze(pixels)
    if pixels.shape[2:] != ((channels,) if channels > 1 else ()) or pixels.ndim < 2:
        raise InputError(f"{file}: an array of {pixels.shape}, where a picture is needed. Download the data set again.")
    return pixels
