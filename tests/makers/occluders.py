"""Make shapes that occlude themselves or each other, with a known visibility."""

import functools

import numpy as np
import pytest
import torch
import trimesh

from refgs.formats.mesh import Mesh
from refgs.geometry.visibility import Occluder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels, quaternions_towards
from refgs.render import relight


def plate(z: float, up: int) -> trimesh.Trimesh:
    """Make a square of side 2 at height `z`, in 2 × 20² triangles, that faces up (1) or down (-1)."""
    at = np.linspace(-1, 1, 21)
    x, y = np.meshgrid(at, at, indexing="ij")
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    quads = np.stack([corner, corner + 21, corner + 22, corner + 1], axis=1)[:, ::up]
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    return trimesh.Trimesh(np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3), faces, process=False)


def inside(height: float, level: int = 5) -> trimesh.Trimesh:
    """Make the part of the unit sphere below z = `height`. Its faces point to the centre.

    `level` is the icosphere's number of subdivisions.
    """
    ball = trimesh.creation.icosphere(level)
    return trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < height][:, ::-1], process=False)


def as_occluder(*shapes: trimesh.Trimesh, scale: float = 1.0, moved: float = 0.0) -> Occluder:
    """Make one occluder of all shapes. Coordinates are multiplied by `scale`; then `moved` is added to each."""
    whole = trimesh.util.concatenate(shapes)
    return Occluder(Mesh(whole.vertices * scale + moved, np.asarray(whole.faces)))


@functools.cache
def bowl() -> tuple[Occluder, np.ndarray, np.ndarray]:
    """Make a bowl: the inside of the lower half of the unit sphere. Return the occluder, points on it, and their inward normals."""
    occluder = as_occluder(inside(0.0))
    points = trimesh.creation.icosphere(3).vertices
    points = points[points[:, 2] < -0.1]
    return occluder, points * (1 + occluder.lift - 0.002), -points


def surfels(points: np.ndarray, normals: np.ndarray, albedo: float = 0.5, metallic: float = 0.0) -> Surfels:
    n = len(points)
    return Surfels(
        positions=torch.from_numpy(np.float32(points)),
        rotations=torch.from_numpy(quaternions_towards(normals)).float(),
        scales=torch.full((n, 2), 0.05),
        opacities=torch.ones(n),
        sh_dc=torch.zeros(n, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
        albedo=torch.full((n, 3), albedo),
        metallic=torch.full((n,), metallic),
        roughness=torch.full((n,), 0.5),
        received=torch.ones(n, 3),
        indirect_dc=torch.zeros(n, 1, 3),
        indirect_rest=torch.zeros(n, 0, 3),
    )


def even(radiance: float = 1.0) -> Environment:
    return Environment(torch.full((6 * 32**2, 3), radiance))


def mirrors(monkeypatch: pytest.MonkeyPatch, specular: float) -> None:
    """Replace the reflectance of all surfaces: they mirror the fraction `specular` of the light, at any angle.

    They reflect the rest diffusely, times their albedo.
    """

    def shares(albedo, metallic, roughness, cosine):
        return torch.full_like(albedo, specular), (1 - specular) * albedo

    monkeypatch.setattr(relight, "_split_sum", shares)
