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
from refgs.kernels.build import build, cache_folder, target

MACHINES = {"AMD64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}
# Functions that return how large a buffer must be, and how many integers they take.
SIZES = {
    "refgs_tiles": 2,
    "refgs_projected_size": 0,
    "refgs_octagon_size": 0,
    "refgs_row_size": 1,
    "refgs_scratch_size": 1,
    "refgs_ssim_scratch_size": 1,
    "refgs_shade_halo": 0,
    "refgs_peak_round": 0,
}


@functools.cache
def supported() -> list[str]:
    """The instruction sets this processor has kernels for, best first."""
    if MACHINES.get(platform.machine()) == "aarch64":
        return ["neon"]
    sets = ["avx512", "avx2", "sse4"]
    return sets[{"AVX512": 0, "AVX2": 1}.get(torch.backends.cpu.get_cpu_capability(), 2) :]


def _keep_memory() -> None:
    """Have GNU's malloc keep what is freed: by default the buffers of an iteration go back to the system at its end, and the
    next one faults them in again page by page (4 % of the time of a small picture's, half of a large one's)."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(-4, 0)  # M_MMAP_MAX: no allocation is the system's own, however large
        libc.mallopt(-8, 1)  # M_ARENA_MAX: what one thread frees, another may have
        libc.mallopt(-1, 512 << 20)  # M_TRIM_THRESHOLD


@functools.cache
def _load(isa: str) -> ctypes.CDLL:
    _keep_memory()
    path = build(target(sys.platform, MACHINES[platform.machine()], isa), cache_folder())
    library = ctypes.CDLL(str(path))
    for name, arguments in SIZES.items():
        getattr(library, name).restype = ctypes.c_int64
        getattr(library, name).argtypes = [ctypes.c_int64] * arguments
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


def on_gpu(tensor: torch.Tensor) -> bool:
    """Whether kernels that work on this tensor run on a CUDA card."""
    return tensor.device.type == "cuda"


def check(**expected: tuple[torch.Tensor, tuple[int, ...]]) -> None:
    """What a kernel is about to read: raise ValueError unless each tensor is float32, of its shape, and on the first one's
    device, the CPU or a CUDA card."""
    home = next(iter(expected.values()))[0].device
    for name, (tensor, shape) in expected.items():
        known = tensor.device == home and home.type in ("cpu", "cuda")
        if tensor.shape != shape or tensor.dtype != torch.float32 or not known:
            found = f"{tensor.dtype} {tuple(tensor.shape)} on {tensor.device}"
            raise ValueError(f"{name}: expected float32 {shape} on {home}, the CPU or a CUDA card; got {found}")


class Shared(ctypes.Structure):
    """`struct Shared` of library.h."""

    _fields_ = (("next", ctypes.c_int64), ("thread", ctypes.c_int64))


class Work(ctypes.Structure):
    """What a kernel works on: pointers to tensors among its fields."""

    def attach(self, **tensors: torch.Tensor) -> None:
        """Point at tensors, which must be contiguous, and outlive the calls that use them."""
        for name, tensor in tensors.items():
            assert tensor.is_contiguous()
            setattr(self, name, tensor.data_ptr())


_kept = threading.local()


def borrow(name: str, count: int) -> torch.Tensor:
    """Memory for `count` 32-bit numbers, until the same name is asked for again: one that is used in passing, and whose
    size differs from view to view, would leave gaps in malloc's memory each time."""
    memory = _kept.__dict__.get(name)
    if memory is None or len(memory) < count:
        _kept.__dict__[name] = None  # so that both are not there at once
        memory = _kept.__dict__[name] = torch.empty(count + count // 8, dtype=torch.int32)
    return memory


def parallel(function: Callable, work: ctypes.Structure, scratch: int = 0, most: int = CORES) -> None:
    """Call `function(&work)` on as many threads at once as torch has, but at `most` so many, and no more than there are cores.

    They share the work through `work.shared`. Each thread gets `scratch` floats of `work.scratch`.
    """
    threads = max(1, min(torch.get_num_threads(), CORES, most))
    work.scratch = borrow("scratch", threads * scratch).data_ptr() if scratch else None
    work.shared = Shared()
    if threads == 1:
        function(ctypes.byref(work))
    elif openmp := _openmp():
        openmp(ctypes.cast(function, ctypes.c_void_p), ctypes.addressof(work), threads, 0)
    else:
        list(_pool(threads).map(lambda _: function(ctypes.byref(work)), range(threads)))


def run(name: str, work: ctypes.Structure, like: torch.Tensor, items: int, scratch: int = 0) -> None:
    """Run a kernel that shares `items` out where the tensor `like` is: to torch's threads on the CPU, each with `scratch`
    floats of its own, or to a thread an item on a card."""
    if on_gpu(like):
        cuda.launch(name, work, like.device, max(1, -(-items // cuda.BLOCK)))
    else:
        parallel(getattr(kernels(), name), work, scratch, items)
