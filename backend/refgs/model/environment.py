"""Represent distant light by a cubemap of linear HDR radiance, prefiltered for specular reflection (split sum) and for irradiance."""

import copy
import math

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.formats.panorama import directions as panorama_directions
from refgs.formats.panorama import sample as sample_panorama
from refgs.model import cubemap, harmonics, prefilter

CLIPPED = 1.0  # radiance from which on photos may clip what mirrors it: a lamp's


def turn_between(camera: Camera, reference: Camera) -> np.ndarray:
    """Return the rotation (3, 3) about world z from `camera`'s heading to `reference`'s."""
    angle = reference.heading - camera.heading
    sine, cosine = math.sin(angle), math.cos(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


class Environment:
    """Represent distant light by a cubemap of linear `radiance` (6·R², 3). `refgs.model.cubemap` defines the order of the texels.

    Without a `reference` camera, the light is fixed in the world. With a `reference`, it rotates about the world's z axis together with the
    rendering camera, as if the object stood on a turntable before a fixed camera. `radiance` is then the light for the reference camera.
    The light never tilts, because lamps stay where they are when a photo is taken from higher up.

    `told` marks texels, of any resolution, whose radiance mirrors tell. Irradiance teaches them nothing, unless they are lamps.
    """

    def __init__(self, radiance: Tensor, reference: Camera | None = None, told: Tensor | None = None):
        self.radiance, self.reference = radiance, reference
        self.resolution = math.isqrt(len(radiance) // 6)
        self.sides = tuple(prefilter.level_sides(self.resolution))
        taught = None
        if told is not None:
            texel = cubemap.texels_in(self.resolution, math.isqrt(len(told) // 6), told.device)
            taught = ~told[texel] | (radiance.detach().amax(dim=1) > CLIPPED)
        self.levels = prefilter.prefilter(radiance, self.resolution, taught)

    @property
    def harmonics(self) -> Tensor:
        """Compute the coefficients (16, 3) of `radiance` in the spherical harmonics up to degree 3."""
        directions, area = cubemap.texel_directions(self.resolution), cubemap.texel_solid_angles(self.resolution)
        return (harmonics.basis(directions, 3) * area[:, None]).T.float().to(self.radiance.device) @ self.radiance

    def diffuse(self, normals: Tensor) -> Tensor:
        """Return irradiance / π (P, 3) for unit normals (P, 3)."""
        return prefilter.irradiance(self.levels.cpu(), self.sides, normals.cpu()).to(normals)

    def turn(self, camera: Camera) -> np.ndarray:
        """Return the rotation (3, 3) from world directions to those in which `radiance` is stored."""
        return np.eye(3) if self.reference is None else turn_between(camera, self.reference)

    def without_reflections(self) -> "Environment":
        """Return the light as it reaches matte surfaces: with the same irradiance, and nothing to mirror."""
        matte = copy.copy(self)
        matte.levels = self.levels.clone()
        matte.levels[: -6 * self.sides[-1] ** 2] = 0  # irradiance is the last level
        return matte

    def reduced(self, side: int) -> "Environment":
        """Return the light with a cubemap of `side` texels along a side."""
        return Environment(cubemap.reduced(self.radiance, side), self.reference)

    def panorama(self, height: int) -> np.ndarray:
        """Convert `radiance` to an equirectangular picture (height, 2·height, 3), linear, in Blender's orientation."""
        directions = torch.from_numpy(panorama_directions(height, 2 * height)).reshape(-1, 3).float()
        level = torch.zeros(len(directions))
        colour = cubemap.sample(self.radiance.detach().cpu(), (self.resolution,), directions, level)
        return colour.reshape(height, 2 * height, 3).numpy()

    @classmethod
    def from_panorama(cls, panorama: np.ndarray, resolution: int, reference: Camera | None = None) -> "Environment":
        """Make the light from an equirectangular picture (H, W, 3) of linear radiance, in Blender's orientation.

        `resolution` is the number of texels along a side of the cubemap. Each texel is the mean of the picture over the texel's area.
        """
        fine = max(
            1, math.ceil(panorama.shape[0] / (2 * resolution))
        )  # samples a texel along each side, so that no pixel is skipped
        directions = cubemap.texel_directions(resolution * fine).numpy()
        colour = torch.from_numpy(np.ascontiguousarray(sample_panorama(panorama, directions), dtype=np.float32))
        colour = colour.reshape(6, resolution, fine, resolution, fine, 3).mean(dim=(2, 4))
        return cls(colour.reshape(-1, 3), reference)
