"""Load the kernels for this processor, and run them on torch's threads."""

import ctypes
import functools
import os
import platform
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from refgs import CORES
from refgs.errors import InputError
from refgs.kernels import cuda
from refgs.kernels.build import build, cache_folder, sizes, target

MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}  # other names of processors


def _machine() -> str:
    """Return the processor's name, such as "x86_64"."""
    name = platform.machine().lower()
    return MACHINES.get(name, name)


@functools.cache
def supported() -> list[str]:
    """List the instruction sets that the kernels can use on this processor, the best first."""
    if _machine() == "aarch64":
        return ["neon"]
    sets = ["avx512", "avx2", "sse4"]
    return sets[{"AVX512": 0, "AVX2": 1}.get(torch.backends.cpu.get_cpu_capability(), 2) :]


def _keep_memory() -> None:
    """Tell GNU's malloc to keep freed memory, which saves page faults in each iteration."""
    # By default, freed buffers go back to the system, and the next iteration has a page fault for each new page: 4 % of its time for small
    # pictures, half for large ones.
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(-4, 0)  # M_MMAP_MAX: no allocation has a mapping of its own, however large
        libc.mallopt(-8, 1)  # M_ARENA_MAX: threads reuse each other's freed memory
        libc.mallopt(-1, 512 << 20)  # M_TRIM_THRESHOLD


@functools.cache
def _load(isa: str) -> ctypes.CDLL:
    _keep_memory()
    path = build(target(sys.platform, _machine(), isa), cache_folder())
    library = ctypes.CDLL(str(path))
    for name, arguments in sizes().items():
        getattr(library, name).restype = ctypes.c_int64
        getattr(library, name).argtypes = [ctypes.c_int64] * arguments
    return library


def kernels() -> ctypes.CDLL:
    """Load the library of kernels for this processor. The first use compiles it, which takes seconds.

    The environment variable REFGS_ISA picks another instruction set. Raises InputError if this processor can't run that instruction set, or
    the cache can't be written.
    """
    sets = supported()
    isa = os.environ.get("REFGS_ISA") or sets[0]
    if isa not in sets:
        raise InputError(f"REFGS_ISA={isa}: this processor runs {', '.join(sets)}; choose one of them or unset it")
    return _load(isa)


@functools.cache
def _openmp() -> Callable | None:
    """Find GOMP_parallel, which runs kernels on torch's own threads; None without GNU's OpenMP."""
    # Torch's threads keep spinning for a while after torch's work, so other threads would compete with them for the cores.
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


def on_gpu(tensor: torch.Tensor) -> bool:
    """Tell whether a tensor is on a CUDA card, where kernels then run, too."""
    return tensor.device.type == "cuda"


def check(**expected: tuple[torch.Tensor, tuple[int, ...]]) -> None:
    """Check tensors before kernels use them. Each argument is a pair: a tensor, and the shape that it must have.

    All tensors must be float32, on the same device: the CPU or a CUDA card. Raises ValueError if a tensor has another type, shape or
    device.
    """
    home = next(iter(expected.values()))[0].device
    for name, (tensor, shape) in expected.items():
        known = tensor.device == home and home.type in ("cpu", "cuda")
        if tensor.shape != shape or tensor.dtype != torch.float32 or not known:
            found = f"{tensor.dtype} {tuple(tensor.shape)} on {tensor.device}"
            raise ValueError(f"{name}: expected float32 {shape} on {home}, the CPU or a CUDA card; got {found}")


_kept = threading.local()


def borrow(name: str, count: int) -> torch.Tensor:
    """Return a buffer for at least `count` 32-bit numbers. In one thread, calls with the same name return the same memory.

    A buffer is kept for the next call. A larger request replaces it by a larger buffer. Needed sizes change from view to view, so freeing
    and allocating each time would fragment the memory.
    """
    memory = _kept.__dict__.get(name)
    if memory is None or len(memory) < count:
        _kept.__dict__[name] = None  # free the old memory first: both never exist at once
        memory = _kept.__dict__[name] = torch.empty(count + count // 8, dtype=torch.int32)
    return memory


def parallel(function: Callable, work: ctypes.Structure, scratch: int = 0, most: int = CORES) -> None:
    """Run a C++ function on several CPU threads at once. Each thread calls `function(&work)`.

    The number of threads is torch's, but at most the number of cores, and at most `most`. The threads divide the work among them by
    counters in `work.shared`. Each thread has temporary memory for `scratch` floats, at `work.scratch`.
    """
    threads = max(1, min(torch.get_num_threads(), CORES, most))
    if scratch:
        work.scratch = borrow("scratch", threads * scratch).data_ptr()
    work.shared = type(work.shared)()
    if threads == 1:
        function(ctypes.byref(work))
    elif openmp := _openmp():
        openmp(function, ctypes.addressof(work), threads, 0)
    else:
        list(_pool(threads).map(lambda _: function(ctypes.byref(work)), range(threads)))


def run(name: str, work: ctypes.Structure, like: torch.Tensor, items: int, scratch: int = 0) -> None:
    """Run the kernel `name` with the arguments in `work`, on the device of the tensor `like`.

    The work consists of `items` items. On a card, each item has a thread. On the CPU, torch's threads share the items, and each thread has
    temporary memory for `scratch` floats.
    """
    if on_gpu(like):
        cuda.launch(name, work, like.device, max(1, -(-items // cuda.BLOCK)))
    else:
        parallel(getattr(kernels(), name), work, scratch, items)
