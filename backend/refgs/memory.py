"""Return memory to the system that has been freed, but that the C library keeps for later."""

import ctypes
import sys


def trim() -> None:
    """Return freed memory to the system. glibc keeps up to gigabytes after tensors of a few megabytes have been freed.

    On other systems, nothing is done.
    """
    if sys.platform == "linux":
        release = getattr(ctypes.CDLL(None), "malloc_trim", None)  # absent in musl
        if release is not None:
            release(0)
