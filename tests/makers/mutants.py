"""Damage files as accidents and attackers do: bytes, values of JSON and TOML, words of text, and links in a file's place."""

import copy
import json
import random
import struct
import tomllib
from pathlib import Path
from typing import Any

import tomli_w

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
LINKS = ("", ".", "nowhere", "/dev/zero", "/dev/null", "/proc/self/mem", "itself")


def put_link(file: Path, to: str) -> None:
    """Put something else in the place of a file: a folder (""), or a link: to its folder, to itself, to nothing or to a device."""
    if to:
        file.symlink_to(file if to == "itself" else to)
    else:
        file.mkdir()
