"""Find where masks show an object's surface.

A ray through a mask's outline touches the object somewhere. If the ray meets the visual hull only near one point, the surface is there. If
the ray runs along the hull, the surface may be anywhere below the hull. Rays run along the hull at flat faces. They also do so at the
opening of a bowl, because the hull closes the opening.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from skimage.measure import find_contours

from refgs.camera import Camera
from refgs.geometry.project import pixel_rays
from refgs.geometry.shape import Shape

STEP = 0.5  # voxels, along a ray
ACROSS = 200  # pixels across the object, in the reduced masks


def contact(shape: Shape, alphas: Sequence[np.ndarray], cameras: Sequence[Camera]) -> np.ndarray:
    """Measure how well outlines show the surface at each voxel. Returns lengths (X, Y, Z) in world units: the shorter, the better.

    `shape` is the visual hull, and `alphas` are the masks (H, W), uint8. Rays are traced from the cameras through the outlines of the
    masks. The value of a ray is half the length of its part inside the hull. The value of a voxel is the smallest value of the rays through
    it. It is infinite if there is no ray through the voxel.
    """
    centre, radius = shape.ball
    step = STEP * float(shape.voxel.min())
    along = np.arange(-radius, radius, step)
    least = np.full(shape.solid.shape, np.inf, np.float32)
    for alpha, full in zip(alphas, cameras, strict=True):
        camera = shape.fit(full, ACROSS)
        small = cv2.resize(alpha, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        outlines = find_contours(small, 0.5)  # open where the picture's border cuts a mask
        if not outlines:
            continue
        rays = pixel_rays(camera, *np.concatenate(outlines).T)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        middle = (centre - camera.position) @ rays.T
        points = camera.position + rays[:, None] * (middle[:, None] + along)[..., None]
        at = np.floor((points - shape.low) / shape.voxel).astype(np.int32)
        touched = ((at >= 0) & (at < shape.solid.shape)).all(axis=-1)
        at = at[touched]
        ray = np.broadcast_to(np.arange(len(rays))[:, None], touched.shape)[touched]
        in_shape = shape.solid[tuple(at.T)]
        at, ray = at[in_shape], ray[in_shape]
        length = step / 2 * np.bincount(ray, minlength=len(rays))
        np.minimum.at(least, tuple(at.T), length[ray].astype(np.float32))
    return least
