"""Tests of masks by a segmentation model: tiny ONNX models that find red, made here, and what a model could say."""

import hashlib
import os
import signal

import cv2
import numpy as np
import pytest

from refgs.capture import load_view, masks, read_capture, silhouettes
from refgs.capture.box import Box
from refgs.capture.salience import MODEL as INSTALLED
from refgs.capture.salience import SalienceModel
from refgs.errors import InputError
from scripts import fetch_model
from tests.makers import unmasked
from tests.makers.captures import CENTRE, ball, ring
from tests.makers.models import REDNESS, write_model
from tests.makers.unmasked import COUNT, FOCAL, SIZE, overlap, photograph, read_masks


@pytest.mark.parametrize(("size", "last"), [((32, 40), "Identity"), (("h", "w"), "Sigmoid"), ((64, 64), "Exp")])
def test_output_is_a_probability_at_the_photos_size(tmp_path, size, last):
    model = SalienceModel(write_model(tmp_path / "red.onnx", size, last))
    assert model.side == (1024 if size[0] == "h" else max(size))
    photo = np.zeros((48, 60, 3), np.uint8)
    photo[:, 30:, 0] = 220
    found = model(photo)
    assert found.shape == (48, 60) and found.dtype == np.float32
    assert found[:, 34:].min() > 0.9 and found.max() <= 1
    if last == "Sigmoid":  # of the weighted sum of black, normalised
        black = float((REDNESS.ravel() * -np.array([0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).sum())
        assert found[:, :26] == pytest.approx(1 / (1 + np.exp(-black)), abs=1e-3)


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda file: None, "there is no such file"),
        (lambda file: file.write_bytes(b"no model"), "cannot read it"),
        (lambda file: write_model(file, (8, 8), weights=np.ones((1, 4, 1, 1), np.float32)), "not one RGB photo"),
        (lambda file: write_model(file, (8, 8), weights=np.ones((2, 3, 1, 1), np.float32)), "not one map"),
        (lambda file: write_model(file, (8, 8), "Log", -REDNESS), "not one map of finite"),
        (lambda file: write_model(file, (1 << 20, 8)), "wants photos of 8×1048576 pixels"),
    ],
)
def test_models_that_do_not_fit_are_an_error_of_one_line(tmp_path, make, what):
    make(tmp_path / "model.onnx")
    with pytest.raises(InputError, match=what) as error:
        SalienceModel(tmp_path / "model.onnx")(np.zeros((8, 8, 3), np.uint8))
    assert "\n" not in str(error.value)


def test_a_model_that_ends_onnx_runtime_is_an_error_of_one_line(tmp_path):
    """Check a model whose process dies as it would by a fault of ONNX Runtime, in the middle of its work."""
    model = SalienceModel(write_model(tmp_path / "model.onnx", (8, 8)))
    os.kill(model._process.pid, signal.SIGABRT)
    with pytest.raises(InputError, match=r"ended while it used it \(status -6\): the file is damaged") as error:
        model(np.zeros((8, 8, 3), np.uint8))
    assert "\n" not in str(error.value)


def test_a_models_process_ends_with_it(tmp_path):
    model = SalienceModel(write_model(tmp_path / "model.onnx", (8, 8)))
    process = model._process
    del model
    process.join(30)
    assert process.exitcode == 0


class Told:
    """Judge that says what it is told, in place of a segmentation model: probabilities (H, W) by the photo's number."""

    def __init__(self, likely):
        self.likely = likely

    def __call__(self, part):
        small = part.view.camera.fitted(part.side)
        likely = self.likely[int(part.view.image_path.stem)]
        return part.cut(cv2.resize(likely, (small.width, small.height), interpolation=cv2.INTER_AREA))


def made_with(folder, monkeypatch, likely):
    """Make masks with a model that says `likely` (H, W) of each photo. Returns the masks."""
    monkeypatch.setattr(masks, "find_judge", lambda model: Told([np.float32(array) for array in likely]))
    masks.make_masks(folder, None, lambda event, facts: None)
    return read_masks(folder)


def test_photos_in_which_the_model_took_something_else_are_outvoted(tmp_path, monkeypatch):
    truths = photograph(tmp_path)
    corner = np.zeros_like(truths[0])
    corner[:20, :25] = True
    likely = [corner if i in (2, 5, 8) else truth for i, truth in enumerate(truths)]
    assert min(overlap(made_with(tmp_path, monkeypatch, likely), truths)) > 0.9


def test_parts_that_the_model_misses_are_found_by_their_colours(tmp_path, monkeypatch):
    truths = photograph(tmp_path)
    likely = [truth.copy() for truth in truths]
    for array in likely[::2]:
        columns = np.flatnonzero(array.any(axis=0))
        array[:, columns[0] : columns[len(columns) // 3]] = False
    assert min(overlap(made_with(tmp_path, monkeypatch, likely), truths)) > 0.9


def test_the_model_looks_at_the_part_that_shows_the_object(tmp_path, monkeypatch):
    """Check the parts of the photos that the model gets: the whole photos, then of each photo a part, with all of the object."""
    truths = photograph(tmp_path, poses=ring(COUNT, distance=6.0))
    seen = []

    class Listening(Told):
        def __call__(self, part):
            seen.append(part)
            return super().__call__(part)

    monkeypatch.setattr(masks, "find_judge", lambda model: Listening([np.float32(truth) for truth in truths]))
    masks.make_masks(tmp_path, None, lambda event, facts: None)
    assert min(overlap(read_masks(tmp_path), truths)) > 0.9
    parts = [part for part in seen if part.bounds != (0.0, 0.0, 1.0, 1.0)]
    assert len(seen) - len(parts) == len(truths)
    assert {part.view.image_path for part in parts} == {part.view.image_path for part in seen}
    for part in parts:
        truth = truths[int(part.view.image_path.stem)]
        shown = part.cut(truth)  # these photos are too small to be reduced
        assert shown.sum() == truth.sum() and shown.size < 0.9 * truth.size


@pytest.mark.parametrize("aimed", [True, False])
def test_of_two_objects_the_one_that_the_cameras_look_at(tmp_path, monkeypatch, aimed):
    """Check cameras that look at one of two balls, and cameras that look between them: then both are the object."""
    aside = CENTRE + np.array([0.0, 1.6, 0.0])
    monkeypatch.setattr(unmasked, "ASIDE", aside)
    poses = ring(COUNT, distance=4.0, centre=CENTRE if aimed else (CENTRE + aside) / 2)
    both = photograph(tmp_path, beside=True, poses=poses)
    alone = [ball(pose, *SIZE, FOCAL)[..., 3] > 0 for pose in poses]
    made = made_with(tmp_path, monkeypatch, both)
    assert np.mean(overlap(made, alone if aimed else both)) > 0.9


def whole_photos(folder):
    """Photograph a ball. Return the capture's photos, with the true masks as `salient`, and the guessed box."""
    truths = photograph(folder)
    capture = read_capture(folder)
    photos = [
        silhouettes.Photo(
            load_view(view, 96).bytes, view.camera.resized(*SIZE), np.zeros(SIZE[::-1], np.int8),
            np.float32(truths[int(view.image_path.stem)]),
        )
        for view in capture.views
    ]  # fmt: skip
    return photos, masks.guess_box(capture, capture.views)[0]


def test_the_box_is_around_what_the_model_finds(tmp_path):
    """Check a guessed box that cuts the ball, and one in which the ball is small."""
    photos, guessed = whole_photos(tmp_path)
    found = [
        silhouettes.find_box(photos, Box(guessed.matrix @ np.diag([scale, scale, scale, 1.0]))) for scale in (0.7, 4.0)
    ]
    assert found[0].matrix == pytest.approx(found[1].matrix, abs=0.25 * found[0].radius)


def test_photos_in_which_the_model_finds_nothing_do_not_cut_the_object(tmp_path):
    """Check that the box holds all of a ball, though four of ten photos, which show its upper half, show nothing to the model."""
    photos, guessed = whole_photos(tmp_path)
    whole, upper = silhouettes.find_box(photos, guessed), slice(0, SIZE[1] // 2)
    for i in (0, 3, 5, 8):
        image = photos[i].image[upper]
        camera = photos[i].camera.cropped(0, 0, *image.shape[1::-1])
        nothing = np.zeros(image.shape[:2])
        photos[i] = silhouettes.Photo(image, camera, nothing.astype(np.int8), nothing.astype(np.float32))
    assert silhouettes.find_box(photos, guessed).matrix == pytest.approx(whole.matrix, abs=0.1 * whole.radius)


@pytest.mark.skipif(not INSTALLED.is_file(), reason="no segmentation model: python scripts/fetch_model.py")
def test_the_model_that_is_installed_finds_a_ball(tmp_path):
    pixels = np.full((240, 320, 3), 190, np.uint8)
    row, column = np.mgrid[:240, :320]
    inside = (row - 130) ** 2 + (column - 150) ** 2 < 60**2
    shade = 1 - 0.5 * np.hypot(row - 100, column - 130) / 120
    pixels[inside] = (np.array([200, 40, 40]) * shade[inside, None]).astype(np.uint8)
    model = SalienceModel(INSTALLED)
    model_overlap = overlap([model(pixels) > 0.5], [inside])[0]
    assert hashlib.sha256(INSTALLED.read_bytes()).hexdigest() == fetch_model.SHA256 and fetch_model.MODEL == INSTALLED
    assert model_overlap > 0.95
