"""Check that Python (ctypes) and C++ lay out the kernels' structures alike: add static assertions to a copy of the C++ sources.

Compiling the copy checks them.
"""

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
    """List the C++ structures that Python code reads, as pairs: name and source file."""
    files = [file for folder in ("backend", "benchmarks") for file in (ROOT / folder).rglob("*.py")]
    return sorted({pair for file in files for pair in re.findall(r'\bstruct\("(\w+)", "([\w.]+)"\)', file.read_text())})


def fields(structure: type[ctypes.Structure]) -> list[tuple[str, type]]:
    """List the names and types of a ctypes structure's fields, including those of its base classes."""
    return [field for part in structure.__mro__ if "_fields_" in vars(part) for field in part._fields_]


def assertions(structure: type[ctypes.Structure]) -> str:
    """Write C++ static assertions that check a ctypes structure: its size, and the offset and size of each field.

    Nested structures are checked, too.
    """
    name = structure.__name__
    lines = [f'static_assert(sizeof({name}) == {ctypes.sizeof(structure)}, "size of {name}");']
    for field, kind in fields(structure):
        at, what = getattr(structure, field), f"{name}::{field}"
        lines.append(f'static_assert(OFFSET({name}, {field}) == {at.offset}, "offset of {what}");')
        lines.append(f'static_assert(sizeof({what}) == {at.size}, "size of {what}");')
        part = kind._type_ if issubclass(kind, ctypes.Array) else kind
        if issubclass(part, ctypes.Structure):
            lines.append(assertions(part))
    return "\n".join(lines)


def asserted(folder: Path) -> Path:
    """Copy the kernels' sources to a new folder and return it. Add assertions for the layout of each structure that Python reads."""
    shutil.copytree(HERE, folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for name, source in used():
        text = assertions(struct(name, source))
        if (name, source) == ("Raster", "raster.h"):  # for the CPU only; raster.cu has its own
            text = f"#ifndef __CUDACC__\n{text}\n#endif"
        with (folder / source).open("a", encoding="utf-8") as file:
            file.write(f"{OFFSET}{text}\n")
    return folder
