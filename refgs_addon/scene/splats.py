"""Splats: from splats.ply to a point cloud with a material's values on its points."""

from pathlib import Path

import bpy
import numpy as np
from mathutils.kdtree import KDTree

from .. import compat
from ..errors import InputError
from ..nodes.materials import splat_material, values_material
from ..nodes.splats import NAME, splats_tree

_NEIGHBOURS = 12
_TYPES = {"base_color": "FLOAT_COLOR", "rotation": "QUATERNION"}


def add_splats(name: str, splats: dict[str, np.ndarray], collection: bpy.types.Collection) -> bpy.types.Object:
    """A point cloud of splats in a collection, with the modifier that draws them. `splats` is from `read_splats`.

    Its points have the attributes of `read_splats` (scale as a vector whose third component is 1, base_color with
    alpha 1), and normal_u, normal_v: how the normal changes along the splat's axes, for one standard deviation.
    """
    count = len(splats["position"])
    cloud = compat.new_point_cloud(name, count)
    values = dict(splats)
    values["scale"] = np.column_stack([splats["scale"], np.ones(count)])
    values["base_color"] = np.column_stack([splats["base_color"], np.ones(count)])
    values["normal_u"], values["normal_v"] = normal_slopes(splats)
    values["radius"] = splats["scale"].mean(axis=1)  # what is drawn when the modifier is off
    for key, value in values.items():
        kind = _TYPES.get(key, "FLOAT" if value.ndim == 1 else "FLOAT_VECTOR")
        attribute = cloud.attributes.get(key) or cloud.attributes.new(key, kind, "POINT")
        field = {"FLOAT": "value", "FLOAT_VECTOR": "vector", "FLOAT_COLOR": "color", "QUATERNION": "value"}[kind]
        attribute.data.foreach_set(field, np.ascontiguousarray(value, np.float32).ravel())

    result = bpy.data.objects.new(name, cloud)
    collection.objects.link(result)
    # Overlapping quads would shadow each other under a lamp, in specks, and take Eevee four times as long.
    result.visible_shadow = False
    material = splat_material(name)
    cloud.materials.append(material)
    modifier = result.modifiers.new(NAME, "NODES")
    modifier.node_group = splats_tree(values_material())
    bpy.context.view_layer.update()  # 5.2 makes the modifier's inputs here
    compat.set_modifier_input(modifier, "Material", material)
    return result


def read_splats(path: Path) -> dict[str, np.ndarray]:
    """Read a run's splats.ply (binary, little-endian, float properties in 3DGS's names and RefGS's materials).

    Returns float32 arrays: position (N, 3), normal (N, 3) unit, scale (N, 2) standard deviations, rotation (N, 4)
    unit quaternions wxyz, opacity (N,) 0..1, base_color (N, 3) linear, metallic (N,), roughness (N,). Raises InputError
    for any other file.
    """
    rows = _vertices(path)
    names = {
        "position": ["x", "y", "z"],
        "normal": ["nx", "ny", "nz"],
        "scale": ["scale_0", "scale_1"],
        "rotation": ["rot_0", "rot_1", "rot_2", "rot_3"],
        "opacity": ["opacity"],
        "base_color": ["albedo_r", "albedo_g", "albedo_b"],
        "metallic": ["metallic"],
        "roughness": ["roughness"],
    }
    missing = [name for group in names.values() for name in group if name not in rows.dtype.names]
    if missing:
        raise InputError(f"{path} has no {', '.join(missing)}: it is not the splats.ply of a RefGS run")
    splats = {key: np.stack([rows[name] for name in group], axis=-1) for key, group in names.items()}
    splats = {key: value[:, 0] if value.shape[1] == 1 else value for key, value in splats.items()}
    for key, value in splats.items():
        if not np.isfinite(value).all():
            raise InputError(f"{path} holds a {key} that is not a finite number: export the run again")
    splats["opacity"] = 1 / (1 + np.exp(-splats["opacity"]))
    splats["scale"] = np.exp(splats["scale"])
    for key in ("rotation", "normal"):
        splats[key] /= np.maximum(np.linalg.norm(splats[key], axis=1, keepdims=True), 1e-12)
    return splats


def _vertices(path: Path) -> np.ndarray:
    """The `vertex` element of a PLY file as a structured array."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    head, found, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not found or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path} is not a binary little-endian PLY file: export the run again")
    lines = [line for line in lines[2:] if line and line[0] in ("element", "property")]
    properties = lines[1:]
    if lines[0][:2] != ["element", "vertex"] or any(
        p[:2] not in (["property", "float"], ["property", "float32"]) for p in properties
    ):
        raise InputError(f"{path} is not a PLY file of splats (one vertex element of floats): export the run again")
    count, kind = int(lines[0][2]), np.dtype([(p[2], "<f4") for p in properties])
    if count == 0 or len(body) < count * kind.itemsize:
        raise InputError(f"{path} is cut short or empty: export the run again")
    return np.frombuffer(body, kind, count)


def normal_slopes(splats: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """How the surface's normal changes across each splat: dn/du and dn/dv (N, 3) for one standard deviation.

    A flat splat mirrors one direction only, and a curved mirror made of such splats looks faceted. The slopes are the
    weighted least-squares plane through the normals of the nearest splats that face the same way, held at the splat's
    own normal.
    """
    position, normal = splats["position"].astype(np.float64), splats["normal"].astype(np.float64)
    count = len(position)
    tree = KDTree(count)
    for i, point in enumerate(position):
        tree.insert(point, i)
    tree.balance()
    k = min(_NEIGHBOURS + 1, count)
    near = np.array([[hit[1] for hit in tree.find_n(point, k)] for point in position])
    w, x, y, z = splats["rotation"].astype(np.float64).T
    tangents = np.stack(  # the first two columns of the rotation matrix: the splat's axes
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1),
            np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1),
        ],
        axis=2,
    )
    offset = (position[near] - position[:, None]) @ tangents  # (N, k, 2), world units
    reach = np.maximum(np.linalg.norm(offset, axis=2).mean(axis=1), 1e-12)[:, None]
    facing = (normal[near] * normal[:, None]).sum(axis=2) > 0.5
    weight = np.exp(-0.5 * (offset**2).sum(axis=2) / reach**2) * facing
    moment = np.einsum("nk,nki,nkj->nij", weight, offset, offset)
    moment += 1e-2 * reach[..., None] ** 2 * np.eye(2)  # no slope where there are no neighbours to tell
    change = np.einsum("nk,nki,nkj->nij", weight, offset, normal[near] - normal[:, None])
    slopes = np.linalg.solve(moment, change) * splats["scale"][:, :, None]
    return slopes[:, 0].astype(np.float32), slopes[:, 1].astype(np.float32)
