"""List PLY files that the trainer and the add-on must both read, as the same splats, or both refuse with one line.

Each case is a function that makes a file's bytes. Those of READ hold the splats of `rows`, without the rows that `LEFT_OUT` lists.
"""

import io
from collections.abc import Callable

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyProperty

COUNT = 6
NAMES = (
    "x",
    "y",
    "z",
    "nx",
    "ny",
    "nz",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    *(f"rot_{i}" for i in range(4)),
)
MATERIALS = ("albedo_r", "albedo_g", "albedo_b", "metallic", "roughness")


def rows(names: tuple[str, ...] = (*NAMES, *MATERIALS), kind: str = "<f4") -> np.ndarray:
    """Make the splats of all cases. Values are eighths, which text holds exactly."""
    table = np.zeros(COUNT, [(name, kind) for name in names])
    rng = np.random.default_rng(5)
    for name in (*NAMES, *MATERIALS):
        values = rng.integers(1, 8, COUNT) / 8
        if name in names:
            table[name] = values
    return table


def encode(
    table: np.ndarray, *more: PlyElement, first: tuple[PlyElement, ...] = (), format: str = "<", **options
) -> bytes:
    """Encode `table` as the element vertex. `format` is "text", or the byte order."""
    vertex = PlyElement.describe(table, "vertex", **options.pop("lists", {}))
    how = {"text": True} if format == "text" else {"byte_order": format}
    stream = io.BytesIO()
    PlyData([*first, vertex, *more], **how, **options).write(stream)
    return stream.getvalue()


def _faces() -> PlyElement:
    faces = np.empty(2, [("vertex_indices", "O"), ("flag", "u1")])
    faces["vertex_indices"], faces["flag"] = [np.array([0, 1, 2], "<i4"), np.array([3, 4], "<i4")], [7, 8]
    return PlyElement.describe(faces, "face")


def _cameras() -> PlyElement:
    return PlyElement.describe(np.array([(1.5, 3), (2.5, 4)], [("fx", "<f8"), ("id", "<u2")]), "camera")


def _with(format: str, **columns: tuple[str, list]) -> bytes:
    """Add columns to the splats: NumPy types, "O" for lists, and values."""
    table = rows()
    both = np.empty(COUNT, [(name, kind) for name, (kind, _) in columns.items() if name == "first"] + table.dtype.descr
                    + [(name, kind) for name, (kind, _) in columns.items() if name != "first"])  # fmt: skip
    for name in table.dtype.names:
        both[name] = table[name]
    for name, (_, values) in columns.items():
        both[name] = values
    lists = {name: "u1" for name, (kind, _) in columns.items() if kind == "O"}
    return encode(both, format=format, lists={"len_types": lists, "val_types": dict.fromkeys(lists, "f4")})


def _lists() -> list[np.ndarray]:
    return [np.arange(i % 3, dtype="<f4") for i in range(COUNT)]


def _lists_big_endian() -> bytes:
    """Encode splats with lists as big-endian. plyfile writes numbers beside lists in the machine's order."""
    head = _with("<", first=("O", _lists()), last=("O", _lists())).partition(b"end_header\n")[0]
    body = b""
    for row, values in zip(rows(), _lists(), strict=True):
        part = bytes([len(values)]) + values.astype(">f4").tobytes()
        body += part + np.array(row.tolist(), ">f4").tobytes() + part
    return head.replace(b"little", b"big") + b"end_header\n" + body


def _others() -> dict[str, tuple[str, list]]:
    return {"first": ("u1", [255] * COUNT), "seen": ("<i2", [*range(COUNT)]), "trust": ("<f8", [np.nan] * COUNT)}


def _header(old: bytes, new: bytes, format: str = "<") -> Callable[[], bytes]:
    def make() -> bytes:
        data = encode(rows(), format=format)
        assert old in data
        return data.replace(old, new, 1)

    return make


def _values(**changes: tuple[int, float]) -> Callable[[], bytes]:
    """Set one value of some columns: its row and what it becomes."""

    def make() -> bytes:
        table = rows()
        for name, (row, value) in changes.items():
            table[name][row] = value
        return encode(table)

    return make


def _crlf(format: str) -> bytes:
    data = encode(rows(), format=format)
    head, end, body = data.partition(b"end_header\n")
    return (head + end).replace(b"\n", b"\r\n") + (body.replace(b"\n", b"\r\n") if format == "text" else body)


READ: dict[str, Callable[[], bytes]] = {
    "binary": lambda: encode(rows()),
    "big endian": lambda: encode(rows(), format=">"),
    "text": lambda: encode(rows(), format="text"),
    "text without the last line break": lambda: encode(rows(), format="text").rstrip(b"\n"),
    "64 bits": lambda: encode(rows(kind="<f8")),
    "64 bits, big endian": lambda: encode(rows(kind=">f8"), format=">"),
    "another order of properties": lambda: encode(rows((*MATERIALS, *reversed(NAMES)))),
    "comments": lambda: encode(rows(), comments=["made by hand", "", "constant time 3"], obj_info=["scanned 1"]),
    "comments between properties": _header(b"property float z\n", b"comment z is up\nproperty float z\n"),
    "newer names of types": _header(b"property float z\n", b"property float32 z\n"),
    "Windows' line breaks": lambda: _crlf("<"),
    "Windows' line breaks in text": lambda: _crlf("text"),
    "faces behind": lambda: encode(rows(), _faces()),
    "faces first": lambda: encode(rows(), first=(_faces(),)),
    "faces first, big endian": lambda: encode(rows(), first=(_faces(),), format=">"),
    "faces first, in text": lambda: encode(rows(), first=(_faces(),), format="text"),
    "cameras first": lambda: encode(rows(), _faces(), first=(_cameras(),)),
    "an empty element": lambda: encode(rows(), PlyElement.describe(np.zeros(0, [("a", "i4")]), "b")),
    "other columns": lambda: _with("<", **_others()),
    "other columns in text": lambda: _with("text", **_others()),
    "lists": lambda: _with("<", first=("O", _lists()), last=("O", _lists())),
    "lists, big endian": _lists_big_endian,
    "lists in text": lambda: _with("text", first=("O", _lists()), last=("O", _lists())),
    "rows that are not finite": _values(x=(0, np.nan), scale_0=(2, 200.0), albedo_g=(4, np.inf), opacity=(1, np.inf)),
    "a rotation of zero": lambda: encode(_turned()),
    "others' materials": lambda: encode(rows(NAMES)),
}  # fmt: skip
LEFT_OUT = {"rows that are not finite": (0, 2, 4), "a rotation of zero": (3,)}


def _turned() -> np.ndarray:
    table = rows()
    for i in range(4):
        table[f"rot_{i}"][3] = 0
    return table


REFUSED: dict[str, Callable[[], bytes]] = {
    "nothing": lambda: b"",
    "no PLY": lambda: b"\xff\xfe\x00" * 50,
    "a header without an end": lambda: encode(rows())[:60],
    "a header that is too long": _header(b"end_header", b"comment " + b"x" * 100_000 + b"\nend_header"),
    "a header that is not ASCII": _header(b"property float z", b"comment \xe9t\xe9\nproperty float z"),
    "another version": _header(b" 1.0\n", b" 3.0\n"),
    "an unknown format": _header(b"binary_little_endian", b"binary_middle_endian"),
    "an empty line in the header": _header(b"property float z\n", b"\nproperty float z\n"),
    "obj_info between properties": _header(b"property float z\n", b"obj_info 3\nproperty float z\n"),
    "no format": _header(b"format binary_little_endian 1.0\n", b""),
    "truncated": lambda: encode(rows())[:-3],
    "truncated text": lambda: encode(rows(), format="text")[:-20],
    "truncated faces": lambda: encode(rows(), _faces())[:-3],
    "a line of text too short": lambda: encode(rows(), format="text")[:-7] + b"\n" * 7,
    "a line of text too long": lambda: encode(rows(), format="text")[:-1] + b" 7\n",
    "a word in text": lambda: encode(rows(), format="text")[:-6] + b" word\n",
    "more rows": _header(b"vertex 6", b"vertex 5"),
    "more rows of text": _header(b"vertex 6", b"vertex 5", "text"),
    "fewer rows": _header(b"vertex 6", b"vertex 7"),
    "a giant count": _header(b"vertex 6", b"vertex 999999999999999999999"),
    "a giant count of text": _header(b"vertex 6", b"vertex 999999999999999999999", "text"),
    "a negative count": _header(b"vertex 6", b"vertex -6"),
    "no count": _header(b"vertex 6", b"vertex"),
    "no vertices": _header(b"element vertex", b"element vertices"),
    "an element without properties": _header(b"end_header", b"element empty 9\nend_header"),
    "an unknown type": _header(b"float x\n", b"floaty x\n"),
    "an unknown word": _header(b"property float x", b"properly float x"),
    "two properties of a name": _header(b"float x\n", b"float y\n"),
    "two elements of a name": lambda: encode(rows()).replace(
        b"end_header", b"element vertex 0\nproperty float a\nend_header", 1
    ),
    "a position that is a list": lambda: _columns_of_lists(),
    "compressed": _header(b"float f_dc_0\n", b"float packed_position\n"),
    "no colour": _header(b"float f_dc_0\n", b"float colour\n"),
    "no opacity": _header(b"float opacity\n", b"float opacities\n"),
    "no roughness": _header(b"float roughness\n", b"float roughmess\n"),
    "no normals beside materials": _header(b"float nx\n", b"float normal\n"),
    "harmonics of no degree": lambda: _with("<", f_rest_0=("<f4", [0] * COUNT)),
    "a constant that is no number": lambda: _without("roughness", "constant roughness 1.2.3"),
    "a constant that is not finite": lambda: _without("roughness", "constant roughness nan"),
}


def _without(name: str, comment: str) -> bytes:
    return encode(rows(tuple(each for each in (*NAMES, *MATERIALS) if each != name)), comments=[comment])


def _columns_of_lists() -> bytes:
    table = rows()
    types = [PlyListProperty("x", "u1", "f4"), *(PlyProperty(name, "f4") for name in table.dtype.names[1:])]
    vertex = PlyElement("vertex", types, COUNT)
    vertex.data = np.empty(COUNT, [("x", "O"), *table.dtype.descr[1:]])
    for name in table.dtype.names[1:]:
        vertex.data[name] = table[name]
    vertex.data["x"] = _lists()
    stream = io.BytesIO()
    PlyData([vertex], byte_order="<").write(stream)
    return stream.getvalue()
