"""Compute floors: the least time that each part of the program can take on this machine.

A part needs operations, which are counted by hand from the kernels' formulas. It also needs to move every input and output once between
memory and processor. The floor is the longer of the two times.
"""

import math
from typing import NamedTuple

import torch

from benchmarks.machine import arithmetic, bandwidth
from refgs.camera import Camera
from refgs.model.prefilter import SYMMETRIES, level_sides, matrices

# Operations for one surfel at one pixel: three affine functions, a division, two squared distances, an exponential, blending. Backward
# repeats them and adds the derivatives. CHANNEL_OPERATIONS are added for each channel, forward and backward.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 45, 110
CHANNEL_OPERATIONS = (2, 4)
# Operations for one channel of a pixel: windows of 11 + 11 over four images, SSIM and its derivatives; then windows over the derivatives.
SSIM_OPERATIONS = 208 + 123
# Operations for one pixel: resampling the normal, twelve texels, the reflectance table, colour. Backward repeats them and adds the
# derivatives.
SHADING_OPERATIONS = 410 + 1000


class Need(NamedTuple):
    """Hold how many operations a part of the program does, and how many bytes it moves."""

    operations: float
    bytes: float


class Machine(NamedTuple):
    """Hold how many operations and bytes a second a machine can do at most."""

    operations: float
    bytes: float

    @classmethod
    def measured(cls, device: torch.device = torch.device("cpu")) -> "Machine":  # noqa: B008  it never changes
        """Measure how many operations and bytes a second this machine can do at most."""
        return cls(arithmetic(device=device), bandwidth(device=device))

    def floor(self, need: Need) -> float:
        """Compute the least time in milliseconds for a part's operations and bytes."""
        return 1e3 * max(need.operations / self.operations, need.bytes / self.bytes)


def covered_pairs(surfels: list[torch.Tensor], camera: Camera) -> float:
    """Estimate how many pixels each surfel covers, summed over the surfels of a unit ball.

    The sum is the projected area, in pixels, of the surfels that face the camera.
    """
    positions, _, scales, opacities, _ = (v.detach().double() for v in surfels)
    towards = torch.from_numpy(camera.position).to(positions) - positions
    # On the unit ball, positions are the normals.
    cosine = torch.nn.functional.cosine_similarity(positions, towards).clamp_min(0)
    # Squared radius, in standard deviations, where alpha falls to 1/255.
    reach = 2 * torch.log(255 * opacities).clamp_min(0)
    depth = towards.norm(dim=1)
    return float((math.pi * reach * scales.prod(dim=1) * cosine * camera.fx * camera.fy / depth**2).sum())


def raster(surfels: list[torch.Tensor], camera: Camera) -> tuple[Need, Need]:
    """Count the rasteriser's operations and bytes for surfels of a unit ball, for the forward pass and for the backward pass."""
    pixels, channels = camera.width * camera.height, surfels[-1].shape[1]
    given, maps, pairs = sum(v.nbytes for v in surfels), 4 * pixels * (channels + 2), covered_pairs(surfels, camera)
    forward = Need(pairs * (FORWARD_OPERATIONS + CHANNEL_OPERATIONS[0] * channels), given + maps)
    return forward, Need(pairs * (BACKWARD_OPERATIONS + CHANNEL_OPERATIONS[1] * channels), 2 * given + 2 * maps)


def ssim(pixels: int) -> Need:
    """Count the operations and bytes of D-SSIM and its derivative, for two images of three channels."""
    return Need(3 * pixels * SSIM_OPERATIONS, 3 * pixels * 4 * 3)


def shading(covered: int, pixels: int) -> Need:
    """Count the operations and bytes of deferred shading, forward and backward.

    For each of the `pixels`, shading reads eleven channels and alpha twice, writes their derivatives, writes fourteen numbers and reads
    eleven derivatives. Operations are only needed for the `covered` pixels.
    """
    return Need(covered * SHADING_OPERATIONS, 4 * pixels * (3 * 12 + 14 + 11))


def prefiltering(side: int) -> Need:
    """Count the operations and bytes of prefiltering a cubemap of 6·side² texels, forward and backward.

    Each pass reads the filter's matrix once, and uses each of its numbers for all symmetries of the cubemap.
    """
    numbers = matrices(side, torch.device("cpu"))[0].numbers.numel()
    texels = 6 * sum(s * s for s in level_sides(side))
    return Need(2 * 2 * 3 * SYMMETRIES * numbers, 2 * (8 * numbers + 4 * 3 * texels))
