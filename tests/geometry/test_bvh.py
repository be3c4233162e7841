"""Compare visibility that is ray-traced on a CUDA card with Embree's on the CPU, on meshes with back faces, holes or few triangles."""

import numpy as np
import pytest
import torch
import trimesh

from refgs.camera import Camera
from refgs.render import renderer
from tests.makers import scenes
from tests.makers.occluders import as_occluder, inside


def rings() -> trimesh.Trimesh:
    turned = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    one, other = trimesh.creation.torus(0.7, 0.2), trimesh.creation.torus(0.7, 0.2, transform=turned)
    other.apply_translation([0.7, 0, 0])
    return trimesh.util.concatenate(one, other)


SHAPES = {"rings": rings(), "half open": inside(0.3, 4), "five faces": trimesh.creation.cone(0.5, 1, sections=3)}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("scale", "moved"), [(1.0, 0.0), (1e3, 2e4)])
def test_as_embree(shape, scale, moved, card, monkeypatch):
    """Check visibility by the CUDA kernel against Embree's: fewer than 0.2 % of the pixels may differ.

    One ray is traced for each pixel: the camera's ray, mirrored at a random normal.

    Meshes of ordinary size at the origin are tested, and meshes 1000 times as large far from it.
    """
    occluder = as_occluder(SHAPES[shape], scale=scale, moved=moved)
    matrix = scenes.camera().world_to_camera.copy()
    matrix[:3, 3] = [0, 0, 3.0 * scale] - matrix[:3, :3] @ np.full(3, moved)
    camera = Camera("view", 60, 50, 60.0, 60.0, 30.0, 25.0, matrix)
    rng = np.random.default_rng(0)
    alpha = torch.from_numpy(rng.uniform(-0.5, 1, (50, 60)).clip(0)).float()
    # Points lie on the shape and around it. Rays start on the side of the surface that faces the camera.
    depth = alpha * torch.from_numpy(rng.uniform(2, 4, (50, 60)) * scale).float()
    rays = torch.nn.functional.normalize(scenes.camera_rays(camera), dim=-1)
    normals = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(50, 60, 3))).float(), dim=-1)
    mirrored = rays - 2 * (rays * normals).sum(dim=-1, keepdim=True) * normals
    mirrored[alpha <= renderer.COVERED] = 0
    got = occluder.tree(card).visible(mirrored.to(card), alpha.to(card), depth.to(card), camera).cpu()

    monkeypatch.setattr(renderer.load, "on_gpu", lambda tensor: False)
    monkeypatch.setattr(renderer, "mirror_directions", lambda *_: mirrored)
    expected = renderer._visibility(None, alpha, depth, camera, occluder)
    covered = alpha > renderer.COVERED
    assert 0.01 < float((expected[covered] == 0).float().mean()) < 0.95
    assert (got[~covered] == 1).all()
    assert float((got != expected).float().mean()) < 2e-3  # rays that pass within rounding of an edge may differ
