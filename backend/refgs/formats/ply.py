"""Read and write PLY files. A file's size is checked against its header before memory is reserved for the rows that the header declares."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from plyfile import PlyData, PlyElement, PlyParseError

from refgs.errors import InputError
from refgs.paths import open_file, whole

LONGEST_HEADER, LONGEST_LINE = 100_000, 1 << 20  # bytes; a row of 3DGS takes about a thousand
_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_END = re.compile(rb"[\r\n]end_header(\r\n|\n|\r)")


def read_ply(path: str | os.PathLike) -> PlyData:
    """Read all elements of a PLY file (Turk 1994). The file may be text, or binary of either endianness.

    Binary rows are mapped into memory. Raises InputError for a file that is missing, not a PLY, truncated, or longer than its header says.
    """
    path = Path(path)
    try:
        with open_file(path) as file:
            check_header(file, path)
        return PlyData.read(str(path))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except (PlyParseError, ValueError, OverflowError, MemoryError) as error:
        raise InputError(f"{path} is not a whole PLY file ({error}): copy or export it again") from None


def write_ply(path: str | os.PathLike, elements: list[PlyElement], comments: Sequence[str] = ()) -> None:
    """Write a binary little-endian PLY file. A failed write leaves no partial file."""
    with whole(path) as temporary:
        PlyData(elements, byte_order="<", comments=list(comments)).write(str(temporary))


def check_header(file, path: Path) -> None:
    """Check that a PLY file is as long as its header says. `file` is open at its start.

    Raises InputError, which names `path`, if the file is not a PLY file, truncated, or too long.
    """
    header = file.read(LONGEST_HEADER)
    end = _END.search(header)
    if not header.startswith(b"ply") or end is None:
        raise InputError(f"{path} is not a PLY file, or its header is broken: choose another, or export it again")
    if not header[: end.start()].isascii():
        raise InputError(f"{path} has a header that is not plain ASCII: export it again with the program that made it")
    lines = [line.split() for line in header[: end.start()].decode("ascii").splitlines()]
    if len(lines) < 2 or len(lines[1]) < 2:
        raise InputError(f"{path} has a header that does not name its format: export it again")
    text = lines[1][1] == "ascii"
    need, rows, last, most = 0, 0, 0, 0.0
    for count, properties in _elements(lines[2:], path):
        # In text a value takes a digit and a blank at least. A list may be empty: only its length counts.
        least = 2 * len(properties) if text else sum(size for size, _ in properties)
        need, rows, last = need + count * least, rows + count, least
        most += count * sum(largest for _, largest in properties)
    there = os.fstat(file.fileno()).st_size - end.end()
    if need > there + text:  # the last line of text may lack its line break
        raise InputError(
            f"{path} is truncated: its header says {need:,} bytes, {there:,} are there: copy or export it again"
        )
    if text:
        file.seek(end.end())
        over = _count_lines(file, path) > rows
    else:
        over = there - need >= last > 0 and there > most
    if over:
        raise InputError(f"{path} holds more rows than its header says: copy or export it again")


def _count_lines(file, path: Path) -> int:
    """Count the remaining non-blank lines. Raises InputError for one of LONGEST_LINE bytes."""
    count = 0
    while line := file.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise InputError(f"{path} has a row of more than {LONGEST_LINE:,} bytes: copy or export it again")
        count += not line.isspace()
    return count


def _elements(lines: list[list[str]], path: Path) -> list[tuple[int, list[tuple[int, float]]]]:
    """Return each PLY element's row count and its properties' least and most bytes. Raises InputError."""
    elements: list[tuple[int, list[tuple[int, float]]]] = []
    for line in lines:
        match line:
            case ["element", _, count] if count.isdecimal():
                elements.append((int(count), []))
            case ["property", *kinds, _] if elements and (
                len(kinds) == 1 or (kinds[:1] == ["list"] and len(kinds) == 3)
            ):
                kinds = kinds[-2:]  # a list has two types: of its length and of its values
                if wrong := {*kinds} - {*_BYTES}:
                    raise InputError(f"{path} has properties of an unknown type, {wrong.pop()}: export it again")
                size = _BYTES[kinds[0]]
                length = (255.0 if size == 1 else float("inf")) if len(kinds) == 2 else 0.0
                elements[-1][1].append((size, size + length * _BYTES[kinds[-1]] if length else float(size)))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path} has a broken line in its header, “{' '.join(line)[:60]}”: export it again")
    if not all(properties for _, properties in elements):
        raise InputError(f"{path} has an element without properties: export it again")
    return elements
