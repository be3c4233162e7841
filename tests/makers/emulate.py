"""Run the CUDA kernels on the CPU. Their sources are compiled as C++ with emulator.h, which emulates CUDA's language."""

import ctypes
import functools
import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from filelock import FileLock

from refgs.kernels import cuda, load
from refgs.kernels.build import HERE

EMULATOR = Path(__file__).with_name("emulator.h")
FLAGS = ["-shared", "-fPIC", "-O2", "-std=c++20", "-ffp-contract=on", "-fno-sanitize=all", "-Wno-everything"]


@functools.cache
def _library(source: str) -> ctypes.CDLL:
    parts = [(HERE / name).read_bytes() for name in (source, *cuda.HEADERS)] + [EMULATOR.read_bytes()]
    digest = hashlib.sha256(repr(parts).encode()).hexdigest()[:16]
    file = Path(tempfile.gettempdir()) / "refgs-emulated" / f"{Path(source).stem}-{digest}.so"
    file.parent.mkdir(exist_ok=True)
    with FileLock(file.with_suffix(".lock")):  # another test process may compile the same source
        if not file.exists():
            made = file.with_suffix(".part")
            words = ["-include", str(EMULATOR), "-x", "c++", str(HERE / source), "-o", str(made)]
            command = [sys.executable, "-m", "ziglang", "c++", *FLAGS, *words]
            done = subprocess.run(command, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            made.replace(file)
    return ctypes.CDLL(str(file))


def _launch(name: str, work: ctypes.Structure, device, blocks: int, threads: int = cuda.BLOCK) -> None:
    getattr(_library(cuda.KERNELS[name]), name)(ctypes.byref(work), blocks, threads)


def emulate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the emulated CUDA kernels on CPU tensors until the test ends: the program then takes CPU tensors for CUDA tensors."""
    monkeypatch.setattr(load, "on_gpu", lambda tensor: True)
    monkeypatch.setattr(cuda, "launch", _launch)
