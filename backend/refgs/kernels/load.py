"""Load the kernels for this processor, and run them on torch's threads."""

import ctypes
import functools
import os
import platform
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import platformdirs
import torch

from refgs.errors import InputError
from refgs.kernels.build import build, target

MACHINES = {"AMD64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}


def supported() -> list[str]:
    """The instruction sets this processor has kernels for, best first."""
    if MACHINES.get(platform.machine()) == "aarch64":
        return ["neon"]
    sets = ["avx512", "avx2", "sse4"]
    return sets[{"AVX512": 0, "AVX2": 1}.get(torch.backends.cpu.get_cpu_capability(), 2) :]


def cache_folder() -> Path:
    """Where compiled kernels are kept: the environment variable REFGS_CACHE, else the user's cache."""
    return Path(os.environ.get("REFGS_CACHE") or platformdirs.user_cache_dir("refgs", appauthor=False))


@functools.cache
def _load(isa: str) -> ctypes.CDLL:
    path = build(target(sys.platform, MACHINES[platform.machine()], isa), cache_folder())
    library = ctypes.CDLL(str(path))
    for name in ("refgs_projected_size", "refgs_row_size", "refgs_tiles"):
        getattr(library, name).restype = ctypes.c_int64
    library.refgs_row_size.argtypes = [ctypes.c_int64]
    return library


def kernels() -> ctypes.CDLL:
    """The library for this processor, compiled on first use (seconds). The environment variable REFGS_ISA picks another.

    Raises InputError where this processor can't run it, or its cache can't be written.
    """
    sets = supported()
    isa = os.environ.get("REFGS_ISA") or sets[0]
    if isa not in sets:
        raise InputError(f"REFGS_ISA={isa}: this processor runs {', '.join(sets)}; choose one of them or unset it")
    return _load(isa)


@functools.cache
def _openmp() -> Callable | None:
    """GOMP_parallel of the OpenMP library that torch itself runs on, where it is GNU's.

    Its workers spin for a while after torch's own work: a second pool would have to share the cores with them.
    """
    torch_folder = Path(torch.__file__).parent
    for path in (*torch_folder.glob("lib/libgomp*"), *torch_folder.parent.glob("torch.libs/libgomp*")):
        try:
            call = ctypes.CDLL(str(path), mode=os.RTLD_NOLOAD | os.RTLD_NOW).GOMP_parallel
        except (OSError, AttributeError):
            continue
        call.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint]
        call.restype = None
        return call
    return None


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="refgs-kernels")


def parallel(function: Callable, work: ctypes.Structure) -> None:
    """Call `function(&work)` on torch.get_num_threads() threads at once; they share the work through `work.next`."""
    work.next = 0
    threads = torch.get_num_threads()
    if threads == 1:
        function(ctypes.byref(work))
    elif openmp := _openmp():
        openmp(ctypes.cast(function, ctypes.c_void_p), ctypes.addressof(work), threads, 0)
    else:
        list(_pool(threads).map(lambda _: function(ctypes.byref(work)), range(threads)))
