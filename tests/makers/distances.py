"""Define simple shapes by signed distance functions (SDFs). Compute their depth maps and masks for cameras."""

import numpy as np

from refgs.camera import Camera


def sphere(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=-1) - 1


def box(p: np.ndarray) -> np.ndarray:
    q = np.abs(p) - np.array([0.8, 0.5, 0.6])
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def torus(p: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - 0.8, p[..., 2]) - 0.3


def gradient(sdf, p: np.ndarray) -> np.ndarray:
    """Compute outward unit normals at surface points `p`: central differences of the signed distance function."""
    step = 1e-4 * np.eye(3)
    g = np.stack([sdf(p + step[a]) - sdf(p - step[a]) for a in range(3)], axis=-1)
    return g / np.linalg.norm(g, axis=-1, keepdims=True)


def look_at(eye, size: int, name: str = "view") -> Camera:
    """Place a camera at `eye` that looks at the origin, with a field of view of 40 degrees."""
    eye = np.asarray(eye, float)
    forward = -eye / np.linalg.norm(eye)
    up = np.array([0, 0, 1.0]) if abs(forward[2]) < 0.99 else np.array([0, 1.0, 0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = [right, np.cross(forward, right), forward]
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    focal = 0.5 * size / np.tan(np.radians(20))
    return Camera(name, size, size, focal, focal, size / 2, size / 2, matrix)


def spread(count: int) -> np.ndarray:
    """Spread unit vectors (count, 3) evenly over the sphere, along a spiral."""
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - z * z)
    return np.stack([np.cos(phi) * ring, np.sin(phi) * ring, z], axis=1)


def around(count: int, size: int, distance: float = 4.5) -> list[Camera]:
    """Place cameras evenly on a whole sphere, all looking at the origin."""
    return [look_at(distance * ray, size, f"view{k}") for k, ray in enumerate(spread(count))]


def rays_of(camera: Camera) -> np.ndarray:
    """Return the rays (H, W, 3) through pixel centres, in the world's axes, one unit along the camera's axis."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    return rays @ camera.world_to_camera[:3, :3]


def depth(camera: Camera, sdf) -> tuple[np.ndarray, np.ndarray]:
    """Sphere-trace a signed distance function along the rays through pixel centres.

    Return depth along the camera's axis (0 where a ray misses) and coverage (1 where it hits, else 0), (H, W) float32 each.
    """
    rays = rays_of(camera)
    length = np.linalg.norm(rays, axis=-1)
    t, going = np.full(length.shape, 1.0), np.ones(length.shape, bool)
    for _ in range(80):
        step = sdf(camera.position + t[going][:, None] * rays[going]) / length[going]
        t[going] += step
        going[going] = (np.abs(step) > 1e-9) & (step < 100)  # the others have arrived, or fly away
    hit = np.abs(sdf(camera.position + t[..., None] * rays)) < 1e-3
    return np.where(hit, t, 0).astype(np.float32), hit.astype(np.float32)


def mask(camera: Camera, sdf) -> np.ndarray:
    """Compute the mask (H, W) of a shape. Its edges are antialiased with 2 × 2 samples a pixel."""
    fine = depth(camera.resized(2 * camera.width, 2 * camera.height), sdf)[1]
    return fine.reshape(camera.height, 2, camera.width, 2).mean((1, 3))
