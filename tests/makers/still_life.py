"""Write the output folder of a training on a ball that stands on a floor."""

import json

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tests.makers.captures import look_at
from tests.makers.distances import spread
from tests.makers.runs import COLUMNS, write_panorama, write_ply

BALL, SIDE = 1500, 40  # splats of a ball of radius 1, and along a side of the floor below it, which is 4 wide
FAINT = 100  # splats in the ball that are nearly transparent
PHOTOS = {"left": (255, 0, 255), "right": (0, 255, 0)}  # colours (BGR) of photos that show nothing else


def write_still_life(folder, doubt=None):
    """Write a run folder with a ball that stands on a floor, and a few faint splats in the ball. It says which photos it is of.

    `doubt` is that of all splats, None for a run without. Returns the folder.
    """
    ball = spread(BALL)
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-2, 2, SIDE)]))
    floor = np.stack([x, y, np.full_like(x, -1.05)], axis=1)
    faint = 0.9 * spread(FAINT)
    places = np.concatenate([ball, floor, faint])
    normals = np.concatenate([ball, np.broadcast_to([0, 0, 1.0], floor.shape), faint / 0.9])
    turns = [Rotation.align_vectors([normal], [[0, 0, 1]])[0].as_quat(scalar_first=True) for normal in normals]
    columns = {name: np.full(len(places), 0.5) for name in COLUMNS}
    columns |= dict(zip(("x", "y", "z"), places.T, strict=True)) | dict(zip(("nx", "ny", "nz"), normals.T, strict=True))
    columns |= {f"rot_{i}": value for i, value in enumerate(np.array(turns).T)}
    columns["scale_0"] = columns["scale_1"] = np.full(len(places), np.log(0.06))
    columns["opacity"] = np.where(np.arange(len(places)) < len(places) - FAINT, 2.0, -3.0)
    if doubt is not None:
        columns["doubt"] = np.full(len(places), doubt)
    folder.mkdir()
    write_ply(folder / "splats.ply", columns)
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "00000010.toml").touch()
    photos = folder.parent / "good photos"
    photos.mkdir()
    (folder / "run.toml").write_text(f'[run]\ncapture = "{photos.as_posix()}"\n')
    return folder


def add_mesh_light_and_photos(folder):
    """Add what a whole run has to the folder of `write_still_life`: the mesh, a light, two cameras, and a photo for each."""
    to_gltf = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    ball, floor = trimesh.creation.icosphere(4), trimesh.creation.box([4, 4, 0.1])
    floor.apply_translation([0, 0, -1.1])
    mesh = trimesh.util.concatenate([ball, floor.subdivide().subdivide().subdivide()])
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=mesh.vertices[:, :2], material=trimesh.visual.material.PBRMaterial(baseColorFactor=[128, 128, 128, 255])
    )
    mesh.apply_transform(to_gltf)
    mesh.export(folder / "mesh.glb")
    write_panorama(folder / "environment.exr", np.full((16, 32, 3), 0.5))
    lens = {"fl_x": 90.0, "fl_y": 90.0, "cx": 48.0, "cy": 32.0, "w": 96, "h": 64}
    frames = []
    for (name, color), place in zip(PHOTOS.items(), ([-5, -5, 3], [5, -5, 3]), strict=True):
        photo = folder.parent / "good photos" / f"{name}.png"
        cv2.imwrite(str(photo), np.full((64, 96, 3), color, np.uint8))
        pose = look_at(place).tolist()
        frames.append({"file_path": f"images/{name}", "photo": photo.name, "transform_matrix": pose} | lens)
    (folder / "cameras.json").write_text(json.dumps({"frames": frames, "to_capture": np.eye(4).tolist()}))
