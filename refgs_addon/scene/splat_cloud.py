"""Read a splats.ply, and make a Blender point cloud of it. Each splat is a point with its material as attributes."""

import itertools
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import bpy
import numpy as np

from .. import compat
from ..errors import InputError
from ..nodes.splat_material import splat_material, values_material
from ..nodes.splats_tree import NAME, splats_tree
from ..ply_file import read_header, read_rows
from ..spz_file import SUFFIX, read_spz_rows
from .color_spaces import from_rec709

MATERIALS = "albedo_r", "albedo_g", "albedo_b", "metallic", "roughness"
SURFACE = {"metallic": 0.0, "roughness": 1.0, "specular": 0.5}  # possible constants of a file, with their defaults
SH_DC = 0.28209479177387814  # the constant spherical harmonic
_STEPS = 1, 2, 4, 7, 11, 16  # neighbours along a curve, with gaps: many splats lie on top of each other
_SHIFTS = 0.0, 0.23
_SPREAD = (  # shifts and masks that put two zeros between the bits of a number
    (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
)  # fmt: skip
_TYPES = {"base_color": "FLOAT_COLOR", "rotation": "QUATERNION", "radiance:base": "FLOAT4"}
_FIELDS = {
    "FLOAT": "value",
    "FLOAT_VECTOR": "vector",
    "FLOAT4": "vector",
    "FLOAT_COLOR": "color",
    "QUATERNION": "value",
}
REF_GAUSSIAN = "ori_color_0", "ori_color_1", "ori_color_2", "refl_strength", "roughness"  # its materials, as logits
_SPLATS = re.compile(
    r"[xyz]|n[xyz]|f_dc_[012]|f_rest_\d+|opacity|scale_[012]|rot_[0123]|albedo_[rgb]|metallic|roughness|doubt|received_[rgb]|ind_\d+"
    r"|ori_color_[012]|refl_strength"
)
_ROWS = 4096  # rows at a time, to fit the processor's cache
_SPLATS_AT_A_TIME = 16384  # likewise


def add_splats(
    name: str,
    cloud: bpy.types.PointCloud,
    collection: bpy.types.Collection,
    constants: dict[str, float] | None = None,
    two_sided: bool = False,
) -> bpy.types.Object:
    """Add an object that draws the splats of a point cloud, with the modifier and the material for it. Returns the object.

    `cloud` comes from `point_cloud`. `constants` comes from `read_constants`: the values that all splats share. The material uses them in
    place of attributes. `two_sided` is for normals that may point to either side.
    """
    result = bpy.data.objects.new(name, cloud)
    collection.objects.link(result)
    # Under a lamp overlapping quads shadow each other in specks, and Eevee takes four times as long.
    result.visible_shadow = False
    material = splat_material(name, constants or {}, two_sided)
    cloud.materials.append(material)
    modifier = result.modifiers.new(NAME, "NODES")
    modifier.show_viewport = False  # not to be evaluated yet, which takes a second for a million splats
    modifier.node_group = splats_tree(values_material())
    bpy.context.view_layer.update()  # 5.2 creates the modifier's inputs here
    compat.set_modifier_input(modifier, "Material", material)
    modifier.show_viewport = True
    return result


def cloud_attributes(
    splats: dict[str, np.ndarray], normal_u: np.ndarray, normal_v: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the attributes of a point cloud: the arrays of `read_splats`, the change of the normal across each splat, and a radius.

    `normal_u` and `normal_v` (N, 3) are the change of the normal along the splat's first and second axis, per standard deviation. Blender's
    vectors have three components and its colours four. So scale gets a third component and base_color a fourth, both 1.
    """
    one = np.ones((len(splats["position"]), 1), np.float32)
    # Blender's Gaussian splats have their opacity here, after a colour that only Blender's own material reads.
    native = {"radiance:base": np.pad(splats["opacity"][:, None], ((0, 0), (3, 0)))} if compat.DRAWS_SPLATS else {}
    return (
        splats
        | native
        | {
            "scale": np.hstack([splats["scale"], one]),
            "base_color": np.hstack([splats["base_color"], one]),
            "normal_u": normal_u,
            "normal_v": normal_v,
            "radius": splats["scale"].mean(axis=1),  # for drawing without the modifier
        }
    )


def point_cloud(name: str, values: dict[str, np.ndarray]) -> bpy.types.PointCloud:
    """Make a point cloud. `values` maps the name of each attribute to an array with one row for each point.

    Colours are linear Rec.709; the point cloud has them in Blender's working space.
    """
    cloud = compat.new_point_cloud(name, len(values["position"]))
    for key, value in (values | {"base_color": from_rec709(values["base_color"])}).items():
        kind = _TYPES.get(key, "FLOAT" if value.ndim == 1 else "FLOAT_VECTOR")
        attribute = cloud.attributes.get(key) or cloud.attributes.new(key, kind, "POINT")
        attribute.data.foreach_set(_FIELDS[kind], np.ascontiguousarray(value, np.float32).ravel())
    return cloud


def read_splats(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Read the splats of a PLY or SPZ file. Returns their arrays by name, and the number of splats left out because a value is not finite.

    The file is a run's splats.ply, or comes from a 3DGS, 2DGS or Ref-Gaussian program, with 3DGS's property names. The float32 arrays are:
    - position (N, 3);
    - normal (N, 3), of unit length;
    - scale (N, 2), in standard deviations;
    - rotation (N, 4), unit quaternions wxyz;
    - opacity, metallic and roughness (N,), all 0..1;
    - base_color (N, 3), linear Rec.709;
    - doubt (N,), 0..1, only if the file has it: 1 where the photos do not show whether the surface is metal or paint.

    Splats without materials become matte. Their base colour comes from f_dc, the constant spherical harmonic. Splats without normals get
    their shortest axis as normal. Raises InputError for any other file.
    """
    all_rows = read_spz_rows(path) if path.suffix.lower() == SUFFIX else read_rows(path)
    if "packed_position" in all_rows.dtype.names:
        raise InputError(f"{path} is a compressed PLY: make a plain one of it, with splat-transform or SuperSplat")
    rows = finite_rows(all_rows)
    if not len(rows):
        raise InputError(f"{path} has no splat with finite values: export the run again")
    found = set(rows.dtype.names)
    ours = not found.isdisjoint(MATERIALS[:4])  # others have a roughness, too
    constants = read_constants(path) if ours else {}
    names = _columns(found, ours, constants, path)
    splats = {key: np.stack([rows[name] for name in group], axis=-1) for key, group in names.items()}
    splats = {key: value[:, 0] if value.shape[1] == 1 else value for key, value in splats.items()}
    splats = {key: value.astype(np.float32, copy=False) for key, value in splats.items()}
    splats["opacity"] = 1 / (1 + np.exp(-splats["opacity"]))
    splats["scale"] = np.exp(splats["scale"])
    splats["rotation"] /= np.maximum(np.linalg.norm(splats["rotation"], axis=1, keepdims=True), 1e-12)
    for name in {*MATERIALS[3:]} & {*constants}:
        splats[name] = np.full_like(splats["opacity"], constants[name])
    look = splats.pop("look")
    if not ours and "base_color" in splats:
        for name in ("base_color", "metallic", "roughness"):
            splats[name] = 1 / (1 + np.exp(-splats[name]))
        splats["base_color"] = srgb_to_linear(splats["base_color"])
    elif not ours:
        splats["base_color"] = srgb_to_linear((0.5 + SH_DC * look).clip(0, 1))
        splats |= {name: np.full_like(splats["opacity"], SURFACE[name]) for name in MATERIALS[3:]}
    if "scale_2" in found:
        splats["rotation"], splats["scale"] = _flatten_gaussians(splats["rotation"], splats["scale"])
    normal = splats.setdefault("normal", np.zeros_like(splats["position"]))
    none = ~normal.any(axis=1)
    w, x, y, z = splats["rotation"][none].T
    normal[none] = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return splats, len(all_rows) - len(rows)


def _columns(found: set[str], ours: bool, constants: dict[str, float], path: Path) -> dict[str, list[str]]:
    """Return the columns to read of a file of splats by what they hold, from the columns `found`. Raises InputError if some are missing.

    `ours` tells whether RefGS made the materials. Those in `constants` have no column.
    """
    names = {
        "position": ["x", "y", "z"],
        "scale": ["scale_0", "scale_1", *(["scale_2"] if "scale_2" in found else [])],
        "rotation": ["rot_0", "rot_1", "rot_2", "rot_3"],
        "opacity": ["opacity"],
    }
    if {"nx", "ny", "nz"} <= found:
        names["normal"] = ["nx", "ny", "nz"]
    names["look"] = ["f_dc_0", "f_dc_1", "f_dc_2"]
    if ours:
        names["base_color"] = list(MATERIALS[:3])
        names |= {name: [name] for name in MATERIALS[3:] if name not in constants}
        if "doubt" in found:
            names["doubt"] = ["doubt"]
        names["normal"] = ["nx", "ny", "nz"]
    elif {*REF_GAUSSIAN} <= found:
        names |= {"base_color": list(REF_GAUSSIAN[:3]), "metallic": ["refl_strength"], "roughness": ["roughness"]}
    missing = [name for group in names.values() for name in group if name not in found]
    if missing:
        raise InputError(f"{path} has no {', '.join(missing)}: it is not the splats.ply of a RefGS run")
    for prefix, counts in (("f_rest_", (0, 9, 24, 45)), ("ind_", (0, 3, 12, 27, 48))):
        numbers = {name for name in found if re.fullmatch(rf"{prefix}\d+", name)}
        if len(numbers) not in counts or numbers != {f"{prefix}{i}" for i in range(len(numbers))}:
            known = ", ".join(map(str, counts))
            raise InputError(f"{path} has {len(numbers)} {prefix} values a splat: spherical harmonics have {known}")
    return names


def is_ours(path: Path) -> bool:
    """Check whether a file of splats has materials and normals of RefGS. Raises InputError if it cannot be read."""
    if path.suffix.lower() == SUFFIX:
        return False
    return any(line[:1] == ["property"] and line[-1] in MATERIALS[:4] for line in read_header(path)[0])


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """Decode sRGB values in 0..1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values as sRGB, clipped to 0..1."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def _flatten_gaussians(rotation: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flatten 3D Gaussians to discs, with quaternions wxyz (N, 4) and scales (N, 2)."""
    shortest = np.where(scale[:, 2] <= scale.min(axis=1), 2, scale.argmin(axis=1))
    # Rotations that bring x, y or z to the third axis.
    turns = np.array([(0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1, 0, 0, 0)], np.float32)
    (w, x, y, z), (a, b, c, d) = rotation.T, turns[shortest].T
    turned = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return np.stack(turned, axis=1), np.take_along_axis(scale, (shortest[:, None] + [1, 2]) % 3, axis=1)


def finite_rows(rows: np.ndarray) -> np.ndarray:
    """Return the rows of a PLY in which all values of the splat are finite. The trainer selects the same rows.

    Only logits may be infinite, which stands for exactly 0 or 1. Opacity is a logit, and so are Ref-Gaussian's materials. Columns that no
    splat needs are not checked.
    """
    names = [name for name in rows.dtype.names if _SPLATS.fullmatch(name)]
    logits = {"opacity"} if {*REF_GAUSSIAN} - {*names} else {"opacity", *REF_GAUSSIAN}
    turn = [name for name in names if name.startswith("rot_")]
    fine = np.ones(len(rows), bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, len(rows), _ROWS):
            part, kept = rows[start : start + _ROWS], fine[start : start + _ROWS]
            for name in names:
                values = part[name].astype(np.float32, copy=False)
                values = np.exp(values) if name.startswith("scale_") else values
                kept &= ~np.isnan(values) if name in logits else np.isfinite(values)
            if turn:
                length = sum(np.square(part[name].astype(np.float32, copy=False)) for name in turn)
                kept &= (length > 0) & np.isfinite(length)
    return rows if fine.all() else rows[fine]


def read_constants(path: Path) -> dict[str, float]:
    """Read the values that all splats of a splats.ply share: "metallic", "roughness" or "specular". Returns them by name.

    The values are comments in the file's header. A value is ignored if the file also has a column of its name. Specular is the Principled
    BSDF's Specular IOR Level. Raises InputError if the file cannot be read, or a value is not a number.
    """
    lines = read_header(path)[0]
    columns = {line[2] for line in lines if line[:1] == ["property"] and len(line) == 3}
    found = {}
    for line in lines:
        if line[:2] == ["comment", "constant"] and len(line) == 4 and line[2] in {*SURFACE} - columns:
            try:
                found[line[2]] = float(line[3])
            except ValueError:
                found[line[2]] = np.nan
            if not np.isfinite(found[line[2]]):
                raise InputError(f"{path}: {line[2]} is {line[3]}, not a number: export the run again")
    return found


def splat_axes(rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the two axes (N, 3) of splats from their unit quaternions wxyz (N, 4)."""
    w, x, y, z = rotation.T
    return (
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1),
        np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1),
    )


def normal_slopes(splats: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate how the normal changes across each splat: dn/du and dn/dv (N, 3) per standard deviation.

    Without this, a curved mirror would look faceted. Each splat's normal is compared with the normals of its neighbours that face the same
    way, in a weighted least-squares fit. Neighbours are splats that are close along space-filling curves. They are not always the nearest
    splats, but they are found fast: in a second for a million splats.
    """
    position, normal = (splats[key].astype(np.float32) for key in ("position", "normal"))
    count = len(position)
    tangents = splat_axes(splats["rotation"].astype(np.float32))
    orders = [_morton_order(position, shift) for shift in _SHIFTS]
    beside = np.full((2 * len(orders), count), np.inf, np.float32)  # squared distances to the adjacent splats
    for row, order in enumerate(orders):
        squared = np.square(np.diff(position[order], axis=0)).sum(axis=1)
        beside[2 * row, order[:-1]] = beside[2 * row + 1, order[1:]] = squared
    beside = np.sort(beside, axis=0)[len(orders) - 1]  # curves jump: ignore the largest distances
    reach = np.maximum(np.where(np.isfinite(beside), 64 * beside, 1), 1e-24)

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def gather(order: np.ndarray) -> np.ndarray:
        """Compute the sums that each splat's least-squares fit needs, over the splat's neighbours along one curve. Returns (7, N).

        `order` has the splats' indices along the curve. The seven sums are of w·u·u, w·u·v, w·v·v, w·u·du, w·u·dv, w·v·du and w·v·dv.
        w is the neighbour's weight. (u, v) is the offset to the neighbour, and (du, dv) the difference of the normals. Both are measured
        along the splat's two axes.
        """
        place, facing_way, *axes = (np.take(values.T, order, axis=1) for values in (position, normal, *tangents))
        width = reach[order]
        found = np.zeros((7, count), np.float32)
        for start, steps in itertools.product(range(0, count, _SPLATS_AT_A_TIME), _STEPS):
            stop = min(start + _SPLATS_AT_A_TIME, count - steps)
            if stop <= start:
                continue
            ahead, behind = slice(start, stop), slice(start + steps, stop + steps)
            offset, change = (values[:, behind] - values[:, ahead] for values in (place, facing_way))
            alike = dot(facing_way[:, ahead], facing_way[:, behind]) > 0.5
            squared = dot(offset, offset)
            for end in (ahead, behind):  # from the other end offset and change both flip sign, their products do not
                weight = np.exp(-0.5 * squared / width[end]) * alike
                u, v, du, dv = (dot(d, axis[:, end]) for d in (offset, change) for axis in axes)
                wu, wv = weight * u, weight * v
                for total, product in zip(
                    found, (wu * u, wu * v, wv * v, wu * du, wu * dv, wv * du, wv * dv), strict=True
                ):
                    total[end] += product
        result = np.empty_like(found)
        result[:, order] = found
        return result

    with ThreadPoolExecutor() as pool:  # numpy releases the interpreter's lock
        sums = sum(pool.map(gather, orders))
    uu, uv, vv = sums[:3] + 1e-2 * reach * np.array([[1], [0], [1]], np.float32)  # regularised: flat without neighbours
    inverse = np.array([[vv, -uv], [-uv, uu]]) / (uu * vv - uv * uv)
    slopes = np.einsum("abn,bcn->acn", inverse, sums[3:].reshape(2, 2, count))  # d(n_u, n_v) / d(u, v)
    scaled = slopes * splats["scale"].T[:, None]
    return tuple(np.einsum("cn,cna->na", row, np.stack(tangents)).astype(np.float32) for row in scaled)


def _morton_order(position: np.ndarray, shift: float) -> np.ndarray:
    """Argsort points (N, 3) along a Morton curve shifted by a fraction of its cube."""
    # Points close together can be far apart along one curve. Along a second one, with another shift, they are likely to be close.
    low = position.min(axis=0)
    cells = (position - low) / max((position - low).max(), 1e-30) / 2 + np.float32(shift)
    key = np.zeros(len(position), np.uint64)
    for axis, value in enumerate((cells * (1 << 21)).astype(np.uint64).T):  # 21 bits, with two zeros between
        for by, mask in _SPREAD:
            value = (value | (value << np.uint64(by))) & np.uint64(mask)
        key |= value << np.uint64(axis)
    return np.argsort(key, kind="stable")
