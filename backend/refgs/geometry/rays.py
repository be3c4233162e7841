"""Gather the rays of photos' pixels that show an object."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.geometry.field import Field
from refgs.geometry.project import inside, pixel_rays, project
from refgs.geometry.shape import Photo

ACROSS = 100  # pixels across the object, in the reduced photos
_SHOWN, _SOLID = 0.5, 0.97  # alpha from which on a pixel shows the object, and nothing else


class Rays(NamedTuple):
    """Hold N rays through pixels of reduced photos, whose masks show the object.

    `origin` (N, 3) is in voxels, and `direction` (N, 3) has unit length. `color` (N, 3) is sRGB-encoded; 1 is white. `clipped` (N, 3)
    marks channels whose true radiance may be higher. `solid` (N,) is true if the pixel shows nothing but the object. `photo` (N,) is the
    photo's index, and `pixels` has the camera, the rows and the columns of each photo's rays.
    """

    origin: Tensor
    direction: Tensor
    color: Tensor
    clipped: Tensor
    solid: Tensor
    photo: Tensor
    pixels: list[tuple[Camera, np.ndarray, np.ndarray]]

    @staticmethod
    def of(photos: Sequence[Photo], hull: Field) -> "Rays":
        """Reduce photos, and gather their rays. Positions are in voxels of `hull`, the object's visual hull."""
        parts, pixels = [], []
        for index, photo in enumerate(photos):
            camera = hull.shape.fit(photo.camera, ACROSS)
            size = camera.width, camera.height
            image, alpha = (cv2.resize(map_, size, interpolation=cv2.INTER_AREA) for map_ in (photo.image, photo.alpha))
            rows, columns = np.nonzero(alpha > 255 * _SHOWN)
            rays, colors = pixel_rays(camera, rows, columns), image[rows, columns]
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            origin = np.broadcast_to((camera.position - hull.low) / hull.voxel, rays.shape)
            clipped = colors >= np.iinfo(photo.image.dtype).max // 255 * 254
            solid, photo_of = alpha[rows, columns] > 255 * _SOLID, np.full(len(rows), index)
            parts.append((origin, rays, colors / photo.white, clipped, solid, photo_of))
            pixels.append((camera, rows, columns))
        joined = [np.concatenate(part) for part in zip(*parts, strict=True)]
        origin, direction, color = (torch.from_numpy(values.astype(np.float32)) for values in joined[:3])
        clipped, solid, photo_of = map(torch.from_numpy, joined[3:])
        return Rays(origin, direction, color, clipped, solid, photo_of, pixels)

    def fuse(self, distance: np.ndarray, hull: Field, truncation: float) -> np.ndarray:
        """Fuse the distances (N,) at which rays meet a surface into signed distances (X, Y, Z), in voxels (Curless and Levoy 1996).

        NaN means that the distance is unknown. Signed distances are limited to ± `truncation`. Inside the hull, voxels that no ray passes
        are solid.
        """
        index = np.argwhere(hull.values < 1.5)
        points = index * hull.voxel + hull.low
        total, count = np.zeros((2, len(index)), np.float32)
        ends = np.cumsum([len(rows) for _, rows, _ in self.pixels])
        for (camera, rows, columns), part in zip(self.pixels, np.split(distance, ends[:-1]), strict=True):
            picture = np.full((camera.height, camera.width), np.nan, np.float32)
            picture[rows, columns] = part
            at, depth = project(camera, points)
            on = inside(camera, at, depth)
            column, row = np.where(on[:, None], at, 0).astype(int).T
            away = np.linalg.norm(points - camera.position, axis=1) / hull.voxel
            signed = picture[row.clip(max=camera.height - 1), column.clip(max=camera.width - 1)] - away
            told = on & (signed > -truncation)  # false for NaN
            total += np.where(told, signed.clip(max=truncation), 0)
            count += told
        fused = np.where(hull.values < 1.5, -truncation, truncation).astype(np.float32)
        fused[tuple(index.T)] = np.where(count > 0, total / np.maximum(count, 1), -truncation)
        return np.maximum(fused, hull.values.clip(-truncation, truncation))
