"""Read PLY files (Turk 1994) without bpy.

The trainer has another reader. Both must accept and refuse the same files: tests/makers/plys.py lists them.
"""

import itertools
import os
import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from .errors import InputError
from .ordinary import open_file

LONGEST_HEADER = 100_000  # bytes
PLY_TYPES = {  # numpy types by PLY's newer names, and by the older ones, which all readers know
    "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "float32": "<f4", "float64": "<f8",
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4", "double": "<f8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"[\r\n]end_header(\r\n|\n|\r)")
_AGAIN = "export it again"

Property = tuple[str, str, str]  # name, PLY type of its value, and that of a list's length or ""
Element = tuple[str, int, list[Property]]


def read_rows(path: Path) -> np.ndarray:
    """Read the element `vertex` of a PLY file as a structured array of little-endian numbers. List properties are left out.

    The file may be text, or binary of either byte order. Raises InputError if the file has no element `vertex`, or is broken, truncated or
    longer than its header says.
    """
    lines, start = read_header(path)
    order, elements = _parse(lines, path)
    if "vertex" not in (name for name, _, _ in elements):
        raise InputError(f"{path} has no element vertex: it is not a PLY file of splats")
    try:
        with open_file(path) as file:
            file.seek(start)
            _check_size(file, order, elements, path)
            read = _read_text if not order else _read_binary
            found = [read(file, order, element) for element in elements]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path} is not a whole PLY file ({error}): copy or export it again") from None
    return next(rows for rows, (name, _, _) in zip(found, elements, strict=True) if name == "vertex")


def read_header(path: Path) -> tuple[list[list[str]], int]:
    """Read a PLY header: each line's words, and the header's size in bytes. Raises InputError."""
    try:
        with open_file(path) as file:
            head = file.read(LONGEST_HEADER)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    end = _END.search(head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{path} is not a PLY file, or its header is broken: choose another, or {_AGAIN}")
    if not head[: end.start()].isascii():
        raise InputError(f"{path} has a header that is not plain ASCII: {_AGAIN} with the program that made it")
    return [line.split() for line in head[: end.start()].decode("ascii").splitlines()], end.end()


def _parse(lines: list[list[str]], path: Path) -> tuple[str, list[Element]]:
    """Parse a header's lines into the byte order ("" for text) and elements. Raises InputError."""
    if (
        lines[0] != ["ply"]
        or len(lines) < 2
        or lines[1][:1] != ["format"]
        or lines[1][2:] != ["1.0"]
        or lines[1][1] not in _FORMATS
    ):
        raise InputError(f"{path} has a header that does not name its format: {_AGAIN}")
    elements: list[Element] = []
    for line in lines[2:]:
        match line:
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", *kinds, name] if elements and (
                len(kinds) == 1 or (kinds[:1] == ["list"] and len(kinds) == 3)
            ):
                if wrong := {*kinds[-2:]} - {*PLY_TYPES}:
                    raise InputError(f"{path} has a broken header, with properties of the type {wrong.pop()}: {_AGAIN}")
                elements[-1][2].append((name, kinds[-1], kinds[1] if len(kinds) == 3 else ""))
            case ["comment", *_]:
                pass
            case ["obj_info", *_] if not elements:
                pass
            case _:
                raise InputError(f"{path} has a broken header, “{' '.join(line)[:60]}”: {_AGAIN}")
    for name, _, properties in elements:
        names = [prop for prop, _, _ in properties]
        if not names:
            raise InputError(f"{path} has an element without properties: {_AGAIN}")
        if len({*names}) < len(names) or [each for each, _, _ in elements].count(name) > 1:
            raise InputError(f"{path} has a broken header, with two properties or elements of the same name: {_AGAIN}")
    return _FORMATS[lines[1][1]], elements


def _check_size(file: BinaryIO, order: str, elements: list[Element], path: Path) -> None:
    """Raise InputError if a file is truncated, or has more rows than its header says."""
    start = file.tell()
    there, need, last = os.fstat(file.fileno()).st_size - start, 0, 0
    for _, count, properties in elements:
        last = sum(np.dtype(PLY_TYPES[length or kind]).itemsize if order else 2 for _, kind, length in properties)
        need += count * last
    if need > there + (not order):  # the last line of text may lack its line break
        raise InputError(f"{path} is truncated: its header says {need:,} bytes, {there:,} are there: copy or {_AGAIN}")
    if order:
        lists = any(length for _, _, properties in elements for _, _, length in properties)
        over = there - need >= last > 0 and not lists
    else:
        over = sum(not line.isspace() for line in file) > sum(count for _, count, _ in elements)
        file.seek(start)
    if over:
        raise InputError(f"{path} holds more rows than its header says: copy or {_AGAIN}")


def _types(properties: list[Property]) -> np.dtype:
    return np.dtype([(name, PLY_TYPES[kind]) for name, kind, length in properties if not length])


def _read_binary(file: BinaryIO, order: str, element: Element) -> np.ndarray:
    _, count, properties = element
    types = _types(properties)
    if not any(length for _, _, length in properties):
        rows = np.fromfile(file, types.newbyteorder(order), count)
        if len(rows) < count:
            raise ValueError("early end of file")
        return rows.astype(types, copy=False)

    def take(kind: str, how_many: int) -> np.ndarray:
        one = np.dtype(PLY_TYPES[kind]).newbyteorder(order)
        data = file.read(one.itemsize * how_many)
        if len(data) < one.itemsize * how_many:
            raise ValueError("early end of file")
        return np.frombuffer(data, one)

    rows = np.empty(count, types)
    for row in rows:
        for name, kind, length in properties:
            if length:
                take(kind, _length(take(length, 1)[0]))
            else:
                row[name] = take(kind, 1)[0]
    return rows


def _read_text(file: BinaryIO, order: str, element: Element) -> np.ndarray:
    _, count, properties = element
    rows = np.empty(count, _types(properties))
    lines = iter([line.split() for line in itertools.islice(file, count)])
    for row in rows:
        values = iter(next(lines, []))
        for name, kind, length in properties:
            many = _length(_number(length, next(values, ""))) if length else 1
            taken = [_number(kind, next(values, "")) for _ in range(many)]
            if not length:
                row[name] = taken[0]
        if next(values, None) is not None:
            raise ValueError("expected end of line")
    return rows


def _length(value: float) -> int:
    if value < 0 or value != int(value):
        raise ValueError("a list's length is wrong")
    return int(value)


def _number(kind: str, word: bytes | str) -> float | int:
    """Parse a number of the PLY type `kind`, or raise ValueError if it is invalid."""
    types = np.dtype(PLY_TYPES[kind])
    if not word:
        raise ValueError("early end of line")
    if types.kind == "f":
        return float(word)
    value = int(word)
    if not np.iinfo(types).min <= value <= np.iinfo(types).max:
        raise ValueError(f"{value} is no {kind}")
    return value
