"""Compute the floor of each kernel: the least time that the kernel could take on this machine.

A kernel's arithmetic operations are counted by hand from its formulas. Its bytes are all its inputs and outputs, each moved once between
memory and processor. Both need some time even at the machine's peak speed. The floor is the longer of the two times.
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


class Cost(NamedTuple):
    """Hold the cost of a kernel: its arithmetic operations, and the bytes that it moves."""

    operations: float
    bytes: float


class Machine(NamedTuple):
    """Hold the peak speed of a machine: operations and bytes per second."""

    operations: float
    bytes: float

    @classmethod
    def measured(cls, device: torch.device = torch.device("cpu")) -> "Machine":  # noqa: B008  it never changes
        """Measure the peak speed of this machine, on the CPU or on a GPU."""
        return cls(arithmetic(device=device), bandwidth(device=device))

    def floor(self, cost: Cost) -> float:
        """Compute the least time, in milliseconds, that this machine needs for a kernel of this cost."""
        return 1e3 * max(cost.operations / self.operations, cost.bytes / self.bytes)


def covered_pairs(surfels: list[torch.Tensor], camera: Camera) -> float:
    """Estimate how many pixels the surfels of a unit ball cover. A pixel counts once for each surfel that covers it.

    Only surfels that face the camera count. The estimate is the sum of their projected areas in pixels.
    """
    positions, _, scales, opacities, _ = (v.detach().double() for v in surfels)
    towards = torch.from_numpy(camera.position).to(positions) - positions
    # On the unit ball, positions are the normals.
    cosine = torch.nn.functional.cosine_similarity(positions, towards).clamp_min(0)
    # Squared radius, in standard deviations, where alpha falls to 1/255.
    reach = 2 * torch.log(255 * opacities).clamp_min(0)
    depth = towards.norm(dim=1)
    return float((math.pi * reach * scales.prod(dim=1) * cosine * camera.fx * camera.fy / depth**2).sum())


def raster(surfels: list[torch.Tensor], camera: Camera) -> tuple[Cost, Cost]:
    """Compute by formula how many operations the rasteriser does, and how many bytes it moves.

    Return one Cost for a forward pass and one for a backward pass. The surfels must lie on the unit ball.
    """
    pixels, channels = camera.width * camera.height, surfels[-1].shape[1]
    given, maps, pairs = sum(v.nbytes for v in surfels), 4 * pixels * (channels + 2), covered_pairs(surfels, camera)
    forward = Cost(pairs * (FORWARD_OPERATIONS + CHANNEL_OPERATIONS[0] * channels), given + maps)
    return forward, Cost(pairs * (BACKWARD_OPERATIONS + CHANNEL_OPERATIONS[1] * channels), 2 * given + 2 * maps)


def ssim(pixels: int) -> Cost:
    """Compute by formula the operations and bytes of D-SSIM and its gradient, for two images with three channels and `pixels` pixels."""
    return Cost(3 * pixels * SSIM_OPERATIONS, 3 * pixels * 4 * 3)


def shading(covered: int, pixels: int) -> Cost:
    """Compute by formula the operations and bytes of deferred shading, forward and backward together.

    The image has `pixels` pixels; `covered` of them show a surface. Operations are counted only for these, bytes for all pixels.
    """
    # Eleven channels and alpha are read twice, and their derivatives are written; fourteen numbers are written, eleven derivatives read.
    return Cost(covered * SHADING_OPERATIONS, 4 * pixels * (3 * 12 + 14 + 11))


def prefiltering(side: int) -> Cost:
    """Compute by formula the operations and bytes of prefiltering a cubemap of 6·side² texels, forward and backward together.

    The filter is a sparse matrix. Because a cube is symmetric, each number in it occurs SYMMETRIES times but is stored only once. Each pass
    reads every stored number once and uses it SYMMETRIES times.
    """
    numbers = matrices(side, torch.device("cpu"))[0].numbers.numel()
    texels = 6 * sum(s * s for s in level_sides(side))
    return Cost(2 * 2 * 3 * SYMMETRIES * numbers, 2 * (8 * numbers + 4 * 3 * texels))
