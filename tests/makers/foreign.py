"""Run the kernels of another platform: Windows' library under Wine, and ARM's under QEMU. Each call is compared with a native one."""

import atexit
import ctypes
import functools
import os
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock

from refgs.kernels import load
from refgs.kernels.build import Target, build, sizes, target
from tests.makers.layouts import fields

RUNNER = Path(__file__).with_name("foreign.c")
ARM_LIBRARIES = Path("/usr/aarch64-linux-gnu")
FOLDER = Path(tempfile.gettempdir()) / "refgs-foreign"
_native = load._load
NATIVE = {"wine": load.supported()[0], "qemu": "sse4"}  # has as many lanes as NEON
# A number of ARM may differ from SSE4's by this part of the largest of its buffer: ARM rounds a product and a sum once, SSE4 twice.
TOLERANCE = 4e-5
KINDS = {torch.float32: np.float32, torch.float64: np.float64}
# D-SSIM is left to the tests against float64: of flat pictures it is a difference of nearly equal squares, and mostly rounding is left.
CANCELLING = ("refgs_ssim_forward", "refgs_ssim_backward")


def why_not(name: str) -> str:
    """Say why the kernels of a platform, "wine" or "qemu", cannot run here. Return "" if they can."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return "runs on Linux on x86-64"
    if name == "wine":
        return "" if shutil.which("wine") else "needs wine64 (Debian's package of that name)"
    known = shutil.which("qemu-aarch64") and ARM_LIBRARIES.is_dir()
    return "" if known else "needs qemu-aarch64 and ARM's C library (Debian's packages qemu-user and libc6-arm64-cross)"


@functools.cache
def _process(name: str) -> subprocess.Popen:
    """Start the program of foreign.c with a platform's library of kernels. It ends with this process."""
    if name == "wine":
        wanted, start = target("win32", "x86_64", NATIVE[name]), ["wine"]
    else:
        wanted, start = target("linux", "aarch64", "neon"), ["qemu-aarch64", "-L", str(ARM_LIBRARIES)]
    FOLDER.mkdir(exist_ok=True)
    with FileLock(FOLDER / f"{name}.lock"):  # another test process may start one at the same time
        library, program = build(wanted, FOLDER), _compiled(name, wanted)
        environment = os.environ | {"WINEPREFIX": str(FOLDER / "wine"), "WINEDEBUG": "-all"}
        words = [*start, str(program), f"Z:{library}" if name == "wine" else str(library)]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        Library(name, process).refgs_tiles(1, 1)  # Wine makes its folder first
    atexit.register(process.kill)
    return process


def _compiled(name: str, wanted: Target) -> Path:
    program = FOLDER / f"{name}-{RUNNER.stat().st_mtime_ns}.exe"
    if not program.exists():
        words = ["-O1", "-target", wanted.platform, str(RUNNER), "-o", str(program)]
        words += [] if name == "wine" else ["-ldl"]
        subprocess.run([sys.executable, "-m", "ziglang", "cc", *words], check=True)
    return program


def pointers(structure: type[ctypes.Structure], at: int = 0) -> Iterator[int]:
    """Yield the places of all pointers in a ctypes structure, in bytes."""
    for name, kind in fields(structure):
        place = at + getattr(structure, name).offset
        count, part = (kind._length_, kind._type_) if issubclass(kind, ctypes.Array) else (1, kind)
        for i in range(count):
            if issubclass(part, ctypes.Structure):
                yield from pointers(part, place + i * ctypes.sizeof(part))
            elif part is ctypes.c_void_p:
                yield place + i * ctypes.sizeof(part)


class Library:
    """Take the place of the native library of kernels: its functions are called in a foreign process, and in the native library, too."""

    def __init__(self, name: str, process: subprocess.Popen):
        self.name, self._process = name, process
        self.known: dict[
            int, tuple[torch.UntypedStorage, torch.dtype]
        ] = {}  # memory that kernels may get, by its address

    def __getattr__(self, function: str):
        return functools.partial(self._integers if function in sizes() else self._call, function)

    def remember(self, tensor: torch.Tensor) -> None:
        """Keep the memory of a tensor whose address kernels may get."""
        storage = tensor.untyped_storage()
        self.known[storage.data_ptr()] = storage, tensor.dtype

    def _integers(self, function: str, *numbers: int) -> int:
        self._send(_name(function) + struct.pack(f"<q{len(numbers)}q", len(numbers), *numbers))
        return struct.unpack("<q", self._receive(8))[0]

    def _call(self, function: str, reference) -> None:
        work = reference._obj
        address, size = ctypes.addressof(work), ctypes.sizeof(work)
        places, bases = [], []
        for at in pointers(type(work)):
            if value := ctypes.c_void_p.from_address(address + at).value:
                base = max((base for base in self.known if base <= value), default=0)
                assert base and value < base + self.known[base][0].nbytes(), f"{function}: unknown memory at {at}"
                if base not in bases:
                    bases.append(base)
                places.append((at, bases.index(base), value - base))
        memory = [(ctypes.c_char * self.known[base][0].nbytes()).from_address(base) for base in bases]
        before, work_before = [bytes(one) for one in memory], ctypes.string_at(address, size)
        self._send(_name(function) + struct.pack("<qq", -1, size) + work_before + struct.pack("<q", len(memory)))
        for content in before:
            self._send(struct.pack("<q", len(content)) + content)
        self._send(struct.pack(f"<q{3 * len(places)}q", len(places), *sum(places, ())))
        work_after = bytearray(self._receive(size))
        after = [self._receive(len(content)) for content in before]
        for at, _, _ in places:
            work_after[at : at + 8] = work_before[at : at + 8]
        getattr(_native(NATIVE[self.name]), function)(reference)  # changes the memory
        self._compare(function, ctypes.string_at(address, size), bytes(work_after), work_before, None)
        for base, content, one, was in zip(bases, after, memory, before, strict=True):
            self._compare(function, bytes(one), content, was, self.known[base][1])
            one[:] = content
        ctypes.memmove(address, bytes(work_after), size)

    def _compare(self, function: str, native: bytes, foreign: bytes, was: bytes, kind: torch.dtype | None) -> None:
        """Check what a foreign call has written into memory that held `was`: Windows' the native bits, ARM's nearly the same numbers."""
        assert self.name == "qemu" or native == foreign, f"{function}: Windows' library has other bits"
        if native == foreign or kind not in KINDS or function in CANCELLING:
            return
        here, there, old = (np.frombuffer(one, KINDS[kind]) for one in (native, foreign, was))
        written = ((here != old) | (there != old)) & np.isfinite(here) & np.isfinite(there)
        here, there = here[written].astype(np.float64), there[written].astype(np.float64)
        error = np.abs(here - there).max(initial=0) / max(np.abs(here).max(initial=0), 1e-30)
        assert error <= TOLERANCE, f"{function}: differs by {error:.1e} of the largest number"

    def _send(self, data: bytes) -> None:
        self._process.stdin.write(data)
        self._process.stdin.flush()

    def _receive(self, count: int) -> bytes:
        data = self._process.stdout.read(count)
        assert len(data) == count, f"the foreign process ended with status {self._process.wait()}"
        return data


def _name(function: str) -> bytes:
    return struct.pack("<q", len(function)) + function.encode()


def use_foreign(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the kernels of a platform, "wine" or "qemu", until the test ends. Skip the test if they cannot run here."""
    if why := why_not(name):
        pytest.skip(why)
    library, data_ptr = Library(name, _process(name)), torch.Tensor.data_ptr

    def remembered(tensor: torch.Tensor) -> int:
        library.remember(tensor)
        return data_ptr(tensor)

    monkeypatch.setenv("REFGS_ISA", NATIVE[name])
    monkeypatch.setattr(load, "CORES", 1)  # threads are started by native code
    monkeypatch.setattr(torch.Tensor, "data_ptr", remembered)
    monkeypatch.setattr(load, "_load", lambda isa: library)
