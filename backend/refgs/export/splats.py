"""splats.ply: one row a splat, in the property names of 3D Gaussian splatting, with materials."""

import os
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from refgs.errors import InputError
from refgs.paths import whole


@dataclass
class Splats:
    """N surfels with appearance and materials; float32 numpy arrays.

    positions (N, 3), normals (N, 3) unit and pointing outward where that is known, sh (N, K, 3) spherical harmonics
    with K = (degree + 1)² and colour = 0.5 + SH (the 3DGS convention), opacities (N,) in 0..1, scales (N, 2) standard
    deviations in world units, or (N, 3) of 3D Gaussians with the normal's last, rotations (N, 4) unit quaternions wxyz,
    albedo (N, 3) linear Rec.709, metallic (N,) and perceptual roughness (N,) in 0..1, received (N, 3) the part of the recovered
    light's irradiance that reaches a surfel, with what comes from the object itself, indirect (N, K', 3) spherical harmonics
    of the linear radiance that comes from the object itself; K' is 0 where a scene does without, all of `received` is 1 then.
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

    def __len__(self) -> int:
        return len(self.positions)


_HEAD = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
_TAIL = ["opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"]
THIN = 0.05  # of a surfel's smaller scale: the third, for viewers of 3D Gaussians
_RECEIVED = ["received_r", "received_g", "received_b"]
_MATERIAL = ["albedo_r", "albedo_g", "albedo_b", "metallic", "roughness"]


def write_splats(path: str | os.PathLike, splats: Splats) -> None:
    """Write a binary little-endian PLY with one `vertex` element; see docs for the properties.

    Opacity is stored as a logit and scales as logarithms, as 3DGS viewers expect; spherical harmonics of the first
    degree and above are channel-major; materials are stored as they are. Opacities are clipped to 1e-6 .. 1 - 1e-6.
    """
    names, columns = _common(splats, splats.scales)
    names += _MATERIAL
    columns += [splats.albedo, splats.metallic, splats.roughness]
    if splats.indirect.shape[1]:
        names += [*_RECEIVED, *(f"ind_{i}" for i in range(3 * splats.indirect.shape[1]))]
        columns += [splats.received, splats.indirect.transpose(0, 2, 1)]
    _write(path, names, columns)


def write_display_splats(path: str | os.PathLike, splats: Splats) -> None:
    """Write a binary little-endian PLY as 3D Gaussian splatting's viewers expect it: harmonics, opacity, three scales, of which a
    surfel's third is THIN of its smaller one (zero would hide it), rotation; no materials."""
    scales = splats.scales
    if scales.shape[1] == 2:
        scales = np.column_stack([scales, THIN * scales.min(axis=1)])
    _write(path, *_common(splats, scales))


def _common(splats: Splats, scales: np.ndarray) -> tuple[list[str], list[np.ndarray]]:
    """The properties that all splats' files have, and their columns."""
    opacity = np.clip(splats.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(len(splats), -1)
    columns = [
        splats.positions,
        splats.normals,
        splats.sh[:, 0],
        rest,
        np.log(opacity / (1 - opacity)),
        np.log(np.maximum(scales.astype(np.float64), 1e-30)),
        splats.rotations,
    ]
    names = [*_HEAD, *(f"f_rest_{i}" for i in range(rest.shape[1])), *_TAIL]
    if scales.shape[1] == 3:
        names.insert(names.index("scale_1") + 1, "scale_2")
    return names, columns


def _write(path: str | os.PathLike, names: list[str], columns: list[np.ndarray]) -> None:
    table = np.concatenate([np.reshape(c, (len(c), -1)) for c in columns], axis=1).astype("<f4")
    rows = np.ascontiguousarray(table).view([(name, "<f4") for name in names])[:, 0]
    with whole(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(temporary))


def read_splats(path: str | os.PathLike) -> Splats:
    """Read what `write_splats` wrote. Raises InputError for a file that is missing, broken, or without materials."""
    path = Path(path)
    try:
        vertex = PlyData.read(str(path))["vertex"]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError):
        raise InputError(f"{path} is not a whole PLY file of splats: export it again") from None
    names = {p.name for p in vertex.properties}
    missing = [name for name in [*_HEAD, *_TAIL, *_MATERIAL] if name not in names]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}: it is not a splats.ply that RefGS wrote")

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], np.float32) for name in wanted], axis=1)

    def harmonics(prefix: str, *known: int) -> np.ndarray:
        """(N, K, 3) from the channel-major values of a name, which must be as many as some degree has."""
        values = sum(name.startswith(prefix) for name in names)
        if values not in known:
            numbers = ", ".join(map(str, known))
            raise InputError(f"{path} has {values} {prefix} values a splat: spherical harmonics have {numbers}")
        if values == 0:
            return np.zeros((vertex.count, 0, 3), np.float32)
        table = columns(*(f"{prefix}{i}" for i in range(values)))
        return table.reshape(vertex.count, 3, values // 3).transpose(0, 2, 1)

    splats = Splats(
        positions=columns("x", "y", "z"),
        normals=columns("nx", "ny", "nz"),
        sh=np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], harmonics("f_rest_", 0, 9, 24, 45)], axis=1),
        opacities=1 / (1 + np.exp(-columns("opacity")[:, 0])),
        scales=np.exp(columns(*(name for name in ("scale_0", "scale_1", "scale_2") if name in names))),
        rotations=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        albedo=columns("albedo_r", "albedo_g", "albedo_b"),
        metallic=columns("metallic")[:, 0],
        roughness=columns("roughness")[:, 0],
        received=columns(*_RECEIVED) if {*_RECEIVED} <= names else np.ones((vertex.count, 3), np.float32),
        indirect=harmonics("ind_", 0, 3, 12, 27, 48),
    )
    for field in fields(splats):
        if not np.isfinite(getattr(splats, field.name)).all():
            raise InputError(f"{path} holds values that are not finite in its {field.name}: export it again")
    return splats
