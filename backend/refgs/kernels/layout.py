"""Read the kernels' argument structs from their C++ declarations, and make the same structs in Python.

Each struct is declared in one place only.
"""

import ctypes
import functools
import re
from typing import cast

import torch

from refgs.kernels.build import HERE

NUMBERS = {
    "double": ctypes.c_double,
    "float": ctypes.c_float,
    "int64_t": ctypes.c_int64,
    "int32_t": ctypes.c_int32,
    "int16_t": ctypes.c_int16,
}


class Work(ctypes.Structure):
    """Hold a kernel's arguments, numbers and pointers to tensors; `struct` makes subclasses."""

    def attach(self, **tensors: torch.Tensor) -> None:
        """Set pointer fields, by name, to contiguous tensors that must outlive the kernels' use."""
        for name, tensor in tensors.items():
            assert tensor.is_contiguous()
            setattr(self, name, tensor.data_ptr())


def struct(name: str, source: str) -> type[Work]:
    """Make a ctypes class like the C++ struct `name`, which is declared in the file `source` or in a header that `source` includes.

    Only the lines before the first empty line of the struct are read. Below this line, the struct has its functions. Fields must be
    numbers, structs, pointers or arrays. An array's length is an integer, or an integer constant of the same file. Raises ValueError for
    any other field, or if the struct is not found.
    """
    if made := _made(name, source):
        return made
    raise ValueError(f"{source}: no struct {name}; declare it there or in a header that is included")


@functools.cache
def _text(source: str) -> str:
    return re.sub(r"^ *//.*\n| *//.*", "", (HERE / source).read_text(encoding="utf-8"), flags=re.MULTILINE)


@functools.cache
def _made(name: str, source: str) -> type[Work] | None:
    text = _text(source)
    pattern = rf"^struct (?:alignas\(\d+\) )?{name} (?:: (\w+) )?{{\n(.*?)^(?:\n|}};)"
    if not (found := re.search(pattern, text, re.MULTILINE | re.DOTALL)):
        included = re.findall(r'^#include "(.*)"', text, re.MULTILINE)
        return next(filter(None, (_made(name, header) for header in included)), None)
    base, body = found.groups()
    constants, fields = dict(re.findall(r"\b(\w+) = (\d+)[,;]", text)), []
    for statement in body.split(";")[:-1]:
        [(kind, declarators)] = re.findall(r"\A\s*(?:mutable )?(?:const )?(\w*)(.*)", statement, re.DOTALL)
        for declarator in declarators.split(","):
            if not (parts := re.fullmatch(r"\s*(\*?)\s*(\w+)(?:\[(\w+)\])?", declarator)):
                raise ValueError(f"{source}: struct {name}: cannot read the field '{' '.join(statement.split())}'")
            pointer, field, length = parts.groups()
            type_ = ctypes.c_void_p if pointer else NUMBERS.get(kind) or struct(kind, source)
            fields.append((field, type_ * int(constants.get(length, length)) if length else type_))
    made = type(name, (struct(base, source) if base else Work,), {"_fields_": fields})
    return cast(type[Work], made)
