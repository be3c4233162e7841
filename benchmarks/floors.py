"""Floors: the least time that each part can take on this machine.

A part needs operations, counted by hand from the kernels' formulas, and bytes of memory, every input and output moved once. Whichever
takes longer is its floor.
"""

import math
from typing import NamedTuple

import torch

from benchmarks.machine import arithmetic, bandwidth
from refgs.camera import Camera
from refgs.model.prefilter import SYMMETRIES, level_sides, matrices

# For one surfel at one pixel: three affine functions, a division, two squared distances, an exponential, blending. Backward repeats
# them and adds the derivatives. Each channel adds its own.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 45, 110
CHANNEL_OPERATIONS = (2, 4)
# For a pixel's channel: windows of 11 + 11 over four images, the index and its derivatives; then windows over those three.
SSIM_OPERATIONS = 208 + 123
# For a pixel: its normal resampled, twelve texels, the table, colour. Backward repeats them and adds the derivatives.
SHADING_OPERATIONS = 410 + 1000


class Need(NamedTuple):
    """Operations and bytes that a part needs."""

    operations: float
    bytes: float


class Machine(NamedTuple):
    """Operations and bytes that can be done in a second."""

    operations: float
    bytes: float

    @classmethod
    def measured(cls, device: torch.device = torch.device("cpu")) -> "Machine":  # noqa: B008  it never changes
        """Measure this machine."""
        return cls(arithmetic(device=device), bandwidth(device=device))

    def floor(self, need: Need) -> float:
        """Least milliseconds that a need takes."""
        return 1e3 * max(need.operations / self.operations, need.bytes / self.bytes)


def covered_pairs(surfels: list[torch.Tensor], camera: Camera) -> float:
    """Estimate the pairs of surfel and pixel on a ball: the areas of the ellipses that face the camera."""
    positions, _, scales, opacities, _ = (v.detach().double() for v in surfels)
    towards = torch.from_numpy(camera.position).to(positions) - positions
    cosine = torch.nn.functional.cosine_similarity(positions, towards).clamp_min(0)  # positions are normals, too
    reach = 2 * torch.log(255 * opacities).clamp_min(0)  # squared, in standard deviations
    depth = towards.norm(dim=1)
    return float((math.pi * reach * scales.prod(dim=1) * cosine * camera.fx * camera.fy / depth**2).sum())


def raster(surfels: list[torch.Tensor], camera: Camera) -> tuple[Need, Need]:
    """Needs of the rasteriser forward and backward, for a ball."""
    pixels, channels = camera.width * camera.height, surfels[-1].shape[1]
    given, maps, pairs = sum(v.nbytes for v in surfels), 4 * pixels * (channels + 2), covered_pairs(surfels, camera)
    forward = Need(pairs * (FORWARD_OPERATIONS + CHANNEL_OPERATIONS[0] * channels), given + maps)
    return forward, Need(pairs * (BACKWARD_OPERATIONS + CHANNEL_OPERATIONS[1] * channels), 2 * given + 2 * maps)


def ssim(pixels: int) -> Need:
    """Need of D-SSIM and its derivative, for two images of three channels."""
    return Need(3 * pixels * SSIM_OPERATIONS, 3 * pixels * 4 * 3)


def shading(covered: int, pixels: int) -> Need:
    """Need of deferred shading both ways: eleven channels and alpha twice, their derivatives, fourteen numbers out, eleven back."""
    return Need(covered * SHADING_OPERATIONS, 4 * pixels * (3 * 12 + 14 + 11))


def prefiltering(side: int) -> Need:
    """Need of a cubemap's prefilter both ways: the matrix is read once each way, and each number serves all symmetries."""
    numbers = matrices(side, torch.device("cpu"))[0].numbers.numel()
    texels = 6 * sum(s * s for s in level_sides(side))
    return Need(2 * 2 * 3 * SYMMETRIES * numbers, 2 * (8 * numbers + 4 * 3 * texels))
