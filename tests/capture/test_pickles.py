"""Test the pickle reader: it reads arrays of all NumPy releases and protocols, and never runs code that a pickle names."""

import os
import pickle
import tracemalloc

import numpy as np
import pytest

from refgs.capture.pickles import read_pair
from refgs.errors import InputError

PAIR = (np.arange(12.0).reshape(3, 4) / 7, np.arange(9, dtype=np.float32).reshape(3, 3))
PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


def refused(file, data: bytes, says: str) -> None:
    file.write_bytes(data)
    with pytest.raises(InputError) as error:
        read_pair(file)
    message = str(error.value)
    assert message.startswith(f"{file}: ") and says in message and "\n" not in message


class _CreatesFile:
    """Create the file `path` as soon as `pickle.load` reads this object, as malicious code could."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch '{self.path}'",)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_nothing_is_run(tmp_path, protocol):
    trace = tmp_path / "trace"
    refused(tmp_path / "0-camera.pkl", pickle.dumps((_CreatesFile(trace), PAIR[1]), protocol), "system")
    assert not trace.exists()


@pytest.mark.parametrize("name", ["numpy load", "numpy.core.multiarray fromfile", "builtins eval", "pickle loads"])
def test_nothing_but_arrays_may_be_named(tmp_path, name):
    module, function = name.encode().split()
    refused(tmp_path / "a.pkl", b"c" + module + b"\n" + function + b"\n(V'x'\ntR.", name.replace(" ", "."))


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(
    "pair", [PAIR, (np.asfortranarray(PAIR[0]), PAIR[1].astype(">f8")), (PAIR[1].astype(int),) * 2]
)
def test_arrays_of_every_protocol_order_and_type_are_read(tmp_path, protocol, pair):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(pair, protocol))
    for read, written in zip(read_pair(tmp_path / "a.pkl"), pair, strict=True):
        assert np.array_equal(read, written) and read.dtype == written.dtype.newbyteorder("=")


@pytest.mark.parametrize("core", [b"numpy.core.", b"numpy._core."])
def test_names_of_both_numpys_are_known(tmp_path, core):
    data = pickle.dumps(PAIR, 2)
    for other in (b"numpy.core.", b"numpy._core."):
        data = data.replace(b"c" + other, b"c" + core)
    (tmp_path / "a.pkl").write_bytes(data)
    assert all(np.array_equal(a, b) for a, b in zip(read_pair(tmp_path / "a.pkl"), PAIR, strict=True))


def test_lists_of_numbers_and_names_are_read(tmp_path):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps((["3", "11"], [np.int64(5), 7])))
    assert read_pair(tmp_path / "a.pkl") == (["3", "11"], [5, 7])


@pytest.mark.parametrize("kept", [0, 0.3, 0.97])
def test_a_pickle_that_is_cut_short(tmp_path, kept):
    data = pickle.dumps(PAIR)
    refused(tmp_path / "a.pkl", data[: int(kept * len(data))], "not a pickle of arrays")


def test_lists_within_lists_are_not_followed(tmp_path):
    """Check that nested lists are refused: a few hundred bytes can describe more items than fit into memory."""
    value = [1] * 10
    for _ in range(30):
        value = [value] * 10
    refused(tmp_path / "a.pkl", pickle.dumps((value, PAIR[1])), "a list of something else")


@pytest.mark.parametrize(
    "data",
    [
        b"Nr\x00\xe1\xf5\x05.",  # LONG_BINPUT: the memo's place 100 million
        b"\x8e" + (1 << 33).to_bytes(8, "little") + b".",  # BINBYTES8: 8 GB of bytes
        b"\x95" + (1 << 33).to_bytes(8, "little") + b".",  # FRAME
        b"\x96" + (1 << 30).to_bytes(8, "little") + b".",  # BYTEARRAY8
    ],
)
def test_a_few_bytes_reserve_little_memory(tmp_path, data):
    tracemalloc.start()
    try:
        refused(tmp_path / "a.pkl", data, "not a pickle of arrays")
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()
