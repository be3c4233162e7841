"""Damage files as accidents and attackers do: bytes, values of JSON and TOML, words of text, what a capture's files are and say."""

import copy
import json
import math
import os
import random
import re
import stat
import struct
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from PIL import Image

_DEEP, _LONG = "@deep@", "@digits@"  # replaced in the text by what no writer of JSON or TOML writes
HOSTILE = [
    None, True, False, 0, 1, -1, 2, 0.3, 64, 2**31, 2**53, -(2**63), 2**64, 10**30, 10**400,
    float("nan"), float("inf"), float("-inf"), 1e-320, 1e-9, 1e30, 1e308, -1e308,
    "", "x", "1", "nan", ".", "..", "/", "\0", "a\nb", "a\u2028b", "\udcff", "\ud800", "é" * 200, "a" * 5000,
    "../../../../../../etc/passwd", "/dev/zero", "/proc/self/mem", "C:\\x", "{x}", "%s", "$a$", "[red]", "<b>",
    [], {}, [[]], [None], {"": {}}, [0] * 17, [[1, 2], [3]], [[0.0] * 4] * 4, _DEEP, _LONG,
]  # fmt: skip
PATTERNS = [
    struct.pack(order + kind, value)
    for order in "<>"
    for kind, values in {
        "B": (0, 1, 127, 128, 255),
        "H": (0, 1, 0x7FFF, 0xFFFF),
        "I": (0, 1, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF),
        "Q": (0, 1, 1 << 32, (1 << 63) - 1, (1 << 64) - 1),
        "f": (float("nan"), float("inf"), 1e38, -1.0),
        "d": (float("nan"), float("inf"), 1e308, -1.0),
    }.items()
    for value in values
]


def mutant(data: bytes, kind: str, dice: random.Random) -> bytes:
    """Damage the content of a file. `kind` is "bytes", "json", "toml", "lines" (of JSON) or "text", which says where to look for values."""
    if kind in _BY_VALUE and dice.random() < 0.75:
        data = _BY_VALUE[kind](data, dice)
        if dice.random() < 0.85:
            return data
    for _ in range(dice.choice((1, 1, 1, 2, 4, 16))):
        data = _raw(data, dice)
    return data


def _raw(data: bytes, dice: random.Random) -> bytes:
    """Damage bytes in one place: flip, overwrite, cut, repeat, insert, blank, swap; or put something else in their place."""
    # Headers are short, and decide most.
    size = len(data) if dice.random() < 0.5 else min(len(data), 200)
    at = dice.randrange(size + 1)
    end = min(len(data), at + dice.choice((1, 2, 4, 8, 40, 1000)))
    match dice.randrange(12):
        case 0 | 1 if data:
            at = min(at, len(data) - 1)
            return data[:at] + bytes([data[at] ^ (1 << dice.randrange(8))]) + data[at + 1 :]
        case 2 | 3:
            pattern = dice.choice(PATTERNS)
            return data[:at] + pattern + data[at + len(pattern) :]
        case 4:
            return data[: dice.randrange(len(data) + 1)]
        case 5:
            return data[:at] + data[end:]
        case 6:
            return data[:end] + data[at:end] * dice.choice((1, 3, 100)) + data[end:]
        case 7:
            return data[:at] + dice.randbytes(end - at) + data[at:]
        case 8:
            return data[:at] + bytes([dice.choice((0, 255, 32))]) * (end - at) + data[end:]
        case 9:
            other = dice.randrange(len(data) + 1)
            return data[:at] + data[other : other + end - at] + data[end:]
        case 10:
            return data + dice.choice((b"\0", b"\n", data[:1000], dice.randbytes(20)))
    return dice.choice((b"", b"\xef\xbb\xbf" + data, b"\xff\xfe\xfa", data[::-1], b"\0" * 300, b"[" * 100_000))


def damaged_value(value: Any, dice: random.Random) -> Any:
    """Replace, remove, repeat or rename one value in what `json.loads` returns."""
    value = copy.deepcopy(value)
    inner, last = [value], []
    while isinstance(inner[-1], dict | list) and inner[-1] and dice.random() < 0.85:
        keys = list(inner[-1]) if isinstance(inner[-1], dict) else range(len(inner[-1]))
        last.append(dice.choice(keys))
        inner.append(inner[-1][last[-1]])
    if not last:
        return dice.choice(HOSTILE)
    holder, key = inner[-2], last[-1]
    new = copy.deepcopy(dice.choice(HOSTILE))
    match dice.randrange(8):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, list):
            holder.insert(key, holder[key])
        case 1:
            holder[dice.choice(("", "x", "file_path", "w"))] = holder.pop(key)
        case 2 if isinstance(holder, list):
            holder[:] = holder * dice.choice((2, 50))
        case 3:
            holder[key] = dice.choice(([holder[key]], {"x": holder[key]}, str(holder[key])))
        case 4 if isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
            holder[key] = holder[key] * dice.choice((-1, 0, 2, 1e-30, 1e30, 1e300))
        case 5 if isinstance(holder, dict):
            holder["x" if dice.random() < 0.5 else "k1"] = new
        case _:
            holder[key] = new
    return value


def _json(data: bytes, dice: random.Random) -> bytes:
    text = json.dumps(damaged_value(json.loads(data), dice))
    deep = "[" * (n := dice.choice((50, 300, 20_000))) + "]" * n
    return text.replace(f'"{_DEEP}"', deep).replace(f'"{_LONG}"', "9" * 6000).encode()


def _lines(data: bytes, dice: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = dice.choice([i for i, line in enumerate(lines) if line])
    lines[at] = _json(lines[at], dice)
    return b"\n".join(lines)


def _toml(data: bytes, dice: random.Random) -> bytes:
    try:
        text = tomli_w.dumps(damaged_value(tomllib.loads(data.decode()), dice))
    except (TypeError, AttributeError, ValueError):  # null, or no table
        return _raw(data, dice)
    n = dice.choice((50, 300, 20_000))
    text = text.replace(f'"{_DEEP}"', dice.choice(("[" * n + "]" * n, "{a=" * n + "1" + "}" * n)))
    return text.replace(f'"{_LONG}"', "9" * 6000).encode(errors="surrogatepass")


def _text(data: bytes, dice: random.Random) -> bytes:
    words = data.split(b" ")
    for _ in range(dice.choice((1, 1, 3))):
        word = dice.choice(HOSTILE)
        word = b"\n" if isinstance(word, dict | list) else str(word)[:500].encode(errors="surrogatepass")
        words[dice.randrange(len(words))] = word
    return b" ".join(words)


_BY_VALUE = {"json": _json, "toml": _toml, "lines": _lines, "text": _text}
LINKS = ("", ".", "nowhere", "/dev/zero", "/dev/null", "/proc/self/mem", "itself", "fifo", "socket")


def put_link(file: Path, to: str) -> None:
    """Put something else in the place of a file: a folder (""), a pipe, a socket, or a link to its folder, itself, nothing or a device."""
    if to == "fifo":
        os.mkfifo(file)
    elif to == "socket":
        os.mknod(file, 0o600 | stat.S_IFSOCK)
    elif to:
        file.symlink_to(file if to == "itself" else to)
    else:
        file.mkdir()


def damage_folder(folder: Path, dice: random.Random) -> None:
    """Damage a capture as people and programs do: in what its files are and say, not in their bytes."""
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        files = sorted(file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
        files = [file for file in files if file.stat().st_size < HOLE]
        if not files:
            return
        file, other = dice.choice(files), dice.choice(files)
        match dice.randrange(10):
            case 0:
                file.unlink()
            case 1:
                file.unlink()
                put_link(file, dice.choice(LINKS))
            case 2:
                file.write_bytes(other.read_bytes())
            case 3:
                name = dice.choice(
                    (file.name.upper(), f"._{file.name}", f"{file.stem}.jpeg", f"{file.name}.png", "Thumbs.db", "é.png")
                )
                file.rename(file.with_name(name))
            case 4:
                file.with_name(
                    dice.choice((f"._{file.name}", ".hidden", "Thumbs.db", f"{file.stem}_mask.png"))
                ).write_bytes(b"\0" * 99)
            case 5:
                with open(file, "r+b") as opened:
                    opened.truncate(dice.choice((0, 1, HOLE)))  # without taking room on the disk
            case _ if file.suffix in (".png", ".jpg", ".exr"):
                _other_picture(dice).save(file.with_suffix(".png"))
            case _ if file.suffix == ".npy":
                np.save(file, np.full(dice.choice(_SHAPES), dice.choice((0.0, 1.0, math.nan, 1e308))))
            case _ if file.suffix == ".json":
                with suppress(ValueError):  # another file's content is in it
                    file.write_text(json.dumps(_other_poses(json.loads(file.read_text()), dice)))
            case _ if file.suffix == ".txt":
                words = re.split(r"(\s+)", file.read_text(errors="replace"))
                numbers = [i for i, word in enumerate(words) if re.fullmatch(r"-?\d.*", word)]
                for i in dice.sample(numbers, min(len(numbers), dice.choice((1, 1, 9)))):
                    words[i] = str(dice.choice(EXTREMES))
                file.write_text("".join(words))
            case _ if file.suffix == ".bin":
                content = bytearray(file.read_bytes())
                at = dice.randrange(max(1, len(content) - 7))
                content[at : at + 8] = struct.pack("<d", dice.choice(EXTREMES))
                file.write_bytes(content)


HOLE = 20 << 30  # bytes of a file that takes no room on the disk: more than is read of any
EXTREMES = (0, -1, 1e-320, 1e-30, 1e30, 1e308, math.nan, math.inf)
_SHAPES = [(), (0,), (0, 0, 3), (3,), (4, 4), (5, 7, 3), (5, 7, 4), (2, 5, 7, 3), (1, 1), (100_000, 1, 3)]


def _other_picture(dice: random.Random) -> Image.Image:
    """Make a picture of another kind or size than the one that is expected."""
    size = dice.choice(((1, 1), (48, 64), (64, 48), (65_535, 1), (7, 5), (640, 480)))
    return Image.new(dice.choice(("1", "L", "LA", "P", "RGB", "RGBA", "I;16")), size, dice.choice((0, 1)))


def _other_poses(value: Any, dice: random.Random) -> Any:
    """Change all numbers, or all poses, in what `json.loads` returns in one way."""
    factor, axes = dice.choice(EXTREMES), dice.sample(range(4), 4)
    way = dice.randrange(5)

    def changed(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: changed(inner) for key, inner in value.items()}
        if (
            isinstance(value, list)
            and len(value) == 4
            and all(isinstance(row, list) and len(row) == 4 for row in value)
        ):
            return _other_pose(np.array(value, float), way, factor, axes).tolist()
        if isinstance(value, list):
            return [changed(inner) for inner in value]
        return value * factor if way == 0 and isinstance(value, float) else value

    return changed(value)


def _other_pose(pose: np.ndarray, way: int, factor: float, axes: list[int]) -> np.ndarray:
    """Change a matrix (4, 4): 1 scales the position, 2 swaps its axes, 3 transposes it, 4 moves it far away, 0 scales all of it."""
    match way:
        case 1:
            pose[:3, 3] *= factor
        case 2:
            pose = pose[:, axes]
        case 3:
            pose = pose.T
        case 4:
            pose[:3, 3] += 5.4e6
        case 0:
            pose = pose * factor
    return pose
