"""Learn a fog in the visual hull from photos: a density and a colour for each voxel. Hollows become clear.

The fog is a radiance field (Mildenhall et al. 2020, NeRF) on a grid, whose colour does not depend on the direction.
"""

import math

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import softplus

from refgs.geometry.field import Field, sample
from refgs.geometry.rays import Rays

ITERATIONS = 150
RAYS = 2048  # an iteration
SAMPLES = 48  # along a ray
RATES = 0.3, 0.05  # of densities and colours; they fall to a tenth
START = 0.05  # opacity of a voxel
MASK = 0.5  # weight of light that gets through the object
OPACITY = 0.002  # weight of the sum of opacities along a ray: one surface is cheaper than many veils
VARIATION = 0.1  # weight of the total variation of opacity
_SOFT = 0.03  # sRGB code, from which on errors count linearly
_OPAQUE, _CLEAR = 8.0, -20.0  # raw densities of pinned voxels, and of those outside
_SKIN = 1.0  # voxels: the hull is enlarged by so much, because its surface is uncertain
_TRUNCATION = 3.0  # voxels
_EDGE = 0.7  # voxels from the hull's surface to the last ones that hold fog


def open_hull(hull: Field, pinned: np.ndarray, rays: Rays, seed: int) -> Field:
    """Learn a fog in a visual hull, and return the shape that it leaves of the hull.

    The surface is known in the voxels `pinned` (X, Y, Z): they stay opaque. The light must not move relative to the object.
    """
    near, far = hull.enter(rays.origin, rays.direction, _SKIN)
    fog = _Fog(hull, torch.from_numpy(pinned), rays, near, far)
    fog.learn(torch.Generator().manual_seed(seed))
    values = gaussian_filter(rays.fuse(fog.distances().numpy(), hull, _TRUNCATION), 0.6)
    # Smoothing must not open walls that are known.
    kept = pinned & (hull.values > -1.2)
    values[kept] = np.minimum(values, hull.values + 0.1)[kept]
    return Field(values, hull.low, hull.voxel)


class _Fog:
    def __init__(self, hull: Field, pinned: Tensor, rays: Rays, near: Tensor, far: Tensor):
        self.rays, self.near, self.far = rays, near, far
        self.known = torch.nonzero(near.isfinite())[:, 0]
        self.inside = hull.tensor[0] < 0
        self.fixed = pinned | (hull.tensor[0] >= _EDGE)
        self.value = torch.where(pinned & (hull.tensor[0] < _EDGE), _OPAQUE, _CLEAR)
        self.shift = math.log(math.expm1(-math.log1p(-START)))
        self.raw = torch.zeros_like(hull.tensor[0], requires_grad=True)
        mean = rays.color.clamp(0, 1).mean(dim=0).clamp(0.05, 0.95)
        self.color = torch.logit(mean)[:, None, None, None].expand(3, *self.raw.shape).clone().requires_grad_()

    def density(self) -> Tensor:
        return torch.where(self.fixed, self.value, self.raw)[None]

    def optical_depth(self, density: Tensor, at: Tensor) -> Tensor:
        """Return the optical depth (M,) of a voxel's length at positions (M, 3)."""
        return softplus(sample(density, at)[:, 0] + self.shift)

    def learn(self, random: torch.Generator) -> None:
        rates = [{"params": [value], "lr": rate} for value, rate in zip((self.raw, self.color), RATES, strict=True)]
        adam = torch.optim.Adam(rates, betas=(0.9, 0.98), eps=1e-10, fused=True)
        decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.1 ** (1 / ITERATIONS))
        for _ in range(ITERATIONS if len(self.known) else 0):
            adam.zero_grad(set_to_none=True)
            self._loss(self.known[torch.randint(len(self.known), (RAYS,), generator=random)], random).backward()
            adam.step()
            decay.step()

    def _loss(self, ids: Tensor, random: torch.Generator) -> Tensor:
        origin, direction = self.rays.origin[ids], self.rays.direction[ids]
        step = ((self.far - self.near)[ids] / SAMPLES)[:, None]
        away = self.near[ids, None] + step * (torch.arange(SAMPLES) + torch.rand(RAYS, SAMPLES, generator=random))
        at, density = origin[:, None] + direction[:, None] * away[..., None], self.density()
        with torch.no_grad():  # most samples are behind a surface or in clear air, and need no gradient
            opacity = 1 - torch.exp(-step * self.optical_depth(density, at.view(-1, 3)).view_as(away))
            row, column = torch.nonzero((_left(opacity)[:, :-1] > 0.01) & (opacity > 1e-4), as_tuple=True)
            at = at[row, column]
        opacity = 1 - torch.exp(-step[row, 0] * self.optical_depth(density, at))
        opacity = torch.zeros_like(away).index_put((row, column), opacity)
        left = _left(opacity)
        weight = (opacity * left[:, :-1])[row, column]
        color = torch.sigmoid(sample(self.color, at)) * weight[:, None]
        off = torch.zeros(RAYS, 3).index_add(0, row, color) - self.rays.color[ids].clamp(0, 1)
        error = torch.sqrt(off.square().sum(dim=1) + _SOFT**2) - _SOFT
        opaque = (error + MASK * left[:, -1])[self.rays.solid[ids]].sum() / RAYS
        voxel = 1 - torch.exp(-softplus(self.raw + self.shift))
        variation = sum(voxel.diff(dim=a).abs().sum() for a in range(3)) / self.inside.sum()
        return opaque + OPACITY * opacity.sum(dim=1).mean() + VARIATION * variation

    @torch.no_grad()
    def distances(self) -> Tensor:
        """Return the distance (N,) at which half of the light has been absorbed, in voxels; NaN if it never is."""
        found, half, density, size = torch.full_like(self.near, torch.nan), math.log(2), self.density(), 8
        for rays in self.known.split(65536):
            away, absorbed = self.near[rays], torch.zeros(len(rays))
            while len(rays):
                steps = away[:, None] + torch.arange(size) + 0.5
                at = self.rays.origin[rays][:, None] + self.rays.direction[rays][:, None] * steps[..., None]
                depth = self.optical_depth(density, at.view(-1, 3)).view_as(steps)
                after = absorbed[:, None] + depth.cumsum(dim=1)
                met, step = (after >= half).max(dim=1)
                at_step = step[:, None]
                excess = ((after.gather(1, at_step) - half) / depth.gather(1, at_step).clamp(min=1e-8))[:, 0]
                found[rays[met]] = (away + step + 1 - excess.clamp(0, 1))[met]
                going = ~met & (away + size < self.far[rays])
                rays, away, absorbed = rays[going], away[going] + size, after[going, -1]
        return found


def _left(opacity: Tensor) -> Tensor:
    """Return the transmittance (R, S + 1) before each of a ray's samples and after the last."""
    return torch.cat([torch.ones_like(opacity[:, :1]), 1 - opacity], dim=1).cumprod(dim=1)
