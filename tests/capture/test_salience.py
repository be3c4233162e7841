"""Tests of masks by an ONNX model: tiny models that find red, made here."""

import os
import signal
import sys

import numpy as np
import pytest

from refgs import commands
from refgs.capture import silhouettes
from refgs.capture.images import read_image
from refgs.capture.salience import SalienceModel
from refgs.errors import InputError
from tests.makers.models import REDNESS, write_model
from tests.makers.unmasked import SIZE, overlap, photograph, read_masks


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


def test_masks_are_of_what_the_model_finds(tmp_path, monkeypatch):
    monkeypatch.setattr(silhouettes, "GRID", 24)
    monkeypatch.setattr(silhouettes, "ROUNDS", 3)
    truths = photograph(tmp_path)
    # The model finds the ball's red upper half, where the colours' guess is the ball.
    commands.masks(tmp_path, [], write_model(tmp_path / "red.onnx", SIZE[::-1]))
    halves = []
    for i, truth in enumerate(truths):
        photo = read_image(tmp_path / "images" / f"{i:04d}.png")[0]
        halves.append(truth & (photo[..., 0] > 100))
    assert np.mean(overlap(read_masks(tmp_path), halves)) > 0.85


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


def test_missing_onnx_runtime_is_said_with_how_to_install_it(tmp_path, monkeypatch):
    file = write_model(tmp_path / "red.onnx", (8, 8))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match="-m pip install onnxruntime"):
        SalienceModel(file)
