"""Test compiling and caching the kernels for CUDA cards.

Tests that use the `device` fixture check what these kernels compute, emulated and on a card.
"""

import pytest

from refgs.kernels import cuda
from tests.makers.layouts import asserted

pytest.importorskip("cuda.bindings.nvrtc", reason="NVIDIA has nothing for this system")

# A usual test run compiles each file for one architecture: in turn the oldest and the newest. A file takes up to 14 seconds.
ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_120")
EVERY = [
    pytest.param(source, name, marks=[] if name == ("sm_75", "sm_120")[number % 2] else pytest.mark.slow)
    for number, source in enumerate(cuda.SOURCES)
    for name in ARCHITECTURES
]


@pytest.mark.parametrize(("source", "architecture"), EVERY)
def test_compiles_without_a_card_with_the_layouts_of_python(source, architecture, tmp_path, monkeypatch):
    monkeypatch.setattr(cuda, "HERE", asserted(tmp_path / "sources"))
    code = cuda.compile_source(source, architecture)
    assert code.startswith(b"\x7fELF")
    for name, home in cuda.KERNELS.items():
        assert (name.encode() in code) == (home == source)


def test_is_compiled_once(tmp_path):
    first = cuda.cubin("sparse.cpp", "sm_86", tmp_path)
    (file,) = tmp_path.iterdir()
    made = file.stat().st_mtime_ns
    assert cuda.cubin("sparse.cpp", "sm_86", tmp_path) == first and file.stat().st_mtime_ns == made
    cuda.cubin("sparse.cpp", "sm_89", tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_error_says_what_the_compiler_said(monkeypatch, tmp_path):
    (tmp_path / "wrong.cpp").write_text("nonsense")
    monkeypatch.setattr(cuda, "HERE", tmp_path)
    monkeypatch.setattr(cuda, "HEADERS", ())
    with pytest.raises(RuntimeError, match=r"wrong\.cpp for sm_86 failed:\n[\s\S]*nonsense"):
        cuda.compile_source("wrong.cpp", "sm_86")
