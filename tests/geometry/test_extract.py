import refgs  # noqa: F401, I001  before torch
import numpy as np
import torch
from analytic import around

from refgs.geometry import extract as module
from refgs.geometry.extract import extract
from refgs.model.surfels import Surfels

VIEWS = around(24, 96)
NEAR = 0.01


def ball(opacity, thickness, count=12000):
    """Surfels of a ball of radius 1 that lie up to so deep below its surface."""
    rng = np.random.default_rng(0)
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - z * z)
    normals = np.stack([np.cos(phi) * ring, np.sin(phi) * ring, z], axis=1)
    depth = thickness * rng.uniform(size=(count, 1))
    turn = np.stack([1 + z, -normals[:, 1], normals[:, 0], np.zeros(count)], axis=1)  # from +Z to the normal
    rows = [(1 - depth) * normals, turn, np.full((count, 2), 0.03), np.full(count, opacity)]
    tensors = [torch.tensor(row, dtype=torch.float32) for row in rows]
    nothing = torch.zeros(count, 0, 3)
    return Surfels(
        *tensors, *[nothing] * 2, torch.ones(count, 3), *[torch.ones(count)] * 2, torch.ones(count, 3), nothing, nothing
    )


def radii(surfels, resolution=64):
    mesh, _ = extract(surfels, VIEWS, NEAR, np.zeros(3), 1.3, resolution)
    return np.linalg.norm(mesh.vertices, axis=1)


def test_a_ball_of_one_layer():
    surfels = ball(0.95, 0.0)
    coarse, fine = (radii(surfels, resolution) - 1 for resolution in (32, 64))
    assert np.abs(fine).max() < 0.015 and abs(fine.mean()) < 0.7 * abs(coarse.mean())


def test_the_surface_lies_where_rays_come_in(monkeypatch):
    """Faint layers, a tenth of the radius deep: their mean lies too deep, and that of denser ones where they begin."""
    layers = ball(0.2, 0.1)
    denser = 1 - radii(layers).mean()
    monkeypatch.setattr(module, "DENSER", 1)
    mean = 1 - radii(layers).mean()
    assert 0 < denser < 0.6 * mean


def test_what_is_hardly_there_has_no_surface():
    """What covers is as dense as it is, not as the surfels that tell the depth."""
    assert len(radii(ball(0.004, 0.1))) == 0


def test_voxels_are_no_finer_than_pixels():
    """96 of them show 3.3 units at the middle of the ball, 2.5 where it is nearest: 2.6 units have 78 to 104 of them across."""
    layer = ball(0.95, 0.0)
    fine, finer, coarse = (len(radii(layer, resolution)) for resolution in (120, 240, 75))
    assert coarse < fine == finer == len(radii(layer, 104))
