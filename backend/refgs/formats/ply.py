"""PLY files, whose heads are not believed: what they say is there is looked for before anything is read or reserved for it."""

import os
import re
from pathlib import Path

from plyfile import PlyData, PlyElement, PlyParseError

from refgs.errors import InputError
from refgs.paths import whole

LONGEST_HEAD = 100_000  # bytes
_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_END = re.compile(rb"[\r\n]end_header(\r\n|\n|\r)")


def read_ply(path: str | os.PathLike) -> PlyData:
    """Read all elements of a PLY file (Turk 1994): text, little or big endian, mapped into memory where it is binary.

    Raises InputError for a file that is missing, no PLY, cut short, or longer than its head says.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            _check(file, path)
        return PlyData.read(str(path))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except (PlyParseError, ValueError, OverflowError, MemoryError) as error:
        raise InputError(f"{path} is not a whole PLY file ({error}): copy or export it again") from None


def write_ply(path: str | os.PathLike, elements: list[PlyElement], comments: list[str] = ()) -> None:
    """Write a binary little-endian PLY file, whole or not at all."""
    with whole(path) as temporary:
        PlyData(elements, byte_order="<", comments=list(comments)).write(str(temporary))


def _check(file, path: Path) -> None:
    """Raise InputError unless the file can hold what its head says, and holds no rows beyond it."""
    head = file.read(LONGEST_HEAD)
    end = _END.search(head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{path} is not a PLY file, or its head is broken: choose another, or export it again")
    if not head[: end.start()].isascii():
        raise InputError(f"{path} has a head that is not plain ASCII: write it again with the program that made it")
    lines = [line.split() for line in head[: end.start()].decode("ascii").splitlines()]
    if len(lines) < 2 or len(lines[1]) < 2:
        raise InputError(f"{path} has a head that does not name its format: export it again")
    text = lines[1][1] == "ascii"
    need, rows, last = 0, 0, 0
    for count, properties in _elements(lines[2:], path):
        least = 2 * len(properties) if text else sum(properties)  # a digit and a blank; of lists their lengths
        need, rows, last = need + count * least, rows + count, least
    there = os.fstat(file.fileno()).st_size - end.end()
    if need > there + text:  # the last line may lack its end
        raise InputError(
            f"{path} is cut short: its head says {need:,} bytes, {there:,} are there: copy or export it again"
        )
    if text:
        file.seek(end.end())
        over = sum(not line.isspace() for line in file) > rows
    else:
        over = there - need >= last > 0 and not any(line[1:2] == ["list"] for line in lines)
    if over:
        raise InputError(f"{path} holds more rows than its head says: copy or export it again")


def _elements(lines: list[list[str]], path: Path) -> list[tuple[int, list[int]]]:
    """Of each element in a head's lines how many rows it has, and the least bytes of their properties."""
    elements: list[tuple[int, list[int]]] = []
    for line in lines:
        match line:
            case ["element", _, count] if count.isdecimal():
                elements.append((int(count), []))
            case ["property", *kinds, _] if elements and (
                len(kinds) == 1 or (kinds[:1] == ["list"] and len(kinds) == 3)
            ):
                kinds = kinds[-2:]  # of a list its length's and its values'
                if wrong := {*kinds} - {*_BYTES}:
                    raise InputError(f"{path} has properties of an unknown type, {wrong.pop()}: export it again")
                elements[-1][1].append(_BYTES[kinds[0]])
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path} has a broken line in its head, “{' '.join(line)[:60]}”: export it again")
    if not all(properties for _, properties in elements):
        raise InputError(f"{path} has an element without properties: export it again")
    return elements
