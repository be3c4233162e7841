"""Return freed memory to the system, and say what to lower when memory runs out."""

import ctypes
import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from refgs.errors import InputError

LESS = "close other programs, or ask for less: smaller photos, fewer surfels, smaller textures"


def trim() -> None:
    """Return freed memory to the system. glibc keeps up to gigabytes after tensors of a few megabytes have been freed.

    On other systems, nothing is done.
    """
    if sys.platform == "linux":
        release = getattr(ctypes.CDLL(None), "malloc_trim", None)  # absent in musl
        if release is not None:
            release(0)


def is_shortage(error: BaseException) -> bool:
    """Return True if an error of Python, NumPy, torch or OpenCV says that the main memory is full."""
    said = isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
    return said or any(words in str(error) for words in ("DefaultCPUAllocator", "Insufficient memory"))


@contextmanager
def shortage_named(lower: str = LESS) -> Iterator[None]:
    """Raise InputError if a `with` block runs out of main memory. `lower` is the advice that ends the message."""
    try:
        yield
    except Exception as error:
        if not is_shortage(error):
            raise
        raise InputError(f"memory is full: {lower}") from error
