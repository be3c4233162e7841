import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import pytest
import torch._dynamo  # noqa: F401  its Triton brings an LLVM that crashes when it is loaded after Mesa's, which Eevee draws with

from benchmarks.scenes.analytic import write_ball_capture


@pytest.fixture(scope="session")
def ball_capture(tmp_path_factory):
    """A small capture with a known answer: a metal ball at 64 pixels."""
    folder = tmp_path_factory.mktemp("ball")
    write_ball_capture(folder, 64)
    return folder
