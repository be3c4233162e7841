"""Compute photos of balls under a smooth sky by formula: captures with known ground truth, made without Blender."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from refgs.color import srgb_encode
from refgs.render.brdf import bounces, fresnel, one_bounce
from scripts.demo.shapes import Material

VIEWS, DISTANCE, ANGLE = 24, 4.0, 0.7  # training views, radii, radians
F0 = np.array([0.9, 0.6, 0.3])
BOUNCES = 4
ONE = np.array([[0.0, 0.0, 0.0, 1.0]])
TWO = np.array([[-0.6, 0.0, 0.0, 0.5], [0.6, 0.0, 0.0, 0.5]])


def sky(direction: np.ndarray) -> np.ndarray:
    """Compute the sky's linear radiance (…, 3): bright above, dark below, warmer towards +x.

    It is so smooth that a mirror and a slightly rough surface show almost the same reflection of it.
    """
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack([0.5 + 0.3 * z + 0.2 * x, 0.5 + 0.35 * z + 0.1 * y, 0.5 + 0.4 * z - 0.2 * x], axis=-1)


def meet(origin: np.ndarray, ray: np.ndarray, balls: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find where unit rays (P, 3) first hit balls (B, 4), given by centre and radius.

    Return whether each ray hits a ball (P,), the points (P, 3) and the normals there (P, 3).
    """
    apart = origin[:, None] - balls[:, :3]
    b = (apart * ray[:, None]).sum(-1)
    inside = b * b - ((apart**2).sum(-1) - balls[:, 3] ** 2)
    way = -b - np.sqrt(np.maximum(inside, 0))
    way[(inside <= 0) | (way < 1e-9)] = np.inf
    first = way.argmin(axis=1)
    hit = np.isfinite(way.min(axis=1))
    point = origin + np.where(hit, way.min(axis=1), 0)[:, None] * ray
    return hit, point, (point - balls[first, :3]) / balls[first, 3:]


# Bands from the top down: the lowest z of the normal, and the material. The first is nearly a mirror, which shows the light.
BANDS = (
    (0.25, Material((0.9, 0.6, 0.3), 1.0, 0.1)),
    (-0.3, Material((0.7, 0.7, 0.8), 1.0, 0.5)),
    (-1.0, Material((0.2, 0.4, 0.5), 0.0, 0.6)),
)
SUNS = np.array([[0.6, 0.0, 0.8], [-0.64, 0.6, 0.48], [0.0, -0.96, 0.28]])
STEPS = 14  # nodes of the lobe's quadrature along each axis


def sunny(direction: np.ndarray) -> np.ndarray:
    """Compute the radiance of the sky with soft suns, 10 degrees wide. Their reflections show how rough a surface is."""
    return 0.4 * sky(direction) + 0.55 * np.exp(30 * (direction @ SUNS.T - 1)).sum(axis=-1, keepdims=True)


def reflect(material: Material, ray: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Compute the radiance (P, 3) that P surface points of a convex object reflect to a camera. The light is `sunny`.

    `ray` (P, 3) are unit vectors from the camera to the points, and `normal` (P, 3) the points' normals. The specular part is integrated
    over the microfacet normals that the camera sees (Heitz 2018), the diffuse part over the hemisphere.
    """
    view, alpha = -ray, material.roughness**2
    n_v = (view * normal).sum(-1).clip(1e-3, 1 - 1e-9)
    side = view - (view * normal).sum(-1, keepdims=True) * normal
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-12)
    frame = np.stack([side, np.cross(normal, side), normal], axis=1)
    mid = (np.arange(STEPS) + 0.5) / STEPS
    radius, azimuth = (v.ravel() for v in np.meshgrid(np.sqrt(mid), 2 * np.pi * mid))
    disc_x, disc_y = radius * np.cos(azimuth), radius * np.sin(azimuth)

    s_v = np.sqrt(1 - n_v**2)[:, None]
    c_v = n_v[:, None]
    stretch = np.hypot(alpha * s_v, c_v)
    v_x, v_z = alpha * s_v / stretch, c_v / stretch
    share = (1 + v_z) / 2
    across = (1 - share) * np.sqrt(1 - disc_x**2) + share * disc_y
    up = np.sqrt(np.maximum(1 - disc_x**2 - across**2, 0))
    half = np.stack([alpha * (v_x * up - v_z * across), alpha * disc_x + 0 * up, v_x * across + v_z * up], axis=-1)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    v_h = (s_v * half[..., 0] + c_v * half[..., 2]).clip(0, 1)
    n_l = 2 * v_h * half[..., 2] - c_v
    view_local = np.concatenate([s_v, 0 * s_v, c_v], axis=-1)[:, None]
    light = sunny(np.einsum("psa,pab->psb", 2 * v_h[..., None] * half - view_local, frame))
    shadow_v, shadow_l = (np.sqrt(1 + alpha**2 * (1 / np.maximum(c, 1e-9) ** 2 - 1)) for c in (c_v, n_l))
    weight = np.where(n_l > 0, (1 + shadow_v) / (shadow_v + shadow_l), 0)[..., None] / len(disc_x)

    x, w = np.polynomial.legendre.leggauss(32)
    cosine = (x + 1) / 2
    average_energy = one_bounce(cosine, material.roughness, 32)[:2].sum(axis=0) @ (cosine * w)
    energy = weight.sum(axis=(1, 2))[:, None]
    base = np.array(material.base_color)
    if material.metallic:
        lobe = base + (1 - base) * (1 - v_h[..., None]) ** 5
        return (light * lobe * weight).sum(axis=1) * bounces((20 * base + 1) / 21, energy, average_energy)
    lobe = fresnel(v_h)[..., None] * weight
    scale = bounces((fresnel(cosine) * cosine) @ w, energy, average_energy)
    matte = np.stack([disc_x, disc_y, np.sqrt(1 - radius**2)], axis=-1)
    received = sunny(np.einsum("sa,pab->psb", matte, frame)).mean(axis=1)
    return (light * lobe).sum(axis=1) * scale + (1 - lobe.sum(axis=1) * scale) * base * received


def banded(ray: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Compute the radiance (P, 3) of points of a ball whose material changes with height, in three bands (BANDS)."""
    color, left = np.zeros_like(ray), np.ones(len(ray), bool)
    for lowest, material in BANDS:
        here = left & (normal[:, 2] >= lowest)
        left &= ~here
        for some in np.array_split(np.flatnonzero(here), 1 + here.sum() // 256):  # chunks that fit into the caches
            color[some] = reflect(material, ray[some], normal[some])
    return color


def photo(
    matrix: np.ndarray,
    size: int,
    balls: np.ndarray = ONE,
    samples: int = 4,
    turning: bool = False,
    stops: float | tuple[float, float, float] = 0.0,
    bands: bool = False,
    angle: float = ANGLE,
    matte: bool = False,
) -> np.ndarray:
    """Compute a photo of balls, RGBA in 0..1. `balls` (B, 4) has each ball's centre and radius.

    By default, balls are mirrors with Schlick's Fresnel. If `bands` is set, they have three horizontal bands of materials (BANDS). If
    `matte` is set, they are matte with a pattern.

    `matrix` is the camera-to-world matrix, `angle` the field of view in radians, and `stops` the exposure in powers of two, which may
    differ between channels. Each pixel is the mean of `samples`² rays. If `turning` is set, the sky turns about z together with the camera.
    """
    focal = 0.5 * size / np.tan(angle / 2)
    grid = (np.arange(size * samples) + 0.5) / samples
    x, y = np.meshgrid(grid - size / 2, grid - size / 2)
    ray = np.stack([x / focal, -y / focal, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ matrix[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    origin, share = np.broadcast_to(matrix[:3, 3], ray.shape), np.ones_like(ray)
    for bounce in range(BOUNCES):
        hit, point, normal = meet(origin, ray, balls)
        if bounce == 0:
            seen, first_ray, first_normal = hit, ray, normal
        cosine = -(normal * ray).sum(-1, keepdims=True).clip(-1, 0)
        share = np.where(hit[:, None], share * (F0 + (1 - F0) * (1 - cosine) ** 5), share)
        origin, ray = point, np.where(hit[:, None], ray + 2 * cosine * normal, ray)
    azimuth = np.arctan2(matrix[1, 0], matrix[0, 0]) if turning else 0.0
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    ray = ray @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    color = np.where(seen[:, None], 2.0 ** np.asarray(stops) * share * sky(ray), 0)
    if matte:  # a sky linear in the direction, a + b·d, has irradiance / π = a + 2/3 b·n
        color = np.where(seen[:, None], (0.5 + 0.3 * np.sin(6 * first_normal)) * sky(2 / 3 * first_normal), 0)
    blocks = (size, samples, size, samples)
    alpha = seen.reshape(blocks).mean(axis=(1, 3))

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.where(seen[:, None], values, 0).reshape(*blocks, 3).sum(axis=(1, 3))
        return total / np.maximum(seen.reshape(blocks).sum(axis=(1, 3)), 1)[..., None]

    color = mean(color)
    if bands:  # the radiance is smooth: one ray a pixel is enough
        there = alpha > 0
        ray, normal = (mean(v)[there] for v in (first_ray, first_normal))
        color[there] = banded(*(v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (ray, normal)))
    return np.dstack([srgb_encode(color).clip(0, 1), alpha])


def camera_matrix(direction: np.ndarray, distance: float = DISTANCE) -> np.ndarray:
    """Return the camera-to-world matrix, with OpenGL's axes, of a camera that looks at the origin; +z is up.

    `direction` points from the origin to the camera.
    """
    back = direction / np.linalg.norm(direction)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, distance * back], axis=1)
    return matrix


def write_ball_capture(
    folder: Path,
    size: int,
    balls: np.ndarray = ONE,
    samples: int = 4,
    turning: bool = False,
    stops: tuple[float | tuple[float, float, float], ...] = (0.0,),
    bands: bool = False,
    distance: float = DISTANCE,
    matte: bool = False,
) -> None:
    """Write photos of balls as a NeRF-Blender capture with 24 training and 4 test views.

    `stops` is a list of exposures in powers of two; the training views use them in turn. See `photo` for the other arguments.
    """
    angle = ANGLE if distance == DISTANCE else 2 * np.arctan(np.tan(ANGLE / 2) * DISTANCE / distance)
    steps = np.arange(VIEWS + 4) + 0.5
    z = 0.9 - 1.5 * steps / len(steps)
    azimuth = steps * np.pi * (3 - np.sqrt(5))
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1)
    frames = {"train": [], "test": []}
    for i, direction in enumerate(directions):
        split = "test" if i % 7 == 3 else "train"
        matrix = camera_matrix(direction, distance)
        (folder / split).mkdir(exist_ok=True, parents=True)
        more = stops[i % len(stops)] if split == "train" else 0.0
        pixels = np.rint(photo(matrix, size, balls, samples, turning, more, bands, angle, matte) * 255).astype(np.uint8)
        Image.fromarray(pixels).save(folder / split / f"r_{i}.png")
        frames[split].append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix.tolist()})
    for split, entries in frames.items():
        text = json.dumps({"camera_angle_x": angle, "frames": entries})
        (folder / f"transforms_{split}.json").write_text(text)
