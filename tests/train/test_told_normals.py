"""Test that a training draws normals of metals to what outlines tell, and those of rough paint to its mesh."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import cosine_similarity

from refgs.capture import read_capture
from refgs.effective import Effective
from refgs.formats.mesh import Mesh
from refgs.geometry.visibility import Occluder
from refgs.render.rendering import Rendering
from refgs.settings import load_settings
from refgs.train.learn import mesh_normals, outlines
from refgs.train.learn.mesh_normals import MeshNormals
from refgs.train.learn.outlines import Outlines
from refgs.train.learn.told_normals import ToldNormals
from refgs.train.plan import Plan
from refgs.train.setup import set_up
from refgs.train.timeline import Step
from tests.makers.distances import around
from tests.makers.textured import on_a_disc, photograph, write_capture


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    photos = [photograph(camera, on_a_disc, mirror=True) for camera in around(80, 128) if camera.position[2] > 0.5]
    return write_capture(tmp_path_factory.mktemp("mirrors") / "ball", photos)


def state_of(folder, run, *changes: str):
    settings = Effective.of(load_settings("quick", ["surfels.start=2000", "light.frame=camera", *changes]))
    return set_up(read_capture(folder), settings, run, lambda *_: None, Plan(None), "cpu")


@pytest.fixture(scope="module")
def start(folder, tmp_path_factory):
    return state_of(folder, tmp_path_factory.mktemp("run"))


@pytest.fixture
def state(start):
    """Copy a training that has not begun: to set one up takes seconds."""
    return copy.deepcopy(start)


def rendered(state, metallic: float, roughness: float = 0.5) -> Step:
    """Render the first view with normals turned by 10°, and one material everywhere."""
    step = Step(state, 0)
    step.photo = state.photos[0]
    picture = state.picture(state.inputs(), step.photo.camera)
    turn = torch.tensor([[0.9848, 0.1736, 0.0], [-0.1736, 0.9848, 0.0], [0.0, 0.0, 1.0]])
    material = picture.material.detach().clone()
    material[..., 3], material[..., 4] = metallic, roughness
    step.rendering = replace(picture, normal=(picture.normal.detach() @ turn).requires_grad_(), material=material)
    return step


def apart(told: ToldNormals, step: Step) -> float:
    """Return the mean of 1 − the cosine between rendered normals and those told."""
    camera = step.photo.camera
    column, row = (told.plane * torch.tensor([camera.fx, camera.fy]) + torch.tensor([camera.cx, camera.cy])).long().T
    return (1 - cosine_similarity(step.rendering.normal.detach()[row, column], told.normals)).mean().item()


def check_drawn(state, step: Step, told: ToldNormals, loss) -> None:
    """Check that 30 steps down the gradient of a loss bring the rendered normals to those told."""
    assert len(told.plane) > 200
    before = apart(told, step)
    for _ in range(30):
        normal = step.rendering.normal
        (gradient,) = torch.autograd.grad(loss(state, step), normal)
        moved = normal.detach() - 0.02 * torch.nn.functional.normalize(gradient, dim=-1)
        step.rendering = replace(step.rendering, normal=moved.requires_grad_())
    assert apart(told, step) < 0.3 * before


def ball(radius: float) -> Occluder:
    """Return a mesh of a ball about the origin."""
    mesh = trimesh.creation.icosphere(4, radius)
    return Occluder(Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)))


def test_metal_is_drawn_to_the_normals_that_outlines_tell(state):
    check_drawn(state, rendered(state, 1.0), state.part(Outlines).told[0], outlines.loss)


def test_rough_paint_is_drawn_to_the_normals_of_the_mesh(state):
    step = rendered(state, 0.0)
    assert mesh_normals.loss(state, step) is None
    state.occluder = ball(state.capture.radius / 2)
    check_drawn(state, step, state.part(MeshNormals).told(state, state.occluder, 0), mesh_normals.loss)


def test_metal_and_glossy_paint_are_not(state):
    state.occluder = ball(state.capture.radius / 2)
    rough, glossy, metal = (
        mesh_normals.loss(state, rendered(state, *material)).item() for material in ((0.0, 0.8), (0.0, 0.1), (1.0, 0.8))
    )
    assert metal == 0
    assert glossy == pytest.approx(rough / 64, rel=1e-4)  # as roughness²


def test_a_new_mesh_takes_the_place_of_the_last(state):
    state.occluder = ball(state.capture.radius / 2)
    first = state.part(MeshNormals).told(state, state.occluder, 0)
    assert state.part(MeshNormals).told(state, state.occluder, 0) is first
    state.occluder = ball(state.capture.radius / 4)
    second = state.part(MeshNormals).told(state, state.occluder, 0)
    assert (second.plane.norm(dim=1).max() < 0.7 * first.plane.norm(dim=1).max()).item()


def test_paint_is_not_drawn_to_outlines(state):
    paint, metal = (outlines.loss(state, rendered(state, metallic)).item() for metallic in (0.0, 1.0))
    assert paint == 0 and metal > 1e-4


def test_a_crop_has_its_part_of_the_loss(state):
    whole = rendered(state, 1.0)
    parts = []
    for rows in (slice(0, 50), slice(50, 128)):
        step = Step(state, 0)
        step.photo = whole.photo.part(rows, slice(0, 128))
        names = "color", "alpha", "blended_depth", "normal", "material"
        step.rendering = Rendering(**{name: getattr(whole.rendering, name)[rows] for name in names})
        parts.append(outlines.loss(state, step).item())
    assert min(parts) > 0
    assert sum(parts) == pytest.approx(outlines.loss(state, whole).item(), rel=1e-5)


def test_no_outlines_are_looked_at_unless_they_count(folder, tmp_path):
    state = state_of(folder, tmp_path, "loss.outlines=0")
    assert not state.part(Outlines).told
    assert outlines.loss(state, rendered(state, 1.0)) is None
