import pytest


def fill(file):
    """Write a file that takes all that is left of its disk."""
    with pytest.raises(OSError), open(file, "wb", buffering=0) as opened:
        while True:
            opened.write(bytes(4096))
