"""Write the output folder of a training, with a few random splats. Only public libraries are used, none of the trainer's code."""

import json

import numpy as np
import OpenEXR
import trimesh
from plyfile import PlyData, PlyElement

from tests.makers.captures import look_at

COUNT, SIZE = 40, 64
COLUMNS = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1",
    "rot_0", "rot_1", "rot_2", "rot_3", "albedo_r", "albedo_g", "albedo_b", "metallic", "roughness",
]  # fmt: skip


def quaternion_matrix(q):
    """Compute the rotation matrices (N, 3, 3) of unit quaternions (N, 4) in the order w, x, y, z."""
    w, xyz = q[:, :1, None], q[:, None, 1:]
    axes = np.eye(3)[None]
    return np.swapaxes(axes + 2 * np.cross(xyz, np.cross(xyz, axes) + w * axes), 1, 2)


def write_ply(path, columns):
    """Write a PLY file of float32. `columns` maps the name of each property to its values."""
    rows = np.zeros(len(columns["x"]), dtype=[(name, "<f4") for name in columns])
    for name, value in columns.items():
        rows[name] = value
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))


def write_panorama(path, pixels):
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels, np.float32)}).write(str(path))


def read_exr(path):
    """Read an EXR file as (h, w, 4) float32."""
    channels = OpenEXR.File(str(path)).channels()
    return channels["RGBA"].pixels if "RGBA" in channels else np.dstack([channels[c].pixels for c in "RGBA"])


def random_columns(count=COUNT, seed=0):
    """Make random splats as the columns of a PLY file, by name. Opacities are logits, scales are logarithms."""
    rng = np.random.default_rng(seed)
    columns = {name: rng.normal(size=count) for name in COLUMNS}
    for name in ("albedo_r", "albedo_g", "albedo_b", "metallic", "roughness"):
        columns[name] = rng.uniform(size=count)
    columns["scale_0"], columns["scale_1"] = rng.uniform(-4, -2, (2, count))
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    for i in range(4):
        columns[f"rot_{i}"] = quaternion[:, i]
    for i, name in enumerate(("nx", "ny", "nz")):
        columns[name] = quaternion_matrix(quaternion)[:, i, 2]
    return columns


FRAMES = [
    {"file_path": "images/front", "transform_matrix": look_at([0.3, -4, 1.5]).tolist(),
     "fl_x": 90.0, "fl_y": 90.0, "cx": 32.0, "cy": 32.0, "w": SIZE, "h": SIZE, "split": "test"},
    {"file_path": "images/shifted", "transform_matrix": look_at([3, 2, -1]).tolist(),
     "fl_x": 80.0, "fl_y": 100.0, "cx": 29.0, "cy": 18.5, "w": SIZE, "h": 40, "split": "train"},
]  # fmt: skip


def write_run(folder):
    """Write the output folder of a training: random splats, a box for the mesh, a grey sky, two cameras. Return the folder."""
    folder.mkdir()
    write_ply(folder / "splats.ply", random_columns())
    write_panorama(folder / "environment.exr", np.full((16, 32, 3), 0.5))
    (folder / "cameras.json").write_text(json.dumps({"frames": FRAMES, "to_capture": np.eye(4).tolist()}))
    mesh = trimesh.creation.box(extents=[0.2, 0.4, 0.6])
    mesh.apply_translation([1.0, 2.0, 3.0])  # in glTF's axes; in Blender's this is (1, -3, 2)
    mesh.export(folder / "mesh.glb")
    return folder
