"""Test the loss of normals and depth from other programs: what the files mean, what the loss pulls, and what a training makes of them."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from refgs.capture import read_capture
from refgs.render.rendering import Rendering
from refgs.train.learn import priors
from refgs.train.photo import Photo
from tests.makers import scenes
from tests.makers.bowl import bowl_normals, write_bowl_capture
from tests.makers.priors import OPENGL, true_maps, write_depth, write_normals
from tests.makers.training import check_equal, trainer


@pytest.fixture
def ball(ball_capture, tmp_path):
    """Copy the capture of the metal ball, so that files can be added."""
    return shutil.copytree(ball_capture, tmp_path / "ball")


def started(capture, folder, *changes):
    """Make a training that has not begun. Return its state."""
    return trainer(capture, folder, *changes, total=60).state


@pytest.mark.parametrize(
    ("signs", "says"),
    [
        (OPENGL, "x right, y up, z to the camera"),
        ((1, 1, 1), "x right, y down, z away"),
        ((-1, -1, -1), "x left, y up, z to the camera"),
        ((1, 1, -1), "x right, y down, z to the camera"),
        (None, "in world space"),
    ],
    ids=["Marigold", "OpenCV", "DSINE", "mirrored", "world"],
)
def test_the_axes_of_normals_are_found(ball, tmp_path, signs, says):
    write_normals(ball, signs)
    state = started(ball, tmp_path / "run")
    assert says in state.decided["prior normals"] and "24 of 24 photos" in state.decided["prior normals"]
    for view in (0, 7):
        codes, camera = state.part(priors.Priors).normals[view]
        true, _ = true_maps(camera)
        known = codes.float().norm(dim=-1) > 64
        np.testing.assert_allclose(codes[known] / priors.CODE, true[known], atol=0.03)


def test_normals_of_something_else_are_left_out(ball, tmp_path):
    """Check that normals that do not lean to the sides as the outline does are not used: here each photo has another one's, rolled."""
    write_normals(ball)
    for number, file in enumerate(sorted((ball / "normals").iterdir())):
        picture = cv2.imread(str(file))
        turned = np.rot90(picture, number % 4)
        cv2.imwrite(str(file), turned)
    state = started(ball, tmp_path / "run")
    assert not state.part(priors.Priors).normals
    assert "without normals from elsewhere for 24 of 24 photos" in state.decided["prior normals"]


def test_files_for_some_photos_are_used_for_these(ball, tmp_path):
    write_normals(ball)
    for file in sorted((ball / "normals").iterdir())[5:]:
        file.unlink()
    state = started(ball, tmp_path / "run")
    assert len(state.part(priors.Priors).normals) == 5 and "5 of 24 photos" in state.decided["prior normals"]


def test_nothing_is_used_without_masks(ball, tmp_path):
    write_normals(ball)
    capture = read_capture(ball)
    views = [replace(view, has_alpha=False) for view in capture.views]
    state = started(replace(capture, views=views), tmp_path / "run", "image.masks=off")
    assert not state.part(priors.Priors).normals and "mask" in state.decided["priors"]


@pytest.mark.parametrize(("disparity", "scale", "shift"), [(False, 1, 0), (False, 0.2, 3), (True, 1, 0), (True, 40, 5)])
def test_depth_of_any_scale_and_shift_fits(ball, tmp_path, disparity, scale, shift):
    write_depth(ball, disparity, scale, shift)
    state = started(ball, tmp_path / "run")
    assert state.part(priors.Priors).disparity == disparity
    assert ("a disparity" if disparity else "a depth") in state.decided["prior depth"]
    camera = state.photos[3].camera
    true = torch.from_numpy(true_maps(camera)[1]).float()
    guessed, counts = priors.at_pixels(*state.part(priors.Priors).depth[3], camera), (true > 0).float()
    wrong = true + 0.5 * (torch.arange(true.shape[1]) < 0.3 * true.shape[1])  # a fifth of the rendering is wrong
    found, fits = priors.fitted(guessed, wrong, counts, disparity, 1.0)
    assert fits == 1
    assert float(((found - true).abs() * counts).max()) < 0.05


def picture(disparity: bool = False):
    """Make a random rendering of a bumpy surface, its photo, and guesses of its normals and depth, of another size."""
    rng, camera = np.random.default_rng(0), scenes.camera(24, 18)
    y, x = torch.meshgrid(torch.arange(18) / 7, torch.arange(24) / 5, indexing="ij")
    depth = (2.5 + 0.3 * torch.sin(x) * torch.cos(y)).double()
    alpha = torch.from_numpy(rng.uniform(0.3, 1, (18, 24)))
    normal = torch.from_numpy(rng.normal(size=(18, 24, 3)) + 2 * camera.world_to_camera[2, :3])
    rendering = Rendering(torch.zeros(18, 24, 3), alpha, depth * alpha, normal)
    mask = torch.from_numpy(rng.integers(0, 256, (18, 24)).astype(np.uint8))
    photo = Photo(torch.zeros(18, 24, 3, dtype=torch.uint8), mask, camera)
    small = camera.resized(12, 9)
    codes = rng.normal(size=(9, 12, 3)) + np.array([0, 0, 2])
    codes[0] = 0
    codes = torch.from_numpy(np.rint(127 * codes / np.maximum(np.linalg.norm(codes, axis=-1, keepdims=True), 1)))
    guessed = 1 / depth[::2, ::2] if disparity else depth[::2, ::2]
    guessed = 0.3 * guessed.float() + 0.02 * torch.from_numpy(rng.uniform(size=(9, 12))).float()
    return rendering, photo, (codes.to(torch.int8), small), (guessed, small)


@pytest.mark.parametrize("name", ["normal", "blended_depth"])
@pytest.mark.parametrize("disparity", [False, True])
def test_gradients_are_those_of_the_loss(name, disparity, monkeypatch):
    """Compare derivatives with finite differences. The fit of depth is held: it has no gradient."""
    rendering, photo, normals, depth = picture(disparity)
    counts = priors._counts(rendering, photo) * (priors.at_pixels(*depth, photo.camera) > 0)
    fit = priors.fitted(priors.at_pixels(*depth, photo.camera), rendering.depth, counts, disparity, 1.5)
    monkeypatch.setattr(priors, "fitted", lambda *_: fit)
    values = getattr(rendering, name).clone().requires_grad_()

    def total(values):
        changed = replace(rendering, **{name: values})
        return priors.normals_loss(changed, photo, *normals) + priors.depth_loss(changed, photo, *depth, disparity, 1.5)

    (gradient,) = torch.autograd.grad(total(values), values)
    assert gradient.abs().max() > 0
    for index in np.random.default_rng(1).integers(0, values.numel(), 20):
        step = torch.zeros_like(values.detach())
        step.view(-1)[index] = 1e-4
        change = (total(values.detach() + step) - total(values.detach() - step)) / 2e-4
        assert float(gradient.view(-1)[index]) == pytest.approx(float(change), rel=1e-3, abs=1e-7)


def test_the_loss_is_zero_at_the_truth_and_saturates_far_from_it():
    rendering, photo, (codes, small), _ = picture()
    guessed = priors.at_pixels(codes, small, photo.camera).double() @ torch.from_numpy(
        photo.camera.world_to_camera[:3, :3]
    )
    true = replace(rendering, normal=guessed)
    assert float(priors.normals_loss(true, photo, codes, small)) == pytest.approx(0, abs=1e-6)
    opposite = float(priors.normals_loss(replace(true, normal=-guessed), photo, codes, small))
    counts = priors._counts(rendering, photo) * (guessed.norm(dim=-1) > 90)
    assert opposite == pytest.approx(2 / (2 + priors.WRONG) * float(counts.mean()), rel=1e-3)


def test_a_crop_has_its_part_of_the_loss():
    rendering, photo, normals, _ = picture()
    rows, columns = slice(0, 18), slice(0, 24)
    parts = [(slice(0, 7), columns), (slice(7, 18), slice(0, 11)), (slice(7, 18), slice(11, 24))]

    def part(rows, columns):
        maps = {name: getattr(rendering, name)[rows, columns] for name in ("color", "alpha", "blended_depth", "normal")}
        return float(priors.normals_loss(Rendering(**maps), photo.part(rows, columns), *normals))

    assert sum(part(*each) for each in parts) == pytest.approx(part(rows, columns), rel=1e-6)


def test_priors_fade():
    values = [priors.fade(progress) for progress in np.linspace(0, 1, 21)]
    assert values[0] == 1 and values == sorted(values, reverse=True)
    assert values[-1] == 0 == priors.fade(priors.FADED) and priors.fade(priors.FADED / 2) == pytest.approx(0.5)


def test_a_resumed_training_is_the_same_one(ball, tmp_path):
    write_normals(ball)
    write_depth(ball, disparity=True, scale=2, shift=1)
    whole = trainer(ball, tmp_path / "whole", total=40)
    whole.run()
    first = trainer(ball, tmp_path / "cut", total=40)
    first.run(stop=lambda: first.state.iteration >= 13)
    second = trainer(ball, tmp_path / "cut", total=40)
    second.resume()
    assert second.state.iteration == 13
    second.run()
    check_equal(whole, second)


def test_true_normals_open_a_bowl(tmp_path):
    """Train on a bowl, whose outlines have a lid, without normals and with true ones. Compare normals in held-out views with the truth."""
    errors = []
    for given in (False, True):
        write_bowl_capture(tmp_path / f"bowl {given}", 64, given)
        made = trainer(tmp_path / f"bowl {given}", tmp_path / f"run {given}", total=200)
        while not made.state.ended:
            made.iterate()
        errors.append([])
        for view in made.state.test:
            seen = made.state.render(view.camera)
            _, true, hit = bowl_normals(view.camera.camera_to_world * [1, -1, -1, 1], 64)
            shown = torch.from_numpy(hit) & (seen.alpha > 0.5)
            cosine = torch.cosine_similarity(seen.normal[shown], torch.from_numpy(true).float()[shown], dim=-1)
            errors[-1].append(float(torch.rad2deg(cosine.clamp(-1, 1).acos()).mean()))
    assert np.mean(errors[1]) < 0.9 * np.mean(errors[0])
