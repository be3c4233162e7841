"""Place cameras around a scene, render it, and write photos, cameras and ground truth. `write_capture` lists the files."""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import trimesh

from refgs.color import srgb_encode
from refgs.errors import InputError
from refgs.formats.exr import write_exr
from scripts.demo.cycles import FIELD_OF_VIEW, Renderer
from scripts.demo.light import read_light
from scripts.demo.shapes import Scene


def write_capture(
    scene: Scene,
    out: Path,
    size: int,
    train: int,
    test: int,
    samples: int,
    relight: list[str],
    progress: Callable[[int, int, str], None],
) -> None:
    """Render `scene` into the new folder `out`: photos, cameras and ground truth, laid out like the data set NeRF-Blender.

    Z is up; cameras look along −z. Photos have `size` × `size` pixels. `train` and `test` are the numbers of training and test views;
    `samples` is Cycles' number of samples a pixel. `relight` names HDRIs of Blender under which the test views are rendered again.

        transforms_{train,test}.json    camera_angle_x, fl_x fl_y cx cy w h, and frames: file_path, transform_matrix
        {train,test}/NAME.png           8-bit sRGB, straight alpha
        ground_truth/
            light.exr                   the panorama that lights the photos, (512, 1024) RGB, as Blender's world shows it
            mesh.ply                    the true mesh
            color/NAME.exr              test views: linear, premultiplied RGBA, before clipping and rounding
            normal|albedo/NAME.exr      RGB: world-space unit normal; base colour
            roughness|metallic|depth|alpha/NAME.exr     Y: one channel; depth along the camera's axis
            visibility/NAME.exr         Y: 1 where the ray mirrored at the true normal leaves the object, 0 where the object
                                        occludes it
            relight/HDRI/NAME.exr       color of the test views under another panorama, which is relight/HDRI.exr

    All files but the photos are float32. In a partly covered pixel, albedo, roughness, metallic, depth, visibility and normal (normalised
    again) are means over the covered part. They are zero where alpha is zero.

    `progress(done, total, what)` is called after every view; `what` is a text such as "train views". Raises InputError if `out` exists or
    an HDRI is unknown.
    """
    if out.exists():
        raise InputError(f"{out} exists: choose another folder, or remove it")
    light = read_light(scene.light) if isinstance(scene.light, str) else scene.light
    panoramas = {name: read_light(name) for name in relight}
    # The object's bounding sphere fits with a margin: no silhouette touches the edge of a photo.
    distance = 1.04 * np.linalg.norm(scene.mesh.vertices, axis=1).max() / np.sin(FIELD_OF_VIEW / 2)
    total, done = train + test * (1 + len(relight)), 0
    out.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        truth = folder / "ground_truth"
        truth.mkdir()
        write_exr(truth / "light.exr", light)
        trimesh.Trimesh(scene.mesh.vertices, scene.mesh.triangles, process=False).export(truth / "mesh.ply")
        renderer = Renderer(scene.mesh, scene.materials, size, samples)
        renderer.set_light(truth / "light.exr")
        splits = {"train": sphere_cameras(train, distance, scene.lowest, 0.0)}
        # Turn the test cameras, so that no test view coincides with a training view.
        splits["test"] = sphere_cameras(test, distance, scene.lowest, np.pi / 3)
        for split, cameras in splits.items():
            (folder / split).mkdir()
            (folder / f"transforms_{split}.json").write_text(json.dumps(_transforms(split, cameras, size), indent=1))
            for index, camera in enumerate(cameras):
                name = _name(split, index)
                passes = renderer.render(camera, seed=done)
                if split == "test":
                    # The same seed as the picture's, so alpha is the same.
                    passes["visibility"] = renderer.visibility(camera, seed=done)
                _write_photo(folder / split / f"{name}.png", passes["color"])
                if split == "test":
                    for kind, pixels in passes.items():
                        (truth / kind).mkdir(exist_ok=True)
                        write_exr(truth / kind / f"{name}.exr", pixels)
                done += 1
                progress(done, total, f"{split} views")
        for hdri, panorama in panoramas.items():
            (truth / "relight" / hdri).mkdir(parents=True)
            write_exr(truth / "relight" / f"{hdri}.exr", panorama)
            renderer.set_light(truth / "relight" / f"{hdri}.exr")
            for index, camera in enumerate(splits["test"]):
                pixels = renderer.render(camera, seed=done)["color"]
                write_exr(truth / "relight" / hdri / f"{_name('test', index)}.exr", pixels)
                done += 1
                progress(done, total, f"test views under {hdri}")
        folder.chmod(0o755)  # mkdtemp makes a private folder
        folder.rename(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sphere_cameras(count: int, distance: float, lowest: float, turn: float) -> np.ndarray:
    """Place cameras evenly on a sphere around the origin, where z > `lowest`·`distance`, along a Fibonacci spiral.

    `distance` is the sphere's radius. `turn` rotates the spiral about z, in radians.

    Returns (count, 4, 4) camera-to-world matrices with OpenGL's axes. The cameras look at the origin, with +z up.
    """
    steps = np.arange(count) + 0.5
    z = lowest + (1 - lowest) * steps / count
    azimuth = turn + steps * np.pi * (3 - np.sqrt(5))
    back = np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], -1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], -1)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3] = np.stack([right, np.cross(back, right), back, distance * back], -1)
    return matrices


def _name(split: str, index: int) -> str:
    return f"{split}_{index:03d}"


def _transforms(split: str, cameras: np.ndarray, size: int) -> dict:
    focal = 0.5 * size / np.tan(0.5 * FIELD_OF_VIEW)
    return {
        "camera_angle_x": FIELD_OF_VIEW,
        "fl_x": focal,
        "fl_y": focal,
        "cx": size / 2,
        "cy": size / 2,
        "w": size,
        "h": size,
        "frames": [
            {"file_path": f"./{split}/{_name(split, index)}", "transform_matrix": camera.tolist()}
            for index, camera in enumerate(cameras)
        ],
    }


def _write_photo(path: Path, color: np.ndarray) -> None:
    """Write `color` (linear, premultiplied RGBA) as an 8-bit sRGB file with straight alpha, clipped at one.

    Blender's view transform "Standard" gives the same colours.
    """
    alpha = color[..., 3:]
    straight = color[..., :3] / np.where(alpha > 0, alpha, 1)
    pixels = np.concatenate([srgb_encode(straight).clip(0, 1), alpha], -1)
    cv2.imwrite(str(path), np.round(pixels[..., [2, 1, 0, 3]] * 255).astype(np.uint8))
