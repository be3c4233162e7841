"""The surfels: raw parameters as they are learned, and their activated values as they are rendered."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from refgs.export.splats import Splats
from refgs.model import harmonics

Parameters = dict[str, Tensor]
"""Raw leaf tensors, one row a surfel: position (N, 3), rotation (N, 4) wxyz, scale (N, 2) log, opacity (N,) logit,
sh_dc (N, 1, 3), sh_rest (N, K−1, 3), albedo (N, 3) logit, metallic (N,) logit, roughness (N,) logit, indirect_dc and
indirect_rest as the SH."""


class Surfels(NamedTuple):
    """Activated values of N surfels: world units, linear Rec.709 albedo, materials in 0..1, SH with colour = 0.5 + SH.

    `indirect` (N, K, 3) are harmonics of the linear radiance that reaches a surfel from the object itself (paper Eq. 10).
    """

    positions: Tensor
    rotations: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    albedo: Tensor
    metallic: Tensor
    roughness: Tensor
    indirect: Tensor

    def normals(self) -> Tensor:
        """Unit normals t_u × t_v (N, 3): the third column of each rotation."""
        w, x, y, z = torch.nn.functional.normalize(self.rotations, dim=-1).unbind(-1)
        return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1)


def activate(p: Parameters) -> Surfels:
    """Raw parameters → values."""
    return Surfels(
        positions=p["position"],
        rotations=p["rotation"],
        scales=p["scale"].exp(),
        opacities=p["opacity"].sigmoid(),
        sh=torch.cat([p["sh_dc"], p["sh_rest"]], dim=1),
        albedo=p["albedo"].sigmoid(),
        metallic=p["metallic"].sigmoid(),
        roughness=p["roughness"].sigmoid(),
        indirect=torch.cat([p["indirect_dc"], p["indirect_rest"]], dim=1),
    )


def quaternions_towards(normals: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz (N, 4) that turn +z into the given unit normals (N, 3) the shortest way."""
    x, y, z = normals.T
    q = np.stack([1 + z, -y, x, np.zeros_like(z)], axis=1)
    q[1 + z < 1e-6] = (0, 1, 0, 0)  # straight down: half a turn about x
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def initial_parameters(
    positions: np.ndarray,
    normals: np.ndarray,
    spacing: np.ndarray,
    colours: np.ndarray | None,
    *,
    opacity: float,
    sh_degree: int,
    albedo: float,
    metallic: float,
    roughness: float,
) -> Parameters:
    """Round surfels at points (N, 3) facing along normals (N, 3), their standard deviation the spacing (N,).

    `colours` (N, 3), sRGB-encoded 0..1, start the SH; grey where there are none.
    """
    n = len(positions)

    def logit(value: float, *shape: int) -> Tensor:
        return torch.full(shape, float(np.log(value / (1 - value))))

    rest = (sh_degree + 1) ** 2 - 1

    colour = torch.full((n, 3), 0.5) if colours is None else torch.from_numpy(np.asarray(colours, np.float32))
    parameters = {
        "position": torch.from_numpy(np.asarray(positions, np.float32).copy()),
        "rotation": torch.from_numpy(quaternions_towards(np.asarray(normals, np.float64)).astype(np.float32)),
        "scale": torch.from_numpy(np.log(np.maximum(spacing, 1e-12)).astype(np.float32))[:, None].repeat(1, 2),
        "opacity": logit(opacity, n),
        "sh_dc": ((colour - 0.5) / harmonics.DC)[:, None].contiguous(),
        "sh_rest": torch.zeros(n, rest, 3),
        "albedo": logit(albedo, n, 3),
        "metallic": logit(metallic, n),
        "roughness": logit(roughness, n),
        "indirect_dc": torch.zeros(n, 1, 3),
        "indirect_rest": torch.zeros(n, rest, 3),
    }
    return {name: value.requires_grad_() for name, value in parameters.items()}


def to_splats(surfels: Surfels) -> Splats:
    """The asset's table, as `splats.ply` stores it."""
    with torch.no_grad():
        rotations = torch.nn.functional.normalize(surfels.rotations, dim=-1)
        return Splats(
            normals=surfels.normals().numpy(force=True),
            **{
                name: value.numpy(force=True) for name, value in surfels._replace(rotations=rotations)._asdict().items()
            },
        )


def from_splats(splats: Splats) -> Surfels:
    """The values to render, from the asset's table."""
    return Surfels(*(torch.from_numpy(np.ascontiguousarray(getattr(splats, name))) for name in Surfels._fields))
