"""Compile the kernels for CUDA cards, and launch them.

The compiler is NVRTC, a library that comes with torch. So users need neither NVIDIA's toolkit nor a C++ compiler. Compiling works without a
card, too.
"""

import ctypes
import functools
import hashlib
import os
import re
import warnings
from pathlib import Path
from typing import Any

import torch

from refgs.kernels.build import HEADERS, HERE, cache_folder, unwritable

# Products and sums fuse as on the CPU. Everything is rounded as IEEE 754 says, except lane.h's reciprocal and exp2.
OPTIONS = (
    "--std=c++17",
    "--device-as-default-execution-space",
    "--extra-device-vectorization",
    "--fmad=true",
    "--diag-suppress=177",
)
# The source of each kernel, by the kernel's name. Sources without KERNEL are for the CPU only.
KERNELS = {
    name: file.name
    for file in sorted(HERE.glob("*.c*"))
    for name in re.findall(r"^KERNEL\((\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
}
SOURCES = tuple(dict.fromkeys(KERNELS.values()))
OLDEST = (7, 5)  # the least compute capability that NVRTC 13 compiles for
BLOCK = 256  # threads of a kernel that works with any number of them
NO_CARD = "no NVIDIA card, or no driver for it, was found"


def unusable() -> str | None:
    """Return why no CUDA card can be used (NO_CARD if there is none), or None."""
    if torch.version.cuda is None:
        return NO_CARD
    with warnings.catch_warnings(record=True) as said:  # torch warns if the driver is too old
        warnings.simplefilter("always")
        available = torch.cuda.is_available()
    if not available:
        return "the card's driver is too old for CUDA 13: a newer one may do" if said else NO_CARD
    if (capability := torch.cuda.get_device_capability()) < OLDEST:
        found, least = (".".join(map(str, version)) for version in (capability, OLDEST))
        return f"{torch.cuda.get_device_name()} is too old: its compute capability is {found}, {least} is the least"
    try:
        for source in SOURCES:  # load all sources now: the card's memory may be full later
            _module(source, torch.cuda.current_device())
    except RuntimeError as error:
        return f"the kernels cannot be loaded ({str(error).splitlines()[0]}): a newer driver may do"
    return None


class CardError(RuntimeError):
    """Report that a CUDA card was lost, or that a kernel failed on it."""


def _check(result: tuple, what: str) -> Any:
    """Return a CUDA call's results without its status, or raise an error about `what`."""
    status, *values = result
    if status.name == "CUDA_ERROR_OUT_OF_MEMORY":
        raise torch.OutOfMemoryError(what)
    if int(status):
        error = CardError if status.name.startswith("CUDA_ERROR") else RuntimeError
        raise error(f"{what}: {status.name}")
    return values[0] if len(values) == 1 else values


def compile_source(source: str, architecture: str) -> bytes:
    """Compile a kernel source file to machine code (cubin) for an architecture such as "sm_86"."""
    import cuda.bindings.nvrtc as nvrtc

    headers = [(HERE / name).read_bytes() for name in HEADERS]
    names = [name.encode() for name in HEADERS]
    text = (HERE / source).read_bytes()
    program = _check(nvrtc.nvrtcCreateProgram(text, source.encode(), len(headers), headers, names), source)
    options = [o.encode() for o in (*OPTIONS, f"--gpu-architecture={architecture}")]
    (status,) = nvrtc.nvrtcCompileProgram(program, len(options), options)
    if int(status):
        log = b" " * _check(nvrtc.nvrtcGetProgramLogSize(program), source)
        _check(nvrtc.nvrtcGetProgramLog(program, log), source)
        raise RuntimeError(f"compiling {source} for {architecture} failed:\n{log.decode(errors='replace')}")
    code = b" " * _check(nvrtc.nvrtcGetCUBINSize(program), source)
    _check(nvrtc.nvrtcGetCUBIN(program, code), source)
    _check(nvrtc.nvrtcDestroyProgram(program), source)
    return code


def cubin(source: str, architecture: str, cache: Path) -> bytes:
    """Return the machine code of a kernel source file from the folder `cache`. If it is not there, compile it first.

    The name of the cached file has a hash of everything that the machine code depends on.
    """
    import cuda.bindings.nvrtc as nvrtc

    parts = [(HERE / name).read_bytes() for name in (source, *HEADERS)]
    digest = hashlib.sha256(repr((OPTIONS, _check(nvrtc.nvrtcVersion(), source), parts)).encode()).hexdigest()[:16]
    file = cache / f"{Path(source).stem}-{digest}-{architecture}.cubin"
    if not file.exists():
        code, temporary = compile_source(source, architecture), file.with_suffix(f".{os.getpid()}")
        try:
            cache.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(code)
            os.replace(temporary, file)
        except OSError as error:
            raise unwritable(cache, error) from None
    return file.read_bytes()


@functools.cache
def _module(source: str, device: int):
    """Load all kernels of a source file on a card, in torch's CUDA context."""
    import cuda.bindings.driver as driver

    major, minor = torch.cuda.get_device_capability(device)
    torch.cuda.set_device(device)
    return _check(driver.cuModuleLoadData(cubin(source, f"sm_{major}{minor}", cache_folder())), source)


@functools.cache
def _function(name: str, device: int):
    import cuda.bindings.driver as driver

    return _check(driver.cuModuleGetFunction(_module(KERNELS[name], device), name.encode()), name)


def launch(name: str, work: ctypes.Structure, device: torch.device, blocks: int, threads: int = BLOCK) -> None:
    """Run the kernel `name` on a CUDA card, in torch's current stream: `blocks` blocks of `threads` threads each.

    `work` holds the kernel's arguments. The tensors that it points at must exist until the kernel is done.
    """
    import cuda.bindings.driver as driver

    # Autograd's own threads have no context until they ask for one, and `torch.cuda.device` asks only if the device changes.
    torch.cuda.set_device(device)
    function, stream = _function(name, torch.cuda.current_device()), torch.cuda.current_stream().cuda_stream
    arguments = (ctypes.c_void_p * 1)(ctypes.addressof(work))
    size = (blocks, 1, 1, threads, 1, 1)
    _check(driver.cuLaunchKernel(function, *size, 0, stream, ctypes.addressof(arguments), 0), name)
