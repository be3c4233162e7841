"""Return freed memory to the system, and say what to lower when memory runs out."""

import ctypes
import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from refgs.errors import TryAgain

# Words of torch, OpenCV, C++, the loader of libraries, the system, Python's threads.
_SHORTAGES = ("DefaultCPUAllocator", "Insufficient memory", "std::bad_alloc", "failed to map segment")
_SHORTAGES += ("annot allocate memory", "can't start new thread")
LEAST = 4e9  # bytes that a process must be able to reserve: torch's libraries for CUDA alone take 3.4e9
LESS = "close other programs, or ask for less: smaller photos, fewer surfels, smaller textures"


def trim() -> None:
    """Return freed memory to the system, on Linux only."""
    # When thousands of tensors have been freed, glibc may still keep gigabytes for later.
    if sys.platform == "linux":
        release = getattr(ctypes.CDLL(None), "malloc_trim", None)  # absent in musl
        if release is not None:
            release(0)


def is_shortage(error: BaseException) -> bool:
    """Return True if an error says that the main memory is full."""
    said = isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
    return said or any(words in str(error) for words in _SHORTAGES)


@contextmanager
def shortage_named(lower: str = LESS) -> Iterator[None]:
    """Raise TryAgain, ending with the advice `lower`, if a `with` block exhausts memory."""
    try:
        yield
    except Exception as error:
        if not is_shortage(error):
            raise
        limit = f", or raise the limit of {_limit() / 1e9:.1f} GB (ulimit -v)" if _limit() >= 0 else ""
        raise TryAgain(f"memory is full: {lower}{limit}") from error


def check_limit() -> None:
    """Raise TryAgain if `ulimit -v` leaves this process less than LEAST bytes of memory."""
    if 0 <= (limit := _limit()) < LEAST:
        least = f"{LEAST / 1e9:.0f} GB, most of it for libraries"
        raise TryAgain(
            f"the memory of this process is limited to {limit / 1e9:.1f} GB (ulimit -v): allow at least {least}"
        )


def _limit() -> int:
    """Return the bytes that this process may reserve, -1 if there is no limit."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return -1
    return resource.getrlimit(resource.RLIMIT_AS)[0]
