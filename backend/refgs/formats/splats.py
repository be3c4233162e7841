"""Read and write splats.ply: one row for each splat, with its material.

Properties have the same names as in the files of 3D Gaussian splatting (3DGS).
"""

import math
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import repack_fields, structured_to_unstructured
from plyfile import PlyData, PlyElement, PlyListProperty, PlyProperty

from refgs.color import srgb_decode
from refgs.errors import InputError, InputWarning
from refgs.formats.ply import read_ply, write_ply

DC = 0.5 / math.sqrt(math.pi)  # Y00: a constant harmonic f_dc has the colour 0.5 + DC · f_dc


@dataclass
class Splats:
    """Hold N splats with their appearance and materials, as float32 numpy arrays.

    - positions (N, 3), in world units
    - normals (N, 3), unit vectors. They point outwards if RefGS trained the splats. In files of other programs, some may point inwards.
    - sh (N, K, 3): spherical harmonics, K = (degree + 1)². The colour is 0.5 + SH, as in 3DGS.
    - opacities (N,) in 0..1
    - scales: standard deviations in world units; (N, 2) for surfels, (N, 3) for 3D Gaussians. The third scale is along the normal.
    - rotations (N, 4): unit quaternions wxyz
    - albedo (N, 3), linear Rec.709; metallic (N,) and perceptual roughness (N,) in 0..1
    - received (N, 3): the irradiance, divided by the irradiance without occlusion. The irradiance includes light that the object reflects
      to itself.
    - indirect (N, K', 3): spherical harmonics of the linear radiance that other parts of the object reflect to the splat. Without
      inter-reflection, K' is 0 and `received` is 1.
    - doubt (N,) in 0..1: 0 if photos show whether the splat is metal or paint, 1 if they leave it open; None if unknown
    - constants: material values that are the same for all splats, by name (see CONSTANTS). Files store them in the header.
    - others: further elements and properties of the PLY file that was read. `write_splats` writes them again.
    """

    positions: np.ndarray
    normals: np.ndarray
    sh: np.ndarray
    opacities: np.ndarray
    scales: np.ndarray
    rotations: np.ndarray
    albedo: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    received: np.ndarray
    indirect: np.ndarray
    doubt: np.ndarray | None = None
    constants: dict[str, float] = field(default_factory=dict)
    others: tuple[PlyElement, ...] = ()

    def __len__(self) -> int:
        return len(self.positions)


_HEAD = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
_TAIL = ["opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"]
THIN = 0.05  # third scale of a surfel in 3DGS viewers, as a part of its smaller scale
SURFELS = "SplatRenderMode: 2dgs"  # comment by which Brush, and programs after it, mark surfels: there is no scale_2
CHUNK = 4096  # rows copied at a time; they fit the processor's cache
_RECEIVED = ["received_r", "received_g", "received_b"]
_DOUBT = "doubt"
_MATERIAL = ["albedo_r", "albedo_g", "albedo_b", "metallic", "roughness"]
# `specular` is the Principled BSDF's Specular IOR Level. Its default is 0.5.
CONSTANTS = ("metallic", "roughness", "specular")
_CONSTANT = re.compile(rf"constant\s+({'|'.join(CONSTANTS)})\s+(\S+)")  # in a comment of the header
# Properties of Ref-Gaussian's files, as logits.
_REF_GAUSSIAN = ["ori_color_0", "ori_color_1", "ori_color_2", "refl_strength", "roughness"]
MATTE = 0.0, 1.0  # metallic and roughness of splats without materials
# Rotations, as quaternions wxyz, that move axis 0, 1 or 2 to the third place.
_TO_THIRD = np.array([(0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1, 0, 0, 0)], np.float32)


def write_splats(path: str | os.PathLike, splats: Splats) -> None:
    """Write splats as a binary little-endian PLY file (docs/formats.md). Elements in `splats.others` are written too.

    Values are encoded as 3DGS viewers expect: opacities as logits, scales as logarithms, and spherical harmonics of degree 1 and above in
    channel-major order. Materials are stored unchanged. Opacities are clipped to 1e-6 .. 1 - 1e-6. A comment marks surfels (SURFELS).
    """
    names, columns = _common_columns(splats, splats.scales)
    names += _MATERIAL[:3]
    columns.append(splats.albedo)
    for name in ("metallic", "roughness"):
        if name not in splats.constants:
            names.append(name)
            columns.append(getattr(splats, name))
    if splats.doubt is not None:
        names.append(_DOUBT)
        columns.append(splats.doubt)
    if splats.indirect.shape[1]:
        names += [*_RECEIVED, *(f"ind_{i}" for i in range(3 * splats.indirect.shape[1]))]
        columns += [splats.received, splats.indirect.transpose(0, 2, 1)]
    comments = [f"constant {name} {value:g}" for name, value in splats.constants.items()]
    if splats.scales.shape[1] == 2:
        comments.insert(0, SURFELS)
    _write(path, names, columns, splats.others, comments)


def write_display_splats(path: str | os.PathLike, splats: Splats) -> None:
    """Write splats as a binary little-endian PLY file for 3DGS viewers: colours and shapes (`three_scales`), but no materials."""
    _write(path, *_common_columns(splats, three_scales(splats)))


def three_scales(splats: Splats) -> np.ndarray:
    """Return splats' scales (N, 3) for 3DGS viewers, which hide a splat with scale 0. A surfel's third is THIN times its smaller one."""
    scales = splats.scales
    return scales if scales.shape[1] == 3 else np.column_stack([scales, THIN * scales.min(axis=1)])


def _common_columns(splats: Splats, scales: np.ndarray) -> tuple[list[str], list[np.ndarray]]:
    """Return the columns common to all PLY files: names, and values encoded as in 3DGS."""
    opacity = np.clip(splats.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    rest = splats.sh[:, 1:].transpose(0, 2, 1)
    columns = [
        splats.positions,
        splats.normals,
        splats.sh[:, 0],
        rest,
        np.log(opacity / (1 - opacity)),
        np.log(np.maximum(scales.astype(np.float64), 1e-30)),
        splats.rotations,
    ]
    names = [*_HEAD, *(f"f_rest_{i}" for i in range(3 * rest.shape[2])), *_TAIL]
    if scales.shape[1] == 3:
        names.insert(names.index("scale_1") + 1, "scale_2")
    return names, columns


def _write(
    path: str | os.PathLike,
    names: list[str],
    columns: list[np.ndarray],
    others: tuple[PlyElement, ...] = (),
    comments: Sequence[str] = (),
) -> None:
    count = len(columns[0])
    table = np.empty((count, len(names)), "<f4")
    start = 0
    for column in columns:
        width = int(np.prod(column.shape[1:]))
        for rows in range(0, count, CHUNK):
            part = column[rows : rows + CHUNK]
            table[rows : rows + CHUNK, start : start + width] = part.reshape(len(part), width)
        start += width
    rows = table.view([(name, "<f4") for name in names]).reshape(count)
    properties = [PlyProperty(name, "float") for name in names]
    unknown = next((element for element in others if element.name == "vertex"), None)
    if unknown is not None:
        more = [p for p in unknown.properties if p.name not in names]
        both = np.empty(count, [*rows.dtype.descr, *((p.name, p.dtype("<")) for p in more)])
        for source, which in ((rows, names), (unknown.data, [p.name for p in more])):
            for name in which:
                both[name] = source[name]
        rows, properties = both, [*properties, *more]
    vertex = PlyElement("vertex", properties, count)
    vertex.data = rows
    write_ply(path, [vertex, *(element for element in others if element.name != "vertex")], comments)


def read_splats(path: str | os.PathLike) -> Splats:
    """Read a PLY file of splats: from `write_splats`, 3DGS (three scales), 2DGS (two scales) or Ref-Gaussian.

    - Splats without a material become matte (MATTE). The constant harmonic gives their base colour.
    - Splats without a normal get the third axis of their rotation, which may point inwards.
    - Three scales are reordered so that the smallest is the last.
    - Splats with a NaN or infinite value are left out, with an InputWarning.

    Raises InputError if the file is missing, broken, or not a file of splats.
    """
    return splats_of_ply(read_ply(path), path)


def splats_of_ply(data: PlyData, path: str | os.PathLike) -> Splats:
    """Return the splats of a PLY file that was read from `path`, as `read_splats` does. Raises InputError."""
    if "vertex" not in data:
        raise InputError(f"{path} has no element vertex: it is not a PLY file of splats")
    vertex = data["vertex"]
    names = [p.name for p in vertex.properties if not isinstance(p, PlyListProperty)]
    if "packed_position" in names:
        raise InputError(f"{path} is a compressed PLY: make a plain one of it, with splat-transform or SuperSplat")
    ours = not {*_MATERIAL[:4]}.isdisjoint(names)
    found = [_CONSTANT.fullmatch(comment.strip()) for comment in data.comments] if ours else []
    constants = {match[1]: _constant(match, path) for match in found if match and match[1] not in names}
    material = [name for name in _MATERIAL if name not in constants]
    normals = {*_HEAD[3:6]} <= {*names}
    needed = [*_HEAD, *_TAIL, *(material if ours else [])]
    missing = [name for name in needed if name not in names and (ours or name not in _HEAD[3:6])]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}: it is not a PLY file of splats, or not a whole one")
    rows, known = np.asarray(vertex.data), set()

    def columns(*wanted: str) -> np.ndarray:
        known.update(wanted)
        if not wanted:
            return np.empty((vertex.count, 0), np.float32)
        part = rows[[*wanted]]  # a view; numpy cannot convert it directly where the row also has lists
        return structured_to_unstructured(repack_fields(part) if rows.dtype.hasobject else part, np.float32, copy=True)

    def harmonics(prefix: str, *counts: int) -> np.ndarray:
        """Read PREFIX0 … as harmonics (N, K, 3). Raises InputError unless 3·K is in `counts`."""
        found = sum(re.fullmatch(rf"{prefix}\d+", name) is not None for name in names)
        wanted = [f"{prefix}{i}" for i in range(found)]
        if found not in counts or not {*wanted} <= {*names}:
            numbers = ", ".join(map(str, counts))
            raise InputError(f"{path} has {found} {prefix} values a splat: spherical harmonics have {numbers}")
        return columns(*wanted).reshape(vertex.count, 3, found // 3).transpose(0, 2, 1)

    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        sh = np.concatenate(
            [columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], harmonics("f_rest_", 0, 9, 24, 45)], axis=1
        )
        scales = np.exp(columns(*(name for name in ("scale_0", "scale_1", "scale_2") if name in names)))
        rotations = columns("rot_0", "rot_1", "rot_2", "rot_3")
        length = np.linalg.norm(rotations, axis=1, keepdims=True)
        length[np.isinf(length)] = np.nan  # whose quotient would be zero
        rotations = np.where(np.abs(length - 1) < 1e-4, rotations, rotations / length)  # keep the bits of unit ones
        if scales.shape[1] == 3:
            rotations, scales = _shortest_last(rotations, scales)
        if ours:
            albedo = columns(*_MATERIAL[:3])
            metallic, roughness = (
                np.full(vertex.count, constants[name], np.float32) if name in constants else columns(name)[:, 0]
                for name in _MATERIAL[3:]
            )
        elif {*_REF_GAUSSIAN} <= {*names}:
            *albedo, metallic, roughness = _logistic(columns(*_REF_GAUSSIAN)).T
            albedo = srgb_decode(np.stack(albedo, axis=1))
        else:
            albedo = srgb_decode((0.5 + DC * sh[:, 0]).clip(0, 1))
            metallic, roughness = (np.full(vertex.count, value, np.float32) for value in MATTE)
        splats = Splats(
            positions=columns("x", "y", "z"),
            normals=columns("nx", "ny", "nz") if normals else np.zeros((vertex.count, 3), np.float32),
            sh=sh,
            opacities=_logistic(columns("opacity")[:, 0]),
            scales=scales,
            rotations=rotations,
            albedo=albedo,
            metallic=metallic,
            roughness=roughness,
            received=columns(*_RECEIVED) if {*_RECEIVED} <= {*names} else np.ones((vertex.count, 3), np.float32),
            indirect=harmonics("ind_", 0, 3, 12, 27, 48),
            doubt=columns(_DOUBT)[:, 0] if ours and _DOUBT in names else None,
            constants=constants,
        )
    none = ~splats.normals.any(axis=1)  # 3DGS writes zeros
    splats.normals[none] = _third_axis(rotations[none])
    splats.others = _other_elements(data.elements, known)
    return _without_nonfinite(splats, Path(path))


def _constant(match: re.Match, path: str | os.PathLike) -> float:
    try:
        value = float(match[2])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: {match[1]} is {match[2]}, not a number: export it again")
    return value


def _logistic(values: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-values))


def _third_axis(rotations: np.ndarray) -> np.ndarray:
    w, x, y, z = rotations.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def _shortest_last(rotations: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reorder 3D Gaussians' axes so that the shortest, the normal, is the third."""
    shortest = np.where(scales[:, 2] <= scales.min(axis=1), 2, scales.argmin(axis=1))
    turned = quaternion_product(rotations, _TO_THIRD[shortest])
    return turned, np.take_along_axis(scales, (shortest[:, None] + np.arange(1, 4)) % 3, axis=1)


def quaternion_product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Multiply quaternions wxyz (..., 4): turn by `right`, then by `left`."""
    w, x, y, z = np.moveaxis(left, -1, 0)
    a, b, c, d = np.moveaxis(right, -1, 0)
    product = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return np.stack(product, axis=-1)


def _other_elements(elements: tuple[PlyElement, ...], known: set[str]) -> tuple[PlyElement, ...]:
    """Copy PLY elements without the properties of `vertex` named in `known`."""
    kept = []
    for element in elements:
        more = [p for p in element.properties if element.name != "vertex" or p.name not in known]
        if more:
            copy = PlyElement(element.name, more, element.count)
            copy.data = np.array(element.data[[p.name for p in more]])
            kept.append(copy)
    return tuple(kept)


def _without_nonfinite(splats: Splats, path: Path) -> Splats:
    """Remove nonfinite splats with an InputWarning, and in that case also other elements."""
    # Other elements may refer to splats by row number, which has changed.
    values = {name: value for name, value in vars(splats).items() if isinstance(value, np.ndarray)}
    wrong = [name for name, value in values.items() if not np.isfinite(value).all()]
    if not wrong:
        return splats
    fine = np.logical_and.reduce([np.isfinite(v).reshape(len(splats), -1).all(axis=1) for v in values.values()])
    message = (
        f"{path}: {(~fine).sum():,} of {len(splats):,} splats have {', '.join(wrong)} that are not finite: left out"
    )
    warnings.warn(message, InputWarning, stacklevel=3)
    others = []
    for element in splats.others:
        if element.name == "vertex":
            copy = PlyElement(element.name, element.properties, int(fine.sum()))
            copy.data = element.data[fine]
            others.append(copy)
    return replace(splats, **{name: value[fine] for name, value in values.items()}, others=tuple(others))
