import pytest


def fill(file):
    """Write zeros to a file until the disk is full."""
    with pytest.raises(OSError), open(file, "wb", buffering=0) as opened:
        while True:
            opened.write(bytes(4096))
