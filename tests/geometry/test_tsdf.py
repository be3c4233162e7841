from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from refgs.geometry.tsdf import fuse
from tests.makers.distances import around, box, depth, gradient, look_at, sphere, torus

VIEWS = around(24, 128)


def tensors(maps, device="cpu"):
    return [torch.tensor(map, device=device) for map in maps]


def fused(sdf, resolution, views=VIEWS, noise=0.0, radius=1.3, device="cpu"):
    depths, alphas = zip(*(depth(view, sdf) for view in views), strict=True)
    rng = np.random.default_rng(0)
    noisy = [d + noise * rng.normal(size=d.shape).astype(np.float32) for d in depths]
    mesh = fuse(tensors(noisy, device), tensors(alphas, device), views, (0.05, 0, 0), radius, resolution)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def outward(mesh, sdf):
    return (mesh.face_normals * gradient(sdf, mesh.triangles_center)).sum(1) > 0


@pytest.mark.parametrize("shape", [sphere, box, torus])
def test_error_falls_with_the_voxel(shape):
    errors = []
    for resolution in (32, 64):
        mesh = fused(shape, resolution)
        error = np.abs(shape(mesh.vertices))
        assert error.max() < 2.6 / resolution
        assert outward(mesh, shape).mean() > 0.999 and mesh.is_watertight
        errors.append(np.sqrt((error**2).mean()))
    assert errors[1] < 0.55 * errors[0] and errors[1] < 0.2 * 2.6 / 64
    assert mesh.euler_number == (0 if shape is torus else 2)


def test_noise_averages_out():
    assert np.abs(sphere(fused(sphere, 64, noise=0.04).vertices)).mean() < 0.01


def test_what_no_view_saw_has_no_surface():
    mesh = fused(sphere, 64, views=[view for view in VIEWS if view.position[2] > 2.5])
    assert not mesh.is_watertight
    assert np.abs(sphere(mesh.vertices)).max() < 2 * 2.6 / 64
    assert mesh.vertices[:, 2].min() > -0.76 and mesh.vertices[:, 2].max() > 0.97


def test_a_room_seen_from_inside_faces_the_cameras():
    def room(p):
        return -sphere(p)

    inner = [replace(look_at(-0.1 * view.position, 128), fx=60.0, fy=60.0) for view in VIEWS]
    mesh = fused(room, 50, views=inner, radius=1.2)
    assert np.abs(room(mesh.vertices)).max() < 0.01
    assert outward(mesh, room).all()


def test_one_wrong_depth_map_is_outvoted():
    depths, alphas = zip(*(depth(view, sphere) for view in VIEWS), strict=True)
    depths[5][depths[5] > 0] -= 0.3
    mesh = fuse(tensors(depths), tensors(alphas), VIEWS, (0, 0, 0), 1.4, 64)
    parts = trimesh.Trimesh(mesh.vertices, mesh.faces).split(only_watertight=False)
    assert np.abs(sphere(max(parts, key=lambda part: part.area).vertices)).max() < 0.05


def test_nothing_to_see():
    blank = [torch.zeros(128, 128)] * len(VIEWS)
    assert len(fuse(blank, blank, VIEWS, (0, 0, 0), 1.0, 32).faces) == 0
    behind, opaque = [torch.full((128, 128), torch.nan)] * len(VIEWS), [torch.ones(128, 128)] * len(VIEWS)
    assert len(fuse(behind, opaque, VIEWS, (0, 0, 0), 1.0, 32).faces) == 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA card here")
def test_a_card_makes_the_same_mesh():
    there, here = fused(box, 50, device="cuda"), fused(box, 50)
    assert np.abs(box(there.vertices)).mean() == pytest.approx(np.abs(box(here.vertices)).mean(), rel=0.01)
    assert len(there.vertices) == pytest.approx(len(here.vertices), rel=0.01)
