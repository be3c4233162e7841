"""Test how ctypes structures are made from the structures in the C++ sources.

In test_build.py and test_cuda.py the compilers check that both have the same memory layout.
"""

import functools
import importlib.util
from ctypes import c_double, c_float, c_int16, c_int32, c_int64, c_void_p

import pytest

from refgs.kernels import build, cuda, layout
from refgs.kernels.layout import struct
from tests.makers.layouts import asserted, fields, used

WHOLE = """
#include "part.h"
constexpr int FEW = 2, MANY = 3;

struct Whole : Base {
  // a comment; with a semicolon
  const float *a, *b;  // and another
  double c[MANY], d;
  Part parts[FEW], one;

  int more() const { return 0; }
};
"""
PART = """
struct Part {
  int16_t x, y[5];
};

struct alignas(16) Base {
  int64_t first;
  float second;
  mutable int32_t third;
};
"""


@pytest.fixture
def sources(monkeypatch, tmp_path):
    """Return an empty folder. During the test, the C++ sources are read from it."""
    monkeypatch.setattr(layout, "HERE", tmp_path)
    for name in ("_text", "_made"):
        monkeypatch.setattr(layout, name, functools.cache(getattr(layout, name).__wrapped__))
    return tmp_path


def test_fields_are_read(sources):
    (sources / "whole.cpp").write_text(WHOLE)
    (sources / "part.h").write_text(PART)
    whole, part, base = struct("Whole", "whole.cpp"), struct("Part", "part.h"), struct("Base", "part.h")
    assert whole is struct("Whole", "whole.cpp") and issubclass(whole, base)
    assert fields(part) == [("x", c_int16), ("y", c_int16 * 5)]
    assert fields(base) == [("first", c_int64), ("second", c_float), ("third", c_int32)]
    numbers = [("a", c_void_p), ("b", c_void_p), ("c", c_double * 3), ("d", c_double)]
    assert fields(whole) == [*numbers, ("parts", part * 2), ("one", part), *fields(base)]


@pytest.mark.parametrize(
    "field", ["float a(int)", "std::vector<int> a", "float a[2][3]", "float &a", "unsigned char a"]
)
def test_field_of_another_kind(sources, field):
    (sources / "wrong.cpp").write_text(f"struct Wrong {{\n  int64_t count;\n  {field};\n}};\n")
    with pytest.raises(ValueError) as error:
        struct("Wrong", "wrong.cpp")
    assert str(error.value) == f"wrong.cpp: struct Wrong: cannot read the field '{field}'"


def test_struct_that_is_not_declared():
    with pytest.raises(ValueError, match=r"^normals\.cpp: no struct Abnormals"):
        struct("Abnormals", "normals.cpp")


def test_layouts_are_found_in_the_code():
    assert {name for name, _ in used()} >= {"Shade", "Raster", "Losses", "Learned", "Trace", "Carve", "Peak"}


@pytest.mark.parametrize(
    ("declared", "other", "said"),
    [
        ("int64_t count;", "int32_t count;", "size of Normals::count"),
        ("double camera[3];", "int64_t more; double camera[3];", "offset of Normals::camera"),
        ("mutable Shared shared;", "mutable Shared shared; float* scratch;", "size of Normals"),
    ],
)
def test_wrong_layout_is_found(declared, other, said, tmp_path, monkeypatch):
    copy = asserted(tmp_path / "kernels")
    text = (copy / "normals.cpp").read_text()
    assert text.count(declared) == 1
    (copy / "normals.cpp").write_text(text.replace(declared, other))
    for module in (build, cuda):
        monkeypatch.setattr(module, "HERE", copy)
    monkeypatch.setattr(build, "SOURCES", ["normals.cpp"])
    with pytest.raises(RuntimeError, match=rf"static assertion failed.*{said}\b"):
        build.build(build.target("linux", "x86_64", "sse4"), tmp_path)
    if importlib.util.find_spec("cuda"):  # not available for every system
        with pytest.raises(RuntimeError, match=rf"static assertion failed.*{said}\b"):
            cuda.compile_source("normals.cpp", "sm_86")
