"""Test that a damaged line of history.jsonl costs that line alone."""

import pytest

from refgs.formats.history import FILE, read

GOOD = b'{"iteration": 10, "seconds": 1.5, "psnr_test": NaN, "parts": {"raster": 1}}'
BAD = {
    "truncated": GOOD[:-5],
    "no text": b"\xff\xfe" + GOOD,
    "zeros": bytes(64),
    "a list": b"[1]",
    "a word in place of a number": b'{"iteration": "ten"}',
    "a table in place of a number": b'{"iteration": {"a": 1}}',
    "a number in place of a table": b'{"parts": 1}',
    "deep": b'{"a":' * 100_000,
    "too many digits": b'{"iteration": 1' + b"0" * 5000 + b"}",
    "half a character": b'{"a": "\\ud800"}',
}


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD.keys())
def test_a_damaged_line_is_counted_and_left_out(tmp_path, bad):
    (tmp_path / FILE).write_bytes(b"\n".join((GOOD, bad, b"", GOOD)) + b"\n")
    lines, damaged = read(tmp_path / FILE)
    assert damaged == 1 and [line["iteration"] for line in lines] == [10, 10] and lines[0]["parts"] == {"raster": 1}
