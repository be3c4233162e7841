import pytest


def fill(file):
    """Write a file until its disk is full."""
    with pytest.raises(OSError), open(file, "wb", buffering=0) as opened:
        while True:
            opened.write(bytes(4096))
