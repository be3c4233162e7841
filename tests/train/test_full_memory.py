"""Test trainings that run out of main memory."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from refgs.errors import TryAgain
from refgs.memory import shortage_named

TRAIN = """
import resource, sys
from pathlib import Path
import torch
from refgs import train_job
from refgs.asked import Asked
from refgs.errors import InputError

def attend(state):
    if state.iteration == 5:
        resource.setrlimit(resource.RLIMIT_AS, (1 << 35, resource.RLIM_INFINITY))
        torch.empty(1 << 36, dtype=torch.uint8)

changes = ("surfels.start=500", "surfels.budget=500", "surfels.hull=48", "environment.resolution=16", "train.iterations=10")
asked = Asked(Path(sys.argv[1]), Path(sys.argv[2]), "quick", "cpu", changes=changes)
try:
    train_job.train(asked, lambda *_: None, attend)
except InputError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the system cannot limit a process's memory")
def test_a_training_says_what_to_lower(ball_capture, tmp_path):
    words = [sys.executable, "-c", TRAIN, ball_capture, tmp_path / "run"]
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert said.startswith("memory is full: close other programs and resume") and said.count("\n") == 1
    assert "image.max_side, now 400" in said and "surfels.budget, now 500" in said
    assert said.endswith("or raise the limit of 34.4 GB (ulimit -v)\n")


def fail(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    "fill",
    [
        lambda: np.empty(1 << 60, np.uint8),
        lambda: [0] * (1 << 60),
        lambda: cv2_error(),
        lambda: fail(ImportError("libtorch_cpu.so: failed to map segment from shared object")),
        lambda: fail(OSError("libgomp.so: cannot allocate memory in static TLS block")),
        lambda: fail(RuntimeError("can't start new thread")),
        lambda: fail(RuntimeError("std::bad_alloc")),
    ],
)
def test_shortages_are_known(fill):
    with pytest.raises(TryAgain, match="memory is full: close"), shortage_named():
        fill()


def cv2_error():
    """Let OpenCV fail to allocate an exabyte."""
    cv2.resize(np.zeros((1, 1, 3), np.uint8), (1 << 30, 1 << 28))


def test_other_errors_are_left_alone():
    with pytest.raises(ZeroDivisionError), shortage_named():
        raise ZeroDivisionError
