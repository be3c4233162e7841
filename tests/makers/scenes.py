"""Make random surfels of several kinds that are hard to rasterise, such as huge, edge-on, or smaller than a pixel."""

from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.scenes.analytic import meet
from refgs.camera import Camera

NEAR = 0.1
KINDS = ("plain", "edge_on", "across_near", "huge", "sub_pixel", "layers", "mixed")
CHANNELS = {"plain": 3, "edge_on": 1, "across_near": 16, "huge": 5, "sub_pixel": 4, "layers": 33, "mixed": 16}


def camera(width: int = 45, height: int = 30, centre: tuple[float, float] | None = None) -> Camera:
    """Place a camera at (0.3, −0.2, −0.4) that looks roughly along +z and is rolled.

    By default its image is neither square nor a multiple of the tile size. `centre` is the principal point.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [4, -6, 25], degrees=True).as_matrix()
    matrix[:3, 3] = -matrix[:3, :3] @ [0.3, -0.2, -0.4]
    cx, cy = centre or (0.47 * width, 0.55 * height)
    return Camera("test", width, height, 1.1 * width, 1.0 * width, cx, cy, matrix)


def camera_rays(camera: Camera) -> Tensor:
    """Compute world-space rays (H, W, 3), float32, through pixel centres. They are not unit vectors: each ends at depth 1."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    rotation = torch.from_numpy(camera.world_to_camera[:3, :3].copy())
    rays = rotation[2] + x[None, :, None] * rotation[0] + y[:, None, None] * rotation[1]
    return rays.float()


def meetings(camera: Camera, balls: np.ndarray) -> tuple[np.ndarray, ...]:
    """Intersect the rays through all P pixel centres with balls (B, 4), given by centre and radius.

    Return unit rays (P, 3), whether each hits a ball (P,), its first hit point (P, 3) and the normal there (P, 3). Pixels are in row order.
    """
    rays = camera_rays(camera).double().numpy().reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays, *meet(np.broadcast_to(camera.position, rays.shape), rays, balls)


def surfels(kind: str, channels: int, seed: int = 0) -> tuple[Tensor, ...]:
    """Make random surfels of a kind in KINDS. Return float32 positions, rotations, scales, opacities and features (N, channels).

    Their depths differ by more than rounding errors, so the order in which they are drawn is certain.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if kind == "mixed":
        parts = [surfels(k, channels, seed) for k in KINDS if k not in ("mixed", "layers")]
        return tuple(torch.cat(tensors) for tensors in zip(*parts, strict=True))
    n = 400 if kind == "layers" else 77
    position = rng.normal(size=(n, 3)) * [0.9, 0.6, 0.6] + [0.3, -0.2, 1.6]
    rotation = rng.normal(size=(n, 4)) * rng.uniform(0.1, 5, (n, 1))
    scale = np.exp(rng.uniform(np.log(0.02), np.log(0.4), (n, 2)))
    opacity = rng.uniform(0.01, 1, n)
    if kind == "edge_on":  # normals are perpendicular, or nearly so, to the ray through the centre
        sight = position - camera().position
        normal = np.cross(sight, rng.normal(size=(n, 3)))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal += 10.0 ** rng.uniform(-9, -1, (n, 1)) * sight
        rotation = np.stack([Rotation.align_vectors([v], [[0, 0, 1]])[0].as_quat(scalar_first=True) for v in normal])
        scale *= 2
    if kind == "across_near":
        position[:, 2] = rng.uniform(-0.25, 0.6, n)
        position[:, :2] = rng.normal(size=(n, 2)) * 0.2 + [0.3, -0.2]
        scale *= 1.5
    if kind == "huge":
        scale *= 200
        opacity *= 0.2
    if kind == "sub_pixel":
        scale *= 0.1
        scale[::4] = 0
    if kind == "layers":
        scale = rng.uniform(1, 3, (n, 2))
        opacity = rng.uniform(0.004, 0.03, n)
    feature = rng.normal(size=(n, channels))
    return tuple(torch.tensor(v, dtype=torch.float32) for v in (position, rotation, scale, opacity, feature))


def check_same_bits_for_any_number_of_threads(run: Callable[[], list[Tensor]]) -> None:
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(run())
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
