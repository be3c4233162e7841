"""Write tiny data sets of photos with cameras, one function for each layout. The photos show a ball with a red top and a green bottom."""

import json
import pickle
import struct
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike
from PIL import ExifTags, Image
from pillow_heif import register_heif_opener
from scipy.spatial.transform import Rotation

from refgs.color import srgb_decode
from refgs.formats.exr import write_exr

CENTRE = np.array([1.0, 2.0, 3.0])
RADIUS = 0.5
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def bits(value: object) -> object:
    """Return a value with all that it holds in a form that can be compared: arrays as their bytes, captures and views as tuples."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        return tuple(bits(getattr(value, field.name)) for field in fields(value))
    return [bits(one) for one in value] if isinstance(value, list) else value


def look_at(position: ArrayLike, target: ArrayLike = (0, 0, 0)) -> np.ndarray:
    """Return the camera-to-world matrix (OpenGL axes) of a camera at `position` that looks at `target`, with +Z up."""
    back = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose


def ring(count: int = 16, distance: float = 3.0, centre: np.ndarray = CENTRE) -> list[np.ndarray]:
    """Return `count` camera-to-world matrices all around the ball, alternately low and high. They look at `centre` from `distance`."""
    poses = []
    for i in range(count):
        azimuth, elevation = 2 * np.pi * i / count, (0.2, 0.9)[i % 2]
        away = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        poses.append(look_at(centre + distance * np.array(away), centre))
    return poses


def ball(pose: np.ndarray, width: int, height: int, focal: float, centre: np.ndarray = CENTRE) -> np.ndarray:
    """Render the ball by ray casting: RGBA (H, W, 4) uint8. The principal point is the image's centre.

    `pose` is the camera-to-world matrix, `focal` the focal length in pixels, `centre` the ball's centre.
    """
    normals = ball_normals(pose, width, height, focal, centre)
    image = np.zeros((height, width, 4), np.uint8)
    image[..., :3] = np.where(normals[..., 2:] > 0, (220, 0, 0), (20, 200, 0))
    image[..., 3] = 255
    image[np.isnan(normals[..., 0])] = 0
    return image


def ball_normals(pose: np.ndarray, width: int, height: int, focal: float, centre: np.ndarray = CENTRE) -> np.ndarray:
    """Compute the ball's world-space normals (H, W, 3) as a camera sees them; NaN where a ray misses the ball.

    The arguments are those of `ball`.
    """
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([u / focal, -v / focal, -np.ones_like(u)], axis=-1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    offset = pose[:3, 3] - centre
    along = rays @ offset
    root = along**2 - (offset @ offset - RADIUS**2)
    point = offset + rays * (-along - np.sqrt(np.maximum(root, 0)))[..., None]
    return np.where(root[..., None] > 0, point / RADIUS, np.nan)


def write(path: Path, image: np.ndarray) -> None:
    """Write an image in the format of the path's suffix: RGB, RGBA or grey, 8 or 16 bits. Paths may have non-ASCII characters."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = image[..., [2, 1, 0, 3][: image.shape[2]]]
    cv2.imencode(path.suffix, image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tofile(path)


def write_as_phone(path: Path, image: np.ndarray, turns: int = 0, film: int | None = None) -> None:
    """Write an RGB image as a phone does that is held sideways, in the format of the path's suffix, HEIC too.

    The pixels are stored turned, and EXIF says that `turns` clockwise quarter turns (0 to 3) make them upright. `film` is the focal length
    for 35 mm film in mm, for EXIF.
    """
    register_heif_opener()
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = (1, 6, 3, 8)[turns]
    if film:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = film
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rot90(image, turns)).save(path, exif=exif.tobytes(), quality=98)


def edit(file: Path, change) -> None:
    """Read a JSON file, change its data by `change(data)`, and write it again."""
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def nerf_blender(folder: Path, splits: dict[str, int] | None = None) -> Path:
    focal = 60.0
    for split, count in (splits or {"train": 12, "test": 4}).items():
        frames = []
        for i, pose in enumerate(ring(count)):
            write(folder / split / f"r_{i}.png", ball(pose, 64, 48, focal))
            frames.append({"file_path": f"./{split}/r_{i}", "rotation": 0.1, "transform_matrix": pose.tolist()})
        data = {"camera_angle_x": 2 * np.arctan(32 / focal), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(data))
    return folder


def nerfstudio(folder: Path, count: int = 16, poses: list[np.ndarray] | None = None) -> Path:
    """Write a data set in Nerfstudio's layout. All photos share their intrinsics. They have neither alpha nor masks."""
    frames = []
    for i, pose in enumerate(poses or ring(count)):
        write(folder / "images" / f"{i:04d}.png", ball(pose, 64, 48, 60.0)[..., :3])
        frames.append({"file_path": f"images/{i:04d}.png", "transform_matrix": pose.tolist()})
    data = {"fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def move_photos(folder: Path, place: Callable[[int], str]) -> None:
    """Move the photos of a data set of `nerfstudio`: the one with index i to the path `place(i)` in the folder."""

    def move(data: dict) -> None:
        for i, frame in enumerate(data["frames"]):
            (folder / place(i)).parent.mkdir(exist_ok=True)
            (folder / frame["file_path"]).rename(folder / place(i))
            frame["file_path"] = place(i)

    edit(folder / "transforms.json", move)


def colmap(
    folder: Path,
    binary: bool = True,
    model: tuple[int, str, list[float]] = (1, "PINHOLE", [60.0, 60.0, 32.0, 24.0]),
    count: int = 16,
) -> Path:
    """Write a data set in COLMAP's layout: `count` photos, one camera, and 50 points on the ball.

    `model` is the camera model's number, name and parameters. COLMAP's files are binary or text.
    """
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    points = CENTRE + RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)
    images = []
    for i, pose in enumerate(ring(count)):
        write(folder / "images" / f"{i:04d}.png", ball(pose, 64, 48, 60.0)[..., :3])
        world_to_camera = np.linalg.inv(pose @ FLIP)
        turn = Rotation.from_matrix(world_to_camera[:3, :3])
        images.append((i + 1, *turn.as_quat(scalar_first=True), *world_to_camera[:3, 3], 7, f"{i:04d}.png"))
    number, name, params = model
    if binary:
        data = struct.pack("<QiiQQ", 1, 7, number, 64, 48) + struct.pack(f"<{len(params)}d", *params)
        (sparse / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", count)
        for image in images:
            data += struct.pack("<I7di", *image[:9]) + image[9].encode() + b"\0" + struct.pack("<Q", 2)
            data += struct.pack("<ddqddq", 1, 2, -1, 3, 4, 5)
        (sparse / "images.bin").write_bytes(data)
        data = struct.pack("<Q", 50)
        for i, point in enumerate(points):
            data += struct.pack("<Q3d3BdQ", i, *point, 255, 128, 0, 0.5, 2) + struct.pack("<iiii", 1, 0, 2, 1)
        (sparse / "points3D.bin").write_bytes(data)
    else:
        text = f"# Camera list\n# Number of cameras: 1\n7 {name} 64 48 {' '.join(map(repr, params))}\n"
        (sparse / "cameras.txt").write_text(text)
        text = f"# Image list\n# Number of images: {count}, mean observations per image: 1\n"
        for image in images:
            text += " ".join(map(str, image)) + "\n" + ("1 2 -1 3 4 5" if image[0] % 2 else "") + "\n"
        (sparse / "images.txt").write_text(text)
        rows = (f"{i} {x!r} {y!r} {z!r} 255 128 0 0.5 1 0 2 1\n" for i, (x, y, z) in enumerate(points.tolist()))
        (sparse / "points3D.txt").write_text("# Number of points: 50, mean track length: 2\n" + "".join(rows))
    return folder


def shiny_blender(folder: Path) -> Path:
    """Write a data set in the layout of Ref-NeRF's scene `ball`: opaque photos, NAME_alpha.png, world-space normals and disparities."""
    nerf_blender(folder)
    for split in ("train", "test"):
        frames = json.loads((folder / f"transforms_{split}.json").read_text())["frames"]
        for frame in frames:
            photo = folder / f"{frame['file_path']}.png"
            pose = np.array(frame["transform_matrix"])
            image = ball(pose, 64, 48, 60.0)
            inside = image[..., 3] > 0
            write(photo, np.where(inside[..., None], image[..., :3], 40).astype(np.uint8))
            write(photo.with_name(f"{photo.stem}_alpha.png"), image[..., 3])
            normal = np.where(inside[..., None], ball_normals(pose, 64, 48, 60.0), 0)
            write(photo.with_name(f"{photo.stem}_normal.png"), np.rint(127.5 * (normal + 1)).astype(np.uint8))
            write(photo.with_name(f"{photo.stem}_disp.tiff"), image[..., 3])
    return folder


def nero(folder: Path, count: int = 16, split: tuple[list, list] | None = None, protocol: int = 4) -> Path:
    """Write a data set in the layout of NeRO's Glossy Synthetic: opaque photos, 16-bit depth, pickled cameras.

    `split`, if given, lists the training and test views; it is pickled into a file beside `folder`. `protocol` is pickle's version.
    """
    folder.mkdir(parents=True)
    for i, pose in enumerate(ring(count)):
        image = ball(pose, 64, 48, 60.0)
        inside = image[..., 3] > 0
        write(folder / f"{i}.png", np.where(inside[..., None], image[..., :3], 40).astype(np.uint8))
        depth = np.where(inside, 2.5 / 15 * 65535, 65535)
        write(folder / f"{i}-depth.png", np.rint(depth).astype(np.uint16))
        world_to_camera = np.linalg.inv(pose @ FLIP)[:3]
        matrix = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
        (folder / f"{i}-camera.pkl").write_bytes(pickle.dumps((world_to_camera, matrix), protocol))
    if split is not None:
        (folder.parent / "synthetic_split_128.pkl").write_bytes(pickle.dumps(split, protocol))
    return folder


def tensoir(folder: Path, splits: dict[str, int] | None = None, side: int = 64) -> Path:
    """Write a scene in the layout of TensoIR-Synthetic, and panoramas beside it. Photos have `side` × `side` pixels.

    The true base colour is half the photo's. Under the light "bridge" the photo is darker by a third; other lights are not there.
    """
    focal = 60.0 / 64 * side
    for split, count in (splits or {"train": 12, "val": 2, "test": 4}).items():
        for i, pose in enumerate(ring(count)):
            view, image = folder / f"{split}_{i:03d}", ball(pose, side, side, focal)
            inside = image[..., 3:]
            normal = np.where(inside > 0, ball_normals(pose, side, side, focal), 0)
            write(view / "rgba.png", image)
            write(view / "rgba_bridge.png", np.dstack([image[..., :3] // 3 * 2, inside]))
            write(view / "normal.png", np.dstack([np.rint(127.5 * (normal + 1)).astype(np.uint8), inside]))
            write(view / "albedo.png", np.dstack([image[..., :3] // 2, inside]))
            camera = {"cam_angle_x": 2 * np.arctan(side / 2 / focal), "imw": side, "imh": side}
            camera["cam_transform_mat"] = ",".join(map(str, pose.ravel().tolist()))
            (view / "metadata.json").write_text(json.dumps(camera))
    maps = folder.parent / "Environment_Maps" / "high_res_envmaps_2k"
    write(maps / "bridge.hdr", np.full((8, 16, 3), 0.5, np.float32))
    return folder


def stanford_orb(data: Path, suffix: str = ".exr", side: int = 64) -> Path:
    """Write two scenes of one object in the layout of Stanford-ORB, and their ground truth. Return the folder of the first.

    `data` becomes the folder that holds blender_HDR or blender_LDR, and ground_truth. `suffix` is the photos'. The light of a test photo
    is 3 where the camera looks, 1 to its left, 0.5 above it, and 0.2 elsewhere.
    """
    focal, blender = 60.0 / 64 * side, data / f"blender_{'HDR' if suffix == '.exr' else 'LDR'}"
    first, second = blender / "ball_scene001", blender / "ball_scene002"
    angle = 2 * np.arctan(side / 2 / focal)
    for scene, scale in ((first, 1.0), (second, 0.5)):
        truth = data / "ground_truth" / scene.name
        for split, count in {"train": 12, "test": 4}.items():
            frames = []
            for i, pose in enumerate(ring(count)):
                name, image = f"{i:04d}", ball(pose, side, side, focal)
                mask, normals = image[..., 3], ball_normals(pose, side, side, focal)
                photo = scene / split / f"{name}{suffix}"
                if suffix == ".exr":
                    photo.parent.mkdir(parents=True, exist_ok=True)
                    write_exr(photo, scale * srgb_decode(image[..., :3] / 255.0))
                else:
                    write(photo, image[..., :3])
                write(scene / f"{split}_mask" / f"{name}.png", mask)
                frames.append({"file_path": f"./{split}/{name}", "transform_matrix": pose.tolist()})
                if split == "test":
                    _orb_truth(truth, name, pose, normals, focal)
            text = json.dumps({"camera_angle_x": angle, "frames": frames})
            (scene / f"transforms_{split}.json").write_text(text)
    for scene, other in ((first, second), (second, first)):
        frames = json.loads((other / "transforms_test.json").read_text())["frames"]
        novel = [frame | {"scene_name": other.name, "camera_angle_x": angle} for frame in frames]
        (scene / "transforms_novel.json").write_text(json.dumps({"frames": novel}))
    return first


def _orb_truth(truth: Path, name: str, pose: np.ndarray, normals: np.ndarray, focal: float) -> None:
    """Write the true maps of a test photo: normals and depth by the camera's axes, base colour, and the light around the camera."""
    for what in ("surface_normal", "z_depth", "env_map"):
        (truth / what).mkdir(parents=True, exist_ok=True)
    missed = np.isnan(normals[..., :1])
    seen = np.where(missed, 0, normals @ pose[:3, :3])  # OpenGL's axes
    depth = -(CENTRE + RADIUS * normals - pose[:3, 3]) @ pose[:3, 2]
    np.save(truth / "surface_normal" / f"{name}.npy", seen.astype(np.float32))
    np.save(truth / "z_depth" / f"{name}.npy", np.where(missed[..., 0], 0, depth).astype(np.float32))
    image = ball(pose, *normals.shape[1::-1], focal)
    write(truth / "pseudo_gt_albedo" / f"{name}.png", image[..., :3] // 2)
    light = np.full((16, 32, 3), 0.2, np.float32)
    light[6:10, 14:18], light[6:10, 6:10], light[:3] = 3, 1, 0.5
    write_exr(truth / "env_map" / f"{name}.exr", light)
