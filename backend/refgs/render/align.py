"""Find the pose of a camera that makes a rendering fit its photo, by Gauss-Newton steps on the pixels' colours.

A pose is six numbers (6,): a rotation vector around the scene's centre, in radians, and a translation in scene radii. It moves the scene,
not the camera. The pose zero is the identity. If the scene moves a little, each pixel moves with the surface that it shows, by an amount
that follows from its depth (Baker and Matthews 2004, Engel et al. 2018). Colours are assumed to move with the surface. Mirror images move
differently, but only a little on a curved surface.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from refgs.camera import Camera
from refgs.render.rendering import COVERED, SOLID, Rendering

REDUCTIONS = 4, 2, 1  # of pictures, from the first steps to the last
STEPS = 5  # of fitting a pose, for each of these
ODD = 0.1  # of 1: a difference of colours from which a pixel counts less; it has another cause than the pose
CHUNK = 1 << 16  # pixels whose equations are held at a time; one takes 700 bytes
DAMPING = 1e-3  # of the mean diagonal


def posed(camera: Camera, pose: Tensor, centre: np.ndarray, radius: float) -> Camera:
    """Return the camera that sees the unmoved scene as `camera` sees the scene moved by `pose` (6,).

    `pose` is a rotation vector around `centre`, in radians, then a translation in units of `radius`.
    """
    turn, shift = pose.double().numpy(force=True).reshape(2, 3)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    motion[:3, 3] = centre - motion[:3, :3] @ centre + radius * shift
    return replace(camera, world_to_camera=camera.world_to_camera @ motion)


@torch.no_grad()
def pose_step(
    rendering: Rendering, photo: Tensor, camera: Camera, centre: np.ndarray, radius: float, reduction: int = 1
) -> Tensor:
    """Compute the pose (6,), as in `posed`, that moves the rendering of `camera` towards the photo (H, W, 3): one Gauss-Newton step.

    The pose is zero if the rendering is empty. The photo and the rendering's picture are sRGB-encoded. Both are first averaged over squares
    of `reduction` pixels. The pose minimises Σ w |photo − picture + ∇ · motion(pose)|² over the pixels and channels. motion(pose) is how
    far the pose moves a pixel. ∇ is the mean of the gradients of picture and photo, by central differences. Steps with this mean converge
    faster than steps with the gradient of only the picture or the photo (Benhimane and Malis 2004). The weight w is small where picture and
    photo differ much.
    """
    maps = [rendering.color.clamp(0, 1), photo, rendering.blended_depth[..., None], rendering.alpha[..., None]]
    color, photo, depths, alpha = (_reduced(value, reduction) for value in maps)
    height, width = alpha.shape[:2]
    camera = camera.cropped(0, 0, reduction * width, reduction * height).resized(width, height)
    apart = photo - color
    mean = (color + photo) / 2
    across, down = torch.zeros_like(mean), torch.zeros_like(mean)
    across[:, 1:-1] = (mean[:, 2:] - mean[:, :-2]) / 2
    down[1:-1] = (mean[2:] - mean[:-2]) / 2

    rows, columns = torch.nonzero(alpha[..., 0] > SOLID, as_tuple=True)
    if len(rows) == 0:
        return torch.zeros(6)
    depths = (depths / alpha.clamp_min(COVERED))[..., 0]
    square, towards = torch.zeros(6, 6).to(rows.device, torch.double), torch.zeros(6).to(rows.device, torch.double)
    for pixels in zip(rows.split(CHUNK), columns.split(CHUNK), strict=True):
        part = _normal_equations(*pixels, (across, down, apart, depths), camera, centre, radius)
        square, towards = square + part[0], towards + part[1]
    square += (DAMPING * square.diagonal().mean() + 1e-12) * torch.eye(6).to(square)
    return torch.linalg.solve(square, towards).float().cpu()


def _normal_equations(
    rows: Tensor, columns: Tensor, maps: tuple[Tensor, ...], camera: Camera, centre: np.ndarray, radius: float
) -> tuple[Tensor, Tensor]:
    """Return the matrix (6, 6) and the right side (6,) of a pose's normal equations, in float64.

    Both are sums over the pixels at `rows` and `columns`. `maps` holds four maps: the picture's horizontal gradient (H, W, 3), its vertical
    gradient (H, W, 3), the difference photo − picture (H, W, 3), and the depth (H, W).
    """
    across, down, apart, depth = (value[rows, columns].double() for value in maps)
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    to_camera = torch.from_numpy(camera.world_to_camera).to(depth)
    turn = to_camera[:3, :3]
    from_centre = torch.stack([x * depth, y * depth, depth], dim=1) - (
        turn @ torch.from_numpy(centre).to(depth) + to_camera[:3, 3]
    )
    # How a pixel moves with its point: fx (dX − x dZ) / Z to the right, fy (dY − y dZ) / Z down.
    slope = torch.stack(
        [camera.fx * across, camera.fy * down, -(camera.fx * x[:, None] * across + camera.fy * y[:, None] * down)],
        dim=2,
    )
    slope = slope / depth[:, None, None]
    # The point moves by ω × p + radius · t, in the camera's axes.
    by_turn = torch.linalg.cross(from_centre[:, None].expand_as(slope), slope)
    jacobian = -torch.cat([by_turn @ turn, radius * slope @ turn], dim=2)
    weight = 1 / (1 + (apart / ODD).square())
    return torch.einsum("pci,pc,pcj->ij", jacobian, weight, jacobian), torch.einsum(
        "pci,pc,pc->i", jacobian, weight, apart
    )


def fitted(
    picture: Callable[[Camera], Rendering], camera: Camera, photo: Tensor, centre: np.ndarray, radius: float
) -> Camera:
    """Move a camera in steps so that its rendering, `picture(camera)`, fits the photo better. Change only the camera's pose.

    Returns the camera of the step with the smallest squared error, which may be `camera` itself.
    """
    best, least, now = camera, np.inf, camera
    for reduction in [*np.repeat(REDUCTIONS, STEPS).tolist(), 1]:
        rendering = picture(now)
        error = float((rendering.color.clamp(0, 1) - photo).square().mean())
        if error < least:
            best, least = now, error
        now = posed(now, pose_step(rendering, photo, now, centre, radius, reduction), centre, radius)
    return best


def _reduced(value: Tensor, factor: int) -> Tensor:
    """Average a picture (H, W, C) over whole squares of `factor` pixels."""
    return torch.nn.functional.avg_pool2d(value.permute(2, 0, 1), factor).permute(1, 2, 0)
