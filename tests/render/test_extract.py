import numpy as np
import torch
import trimesh

from refgs.geometry.mesh import clean
from refgs.model.surfels import Surfels
from refgs.render import extract as module
from refgs.render.extract import extract
from tests.makers.distances import around, look_at, spread
from tests.makers.occluders import surfels

VIEWS = around(24, 96)
NEAR = 0.01


def sheet(positions, normals, size, opacity):
    """Make round surfels of one size at positions (N, 3), with normals (N, 3)."""
    opacities = torch.tensor(np.broadcast_to(opacity, len(positions)), dtype=torch.float32)
    return surfels(positions, normals)._replace(scales=torch.full((len(positions), 2), size), opacities=opacities)


def ball(opacity, thickness, count=12000):
    """Make surfels that form a ball of radius 1. Each lies at a random depth below the ball's surface, up to `thickness`."""
    normals = spread(count)
    depth = thickness * np.random.default_rng(0).uniform(size=(count, 1))
    return sheet((1 - depth) * normals, normals, 0.03, opacity)


def radii(shape, resolution=64):
    mesh, _ = extract(shape, VIEWS, NEAR, np.zeros(3), 1.3, resolution)
    return np.linalg.norm(mesh.vertices, axis=1)


def test_a_ball_of_one_layer():
    layer = ball(0.95, 0.0)
    coarse, fine = (radii(layer, resolution) - 1 for resolution in (32, 64))
    assert np.abs(fine).max() < 0.015 and abs(fine.mean()) < 0.7 * abs(coarse.mean())


def test_what_is_hardly_there_has_no_surface():
    """Check that nearly transparent surfels give no mesh, because they render with a too low alpha."""
    assert len(radii(ball(0.004, 0.1))) == 0


def test_voxels_are_no_finer_than_pixels():
    """Check that a mesh is extracted with voxels no smaller than a typical pixel at the surface.

    For the views of this test, the finest grid has 104 voxels a side. With a resolution of 120 or 240, the mesh has as many
    vertices as with 104.
    """
    layer = ball(0.95, 0.0)
    fine, finer, coarse = (len(radii(layer, resolution)) for resolution in (120, 240, 75))
    assert coarse < fine == finer == len(radii(layer, 104))


HIGH, FLAT = 4.5 * np.sin(0.4), 4.5 * np.cos(0.4)
ARC = [look_at([FLAT * np.cos(turn), FLAT * np.sin(turn), HIGH], 96) for turn in np.linspace(-1.2, 1.2, 16)]


def place():
    """Make surfels of a ball on the ground, with far walls and some fog. The cameras in ARC see it from one side."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(*[np.linspace(-5, 5, 100)] * 2, [-1.0]), axis=-1).reshape(-1, 3)
    ground = sheet(grid, np.tile([0.0, 0, 1], (len(grid), 1)), 0.08, 0.95)
    walls = spread(1500)
    eyes = np.stack([camera.position for camera in ARC])
    fog = eyes[rng.integers(len(eyes), size=400)] * rng.uniform(0.35, 0.9, (400, 1)) + 0.3 * rng.normal(size=(400, 3))
    fog = sheet(fog, spread(400), 0.1, rng.uniform(0.03, 0.15, 400))
    parts = ball(0.8, 0.02), ground, sheet(60 * walls, walls, 3.0, 0.95), fog
    return Surfels(*(torch.cat(values) for values in zip(*parts, strict=True)))


def test_a_foreground_without_masks(monkeypatch):
    def found():
        mesh, voxel = extract(place(), ARC, NEAR, np.zeros(3), 1.1, 64)
        distance, height = np.linalg.norm(mesh.vertices, axis=1), mesh.vertices[:, 2]
        high = height > -0.7
        around = np.abs(height[~high & (distance > 1.3)] + 1)
        return clean(mesh, 10**6), voxel, distance.max(), np.abs(distance[high] - 1), around

    mesh, voxel, farthest, ball, ground = found()
    # The grid is enlarged for the ground that most cameras see, but not for the walls.
    assert 1.2 * 2.2 / 64 < voxel < 2 * 2.2 / 64
    assert 1.5 < farthest < module.REACH * 1.1 + voxel
    assert np.quantile(ball, 0.9) < voxel and np.quantile(ground, 0.9) < 0.1 * voxel
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).body_count == 1  # the fog gives no surface
    # Without trimming, depth is the mean, which fog in front and walls behind displace: the surface is worse.
    monkeypatch.setattr(module, "UPPER", 1.0)
    monkeypatch.setattr(module, "LOWER", 0.0)
    *_, mean, _ = found()
    assert np.median(ball) < 0.15 * voxel and np.quantile(ball, 0.9) < 0.65 * np.quantile(mean, 0.9)
