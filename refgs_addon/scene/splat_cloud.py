"""Splats: from splats.ply to a point cloud with a material's values on its points."""

import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import bpy
import numpy as np

from .. import compat
from ..errors import InputError
from ..nodes.splat_material import splat_material, values_material
from ..nodes.splats_tree import NAME, splats_tree

MATERIALS = "albedo_r", "albedo_g", "albedo_b", "metallic", "roughness"
SURFACE = {
    "metallic": 0.0,
    "roughness": 1.0,
    "specular": 0.5,
}  # what a file may say once for all; as it is where nothing is said
SH_DC = 0.28209479177387814  # the constant spherical harmonic
LONGEST_HEAD = 100_000  # bytes
_STEPS = 1, 2, 4, 7, 11, 16  # along a curve, to either side: some of the next, for many splats lie on top of each other
_SHIFTS = 0.0, 0.23
_SPREAD = (  # how to put two zeros between the bits of a number
    (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
)  # fmt: skip
_TYPES = {"base_color": "FLOAT_COLOR", "rotation": "QUATERNION"}
PLY_TYPES = {  # numpy's by PLY's newer names, and by the older ones, which all readers know
    "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "float32": "<f4", "float64": "<f8",
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4", "double": "<f8",
}  # fmt: skip
_ROWS = 4096  # at a time, which the processor's cache holds


def add_splats(
    name: str,
    cloud: bpy.types.PointCloud,
    collection: bpy.types.Collection,
    constants: dict[str, float] | None = None,
) -> bpy.types.Object:
    """An object of splats in a collection, with the modifier that draws them. `cloud` is from `point_cloud`, `constants` from
    `read_constants`: the material reads none of these from the points."""
    result = bpy.data.objects.new(name, cloud)
    collection.objects.link(result)
    # Overlapping quads would shadow each other under a lamp, in specks, and take Eevee four times as long.
    result.visible_shadow = False
    material = splat_material(name, constants or {})
    cloud.materials.append(material)
    modifier = result.modifiers.new(NAME, "NODES")
    modifier.node_group = splats_tree(values_material())
    bpy.context.view_layer.update()  # 5.2 makes the modifier's inputs here
    compat.set_modifier_input(modifier, "Material", material)
    return result


def with_slopes(splats: dict[str, np.ndarray], normal_u: np.ndarray, normal_v: np.ndarray) -> dict[str, np.ndarray]:
    """The attributes of a cloud's points: those of `read_splats` (scale as a vector whose third component is 1, base_color with alpha 1),
    and normal_u, normal_v (N, 3): how the normal changes along the splat's axes, for one standard deviation."""
    one = np.ones((len(splats["position"]), 1), np.float32)
    return splats | {
        "scale": np.hstack([splats["scale"], one]),
        "base_color": np.hstack([splats["base_color"], one]),
        "normal_u": normal_u,
        "normal_v": normal_v,
        "radius": splats["scale"].mean(axis=1),  # what is drawn when the modifier is off
    }


def point_cloud(name: str, values: dict[str, np.ndarray]) -> bpy.types.PointCloud:
    """A point cloud with these attributes on its points."""
    cloud = compat.new_point_cloud(name, len(values["position"]))
    for key, value in values.items():
        kind = _TYPES.get(key, "FLOAT" if value.ndim == 1 else "FLOAT_VECTOR")
        attribute = cloud.attributes.get(key) or cloud.attributes.new(key, kind, "POINT")
        field = {"FLOAT": "value", "FLOAT_VECTOR": "vector", "FLOAT_COLOR": "color", "QUATERNION": "value"}[kind]
        attribute.data.foreach_set(field, np.ascontiguousarray(value, np.float32).ravel())
    return cloud


def read_splats(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Read a run's splats.ply, or the PLY of 3DGS or 2DGS (binary, little-endian, properties in 3DGS's names).

    Returns float32 arrays, and how many splats were left out of them for values that are not finite: position (N, 3), normal (N, 3)
    unit, scale (N, 2) standard deviations, rotation (N, 4) unit quaternions wxyz, opacity (N,) 0..1, base_color (N, 3) linear,
    metallic (N,), roughness (N,). What has no materials is matte, in the colour that its constant harmonic shows; what has no normals,
    or zeros, has them along the shortest axis. Raises InputError for any other file.
    """
    all_rows = read_rows(path)
    rows = finite(all_rows)
    if not len(rows):
        raise InputError(f"{path} holds no splat whose numbers are all finite: export the run again")
    found, constants = set(rows.dtype.names), read_constants(path)
    names = {
        "position": ["x", "y", "z"],
        "scale": ["scale_0", "scale_1", *(["scale_2"] if "scale_2" in found else [])],
        "rotation": ["rot_0", "rot_1", "rot_2", "rot_3"],
        "opacity": ["opacity"],
    }
    if {"nx", "ny", "nz"} <= found:
        names["normal"] = ["nx", "ny", "nz"]
    if found.isdisjoint(MATERIALS):
        names["look"] = ["f_dc_0", "f_dc_1", "f_dc_2"]
    else:
        names["base_color"] = list(MATERIALS[:3])
        names |= {name: [name] for name in MATERIALS[3:] if name not in constants}
    missing = [name for group in names.values() for name in group if name not in found]
    if missing:
        raise InputError(f"{path} has no {', '.join(missing)}: it is not the splats.ply of a RefGS run")
    splats = {key: np.stack([rows[name] for name in group], axis=-1) for key, group in names.items()}
    splats = {key: value[:, 0] if value.shape[1] == 1 else value for key, value in splats.items()}
    splats = {key: value.astype(np.float32, copy=False) for key, value in splats.items()}
    splats["opacity"] = 1 / (1 + np.exp(-splats["opacity"]))
    splats["scale"] = np.exp(splats["scale"])
    splats["rotation"] /= np.maximum(np.linalg.norm(splats["rotation"], axis=1, keepdims=True), 1e-12)
    for name in {*MATERIALS[3:]} & {*constants}:
        splats[name] = np.full_like(splats["opacity"], constants[name])
    if "look" in splats:
        look = (0.5 + SH_DC * splats.pop("look")).clip(0, 1)
        splats["base_color"] = np.where(look <= 0.04045, look / 12.92, ((look + 0.055) / 1.055) ** 2.4)
        splats |= {name: np.full_like(look[:, 0], SURFACE[name]) for name in MATERIALS[3:]}
    if "scale_2" in found:
        splats["rotation"], splats["scale"] = _flat(splats["rotation"], splats["scale"])
    normal = splats.setdefault("normal", np.zeros_like(splats["position"]))
    none = ~normal.any(axis=1)
    w, x, y, z = splats["rotation"][none].T
    normal[none] = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return splats, len(all_rows) - len(rows)


def _flat(rotation: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """3D Gaussians as discs: quaternions wxyz (N, 4) whose third axis is the shortest of three scales (N, 3), and the two others."""
    shortest = np.where(scale[:, 2] <= scale.min(axis=1), 2, scale.argmin(axis=1))
    turns = np.array(
        [(0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1, 0, 0, 0)], np.float32
    )  # that bring an axis there
    (w, x, y, z), (a, b, c, d) = rotation.T, turns[shortest].T
    turned = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return np.stack(turned, axis=1), np.take_along_axis(scale, (shortest[:, None] + [1, 2]) % 3, axis=1)


def finite(rows: np.ndarray) -> np.ndarray:
    """Those of a PLY's rows all of whose numbers are finite, as `refgs` keeps them; but for the opacity, a logit, which is of 0 and 1."""
    fine = np.ones(len(rows), bool)
    floats = [name for name in rows.dtype.names if rows.dtype[name].kind == "f"]
    for start in range(0, len(rows), _ROWS):
        part, kept = rows[start : start + _ROWS], fine[start : start + _ROWS]
        for name in floats:
            kept &= ~np.isnan(part[name]) if name == "opacity" else np.isfinite(part[name])
    return rows if fine.all() else rows[fine]


def read_rows(path: Path) -> np.ndarray:
    """The `vertex` element of a PLY file (binary, little-endian, that element first) as a structured array. Raises InputError for any
    other."""
    try:
        with open(path, "rb") as file:
            head, found, _ = file.read(LONGEST_HEAD).partition(b"end_header\n")
            kind, count = _layout(head, found, path)
            start = file.seek(len(head) + len(found))
            # Before anything is reserved for it: a broken head may say any number.
            whole = os.fstat(file.fileno()).st_size - start >= count * kind.itemsize
            rows = np.fromfile(file, kind, count) if whole else ()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    if len(rows) < count:
        raise InputError(f"{path} is cut short: export the run again")
    return rows


def read_constants(path: Path) -> dict[str, float]:
    """What a run's splats.ply says of all splats at once, in comments of its head: of metallic, roughness and specular, the Principled
    BSDF's Specular IOR Level, those that it has no columns for."""
    try:
        with open(path, "rb") as file:
            head = file.read(LONGEST_HEAD).partition(b"end_header\n")[0]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    columns = {line[2] for line in lines if line[:1] == ["property"] and len(line) == 3}
    found = {}
    for line in lines:
        if line[:2] == ["comment", "constant"] and len(line) == 4 and line[2] in {*SURFACE} - columns:
            try:
                found[line[2]] = float(line[3])
            except ValueError:
                raise InputError(
                    f"{path} says that {line[2]} is {line[3]}, which is no number: export the run again"
                ) from None
    return found


def _layout(head: bytes, found: bytes, path: Path) -> tuple[np.dtype, int]:
    """What a row is, and how many there are, from a PLY file's head and the line that ends it."""
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not found or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path} is not a binary little-endian PLY file: export the run again")
    first, *lines = [line for line in lines[2:] if line and line[0] in ("element", "property")] or [[]]
    properties = list(itertools.takewhile(lambda line: line[0] == "property", lines))
    if first[:2] != ["element", "vertex"] or any(line[1:2] == ["list"] for line in properties):
        raise InputError(
            f"{path} is not a PLY file of splats (an element vertex, first, without lists): export the run again"
        )
    try:
        kind, count = np.dtype([(name, PLY_TYPES[kind]) for _, kind, name in properties]), int(first[2])
    except (IndexError, KeyError, ValueError):
        raise InputError(f"{path} has a head that is broken: export the run again") from None
    if count < 1 or not properties:
        raise InputError(f"{path} is empty: export the run again")
    return kind, count


def normal_slopes(splats: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """How the surface's normal changes across each splat: dn/du and dn/dv (N, 3) for one standard deviation.

    A flat splat mirrors one direction only, and a curved mirror made of such splats looks faceted. The slopes are the
    weighted least-squares plane through the normals of near splats that face the same way, held at the splat's own normal. Near are
    those next to it along space-filling curves: not quite the nearest, but found in a second for a million splats.
    """
    position, normal = (splats[key].astype(np.float32) for key in ("position", "normal"))
    count = len(position)
    w, x, y, z = splats["rotation"].astype(np.float32).T
    tangents = (  # the first two columns of the rotation matrix: the splat's axes
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1),
        np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1),
    )
    orders = [_along_curve(position, shift) for shift in _SHIFTS]
    beside = np.full((2 * len(orders), count), np.inf, np.float32)  # squared distances to the next ones
    for row, order in enumerate(orders):
        squared = np.square(np.diff(position[order], axis=0)).sum(axis=1)
        beside[2 * row, order[:-1]] = beside[2 * row + 1, order[1:]] = squared
    beside = np.sort(beside, axis=0)[len(orders) - 1]  # along a curve there are jumps: not the farthest of them
    reach = np.maximum(np.where(np.isfinite(beside), 64 * beside, 1), 1e-24)

    def gather(order: np.ndarray) -> np.ndarray:
        """Sums over each splat's neighbours, in its tangent plane: w uu, w uv, w vv, w u dn, w v dn."""
        place, facing_way, *axes, width = (values[order] for values in (position, normal, *tangents, reach))
        found = np.zeros((7, count), np.float32)
        for steps in _STEPS:
            ahead, behind = slice(None, -steps), slice(steps, None)
            offset, change = (values[behind] - values[ahead] for values in (place, facing_way))
            alike = np.einsum("na,na->n", facing_way[ahead], facing_way[behind]) > 0.5
            squared = np.einsum("na,na->n", offset, offset)
            for end in (ahead, behind):  # from either end: offset and change both turn round, their products do not
                weight = np.exp(-0.5 * squared / width[end]) * alike
                u, v, du, dv = (np.einsum("na,na->n", d, axis[end]) for d in (offset, change) for axis in axes)
                for total, product in zip(found, (u * u, u * v, v * v, u * du, u * dv, v * du, v * dv), strict=True):
                    total[end] += weight * product
        result = np.empty_like(found)
        result[:, order] = found
        return result

    with ThreadPoolExecutor() as pool:  # numpy lets go of the interpreter's lock
        sums = sum(pool.map(gather, orders))
    uu, uv, vv = sums[:3] + 1e-2 * reach * np.array([[1], [0], [1]], np.float32)  # flat where no neighbours tell
    inverse = np.array([[vv, -uv], [-uv, uu]]) / (uu * vv - uv * uv)
    slopes = np.einsum("abn,bcn->acn", inverse, sums[3:].reshape(2, 2, count))  # along u and v: of n, along u and v
    scaled = slopes * splats["scale"].T[:, None]
    return tuple(np.einsum("cn,cna->na", row, np.stack(tangents)).astype(np.float32) for row in scaled)


def _along_curve(position: np.ndarray, shift: float) -> np.ndarray:
    """The order of points (N, 3) along Morton's curve through a cube about them, moved by part of its side so that other points are
    on either side of its jumps."""
    low = position.min(axis=0)
    cells = (position - low) / max((position - low).max(), 1e-30) / 2 + np.float32(shift)
    key = np.zeros(len(position), np.uint64)
    for axis, value in enumerate((cells * (1 << 21)).astype(np.uint64).T):  # 21 bits, two apart
        for by, mask in _SPREAD:
            value = (value | (value << np.uint64(by))) & np.uint64(mask)
        key |= value << np.uint64(axis)
    return np.argsort(key, kind="stable")
