import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import os
import sys

import pytest
import torch._dynamo  # noqa: F401  its Triton brings an LLVM that crashes when it is loaded after Mesa's, which Eevee draws with

from benchmarks.scenes.analytic import write_ball_capture


@pytest.fixture(scope="session")
def ball_capture(tmp_path_factory):
    """A small capture with a known answer: a metal ball at 64 pixels."""
    folder = tmp_path_factory.mktemp("ball")
    write_ball_capture(folder, 64)
    return folder


_status = 0


def pytest_sessionfinish(exitstatus):
    global _status
    _status = exitstatus


@pytest.hookimpl(trylast=True)
def pytest_unconfigure():
    """Leave at once where Blender was loaded: its own clean-up at the end of a process has been seen to hang."""
    if "bpy" in sys.modules:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_status)
