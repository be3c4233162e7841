"""The least that each part can take, by what it has to do and what the machine can: operations, counted by hand from the kernels'
formulas, and bytes of memory, everything that is given and returned being moved once."""

import math
import tomllib
from typing import NamedTuple

import torch

from benchmarks.machine import arithmetic, bandwidth
from refgs import __version__
from refgs.camera import Camera
from refgs.model.prefilter import SYMMETRIES, level_sides, matrices
from refgs.paths import clone_root

# Of one surfel at one pixel: three affine functions, a division, two squared distances, an exponential, blending; backward those
# again, and the derivatives of all of them. And for each channel.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 45, 110
CHANNEL_OPERATIONS = (2, 4)
# Of a pixel's channel: windows of 11 + 11 over four images, the index and its derivatives; windows over those three.
SSIM_OPERATIONS = 208 + 123
# Of a pixel: its normal resampled, twelve texels, the table, colour; backward those again, and the derivatives.
SHADING_OPERATIONS = 410 + 1000


class Need(NamedTuple):
    """What a part has to do."""

    operations: float
    bytes: float


class Machine(NamedTuple):
    """What can be done in a second, at the most."""

    operations: float
    bytes: float

    @classmethod
    def measured(cls, device: torch.device = torch.device("cpu")) -> "Machine":  # noqa: B008  it never changes
        """Of this one."""
        return cls(arithmetic(device=device), bandwidth(device=device))

    def floor(self, need: Need) -> float:
        """Milliseconds at the least."""
        return 1e3 * max(need.operations / self.operations, need.bytes / self.bytes)


def covered_pairs(surfels: list[torch.Tensor], camera: Camera) -> float:
    """How many pairs of surfel and pixel there are on a ball, about: the ellipses' areas, of the surfels that face the camera."""
    positions, _, scales, opacities, _ = (v.detach().double() for v in surfels)
    towards = torch.from_numpy(camera.position).to(positions) - positions
    cosine = torch.nn.functional.cosine_similarity(positions, towards).clamp_min(0)  # positions are normals, too
    reach = 2 * torch.log(255 * opacities).clamp_min(0)  # squared, in standard deviations
    depth = towards.norm(dim=1)
    return float((math.pi * reach * scales.prod(dim=1) * cosine * camera.fx * camera.fy / depth**2).sum())


def raster(surfels: list[torch.Tensor], camera: Camera) -> tuple[Need, Need]:
    """Forward and backward, of a ball."""
    pixels, channels = camera.width * camera.height, surfels[-1].shape[1]
    given, maps, pairs = sum(v.nbytes for v in surfels), 4 * pixels * (channels + 2), covered_pairs(surfels, camera)
    forward = Need(pairs * (FORWARD_OPERATIONS + CHANNEL_OPERATIONS[0] * channels), given + maps)
    return forward, Need(pairs * (BACKWARD_OPERATIONS + CHANNEL_OPERATIONS[1] * channels), 2 * given + 2 * maps)


def ssim(pixels: int) -> Need:
    """D-SSIM and its derivative, of two images of three channels."""
    return Need(3 * pixels * SSIM_OPERATIONS, 3 * pixels * 4 * 3)


def shading(covered: int, pixels: int) -> Need:
    """Deferred shading both ways: eleven channels and alpha twice and their derivatives, fourteen numbers out, eleven back."""
    return Need(covered * SHADING_OPERATIONS, 4 * pixels * (3 * 12 + 14 + 11))


def prefiltering(side: int) -> Need:
    """Of a cubemap, both ways: its matrix is read once each way, and every number stands for as many as there are symmetries."""
    numbers = matrices(side, torch.device("cpu"))[0].numbers.numel()
    texels = 6 * sum(s * s for s in level_sides(side))
    return Need(2 * 2 * 3 * SYMMETRIES * numbers, 2 * (8 * numbers + 4 * 3 * texels))


def previous(*keys: str) -> tuple[str, dict[str, float]]:
    """The last release but this one that docs/benchmarks.toml has figures of, and they; none: an empty name."""
    kept = tomllib.loads((clone_root() / "docs" / "benchmarks.toml").read_text(encoding="utf-8"))
    for release, figures in reversed(kept.items()):
        for key in keys:
            figures = figures.get(key, {})
        if release != __version__ and figures:
            return release, figures
    return "", {}
