"""Test that a training draws the normals of metals to what outlines tell."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import cosine_similarity

from refgs.capture import read_capture
from refgs.effective import Effective
from refgs.render.rendering import Rendering
from refgs.settings import load_settings
from refgs.train.learn import outlines
from refgs.train.learn.outlines import Outlines
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


def rendered(state, metallic: float) -> Step:
    """Render the first view with normals turned by 10° and a metallic value."""
    step = Step(state, 0)
    step.photo = state.photos[0]
    picture = state.picture(state.inputs(), step.photo.camera)
    turn = torch.tensor([[0.9848, 0.1736, 0.0], [-0.1736, 0.9848, 0.0], [0.0, 0.0, 1.0]])
    material = picture.material.detach().clone()
    material[..., 3] = metallic
    step.rendering = replace(picture, normal=(picture.normal.detach() @ turn).requires_grad_(), material=material)
    return step


def apart(state, step: Step) -> float:
    """Return the mean of 1 − the cosine between rendered normals and what outlines tell."""
    told, camera = state.part(Outlines).told[0], step.photo.camera
    column, row = (told.plane * torch.tensor([camera.fx, camera.fy]) + torch.tensor([camera.cx, camera.cy])).long().T
    return (1 - cosine_similarity(step.rendering.normal.detach()[row, column], told.normals)).mean().item()


def test_metal_is_drawn_to_the_normals_that_outlines_tell(folder, tmp_path):
    state = state_of(folder, tmp_path)
    step = rendered(state, 1.0)
    assert len(state.part(Outlines).told[0].plane) > 200
    before = apart(state, step)
    for _ in range(30):
        normal = step.rendering.normal
        (gradient,) = torch.autograd.grad(outlines.loss(state, step), normal)
        moved = normal.detach() - 0.02 * torch.nn.functional.normalize(gradient, dim=-1)
        step.rendering = replace(step.rendering, normal=moved.requires_grad_())
    assert apart(state, step) < 0.3 * before


def test_paint_is_not(folder, tmp_path):
    state = state_of(folder, tmp_path)
    paint, metal = (outlines.loss(state, rendered(state, metallic)).item() for metallic in (0.0, 1.0))
    assert paint == 0 and metal > 1e-4


def test_a_crop_has_its_part_of_the_loss(folder, tmp_path):
    state = state_of(folder, tmp_path)
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
