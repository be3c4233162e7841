"""Assert in C++ that Python's layouts of the kernels' structures are right; the compilers check the static assertions."""

import ctypes
import re
import shutil
from pathlib import Path

from refgs.kernels.build import HERE
from refgs.kernels.layout import struct

ROOT = Path(__file__).parents[2]
# NVRTC has neither offsetof nor a header for it, but its front end's own operator.
OFFSET = """
#ifdef __CUDACC__
#define OFFSET(structure, field) __INTADDR__(&((structure*)0)->field)
#else
#define OFFSET(structure, field) __builtin_offsetof(structure, field)
#endif
"""


def used() -> list[tuple[str, str]]:
    """List the structures that Python code reads, as pairs of name and C++ source."""
    files = [file for folder in ("backend", "benchmarks") for file in (ROOT / folder).rglob("*.py")]
    return sorted({pair for file in files for pair in re.findall(r'\bstruct\("(\w+)", "([\w.]+)"\)', file.read_text())})


def fields(made: type[ctypes.Structure]) -> list[tuple[str, type]]:
    """List the names and types of a structure's fields, including those of its bases."""
    return [field for part in made.__mro__ if "_fields_" in vars(part) for field in part._fields_]


def assertions(made: type[ctypes.Structure]) -> str:
    """Return static assertions of a structure's size and of each field's offset and size, nested structures included."""
    name = made.__name__
    lines = [f'static_assert(sizeof({name}) == {ctypes.sizeof(made)}, "size of {name}");']
    for field, kind in fields(made):
        at, what = getattr(made, field), f"{name}::{field}"
        lines.append(f'static_assert(OFFSET({name}, {field}) == {at.offset}, "offset of {what}");')
        lines.append(f'static_assert(sizeof({what}) == {at.size}, "size of {what}");')
        part = kind._type_ if issubclass(kind, ctypes.Array) else kind
        if issubclass(part, ctypes.Structure):
            lines.append(assertions(part))
    return "\n".join(lines)


def asserted(folder: Path) -> Path:
    """Copy the kernels' sources to a new folder, with assertions of the layout of every structure that Python reads."""
    shutil.copytree(HERE, folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for name, source in used():
        text = assertions(struct(name, source))
        if (name, source) == ("Raster", "raster.h"):  # for the CPU only; raster.cu has its own
            text = f"#ifndef __CUDACC__\n{text}\n#endif"
        with (folder / source).open("a", encoding="utf-8") as file:
            file.write(f"{OFFSET}{text}\n")
    return folder
