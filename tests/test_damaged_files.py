"""Damage every kind of file that is read. Reading must succeed, or end in an InputError of one line, and take less than 1 GB.

`tests.makers.readers` lists the files, `tests.makers.mutants` the damage. The slow run reads a million inputs, or as many as the
environment variable REFGS_FUZZ says, and prints how many of each kind it has read and what took longest.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from refgs.paths import ROOT
from tests.makers import fuzz, specials
from tests.makers.readers import READERS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and measured as Linux does")
HANGS = 300  # seconds without an input that is done
VALUES = [name for name, reader in READERS.items() if reader.kind == "json" and reader.share >= 1]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4),
    max_leaves=8,
)


def found_in(folder: Path, count: int, seed: str) -> list[dict]:
    """Read damaged files in processes of their own, another one after each crash or hang. Returns what they have found."""
    at, start = folder / "at", 0
    at.write_text("0")
    lost = []
    while True:
        # Not `-m`: the processes of multiprocessing would import all readers, too, as the main module does.
        program = "from tests.makers.fuzz import run; run()"
        command = [sys.executable, "-c", program, str(folder), str(count), seed, str(start)]
        with subprocess.Popen(command, cwd=ROOT) as process:
            seen, since = "", time.monotonic()
            while process.poll() is None:
                time.sleep(0.2)
                if (now := at.read_text()) != seen:
                    seen, since = now, time.monotonic()
                elif time.monotonic() - since > HANGS:
                    process.kill()
        number = int(at.read_text())
        if number == fuzz.DONE:
            break
        assert number >= start, (folder / "stderr").read_text()[-3000:]  # a fault of the fuzzer itself
        lost.append({"failure": f"ended with status {process.returncode}", **fuzz.describe(count, seed, number)})
        start = number + 1
    return lost + [json.loads(line) for line in (folder / "found.jsonl").read_text().splitlines()]


def failures(found: list[dict]) -> list[dict]:
    return [facts for facts in found if "failure" in facts]


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path):
    found = found_in(tmp_path, 2_000, "a seed")
    assert {facts["reader"] for facts in found if "tries" in facts} == {*READERS}
    assert not failures(found)


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_a_million_damaged_files(tmp_path, capsys):
    count = int(os.environ.get("REFGS_FUZZ", "1000000"))
    found = found_in(tmp_path, count, f"slow {time.time()}")
    with capsys.disabled():
        for facts in found:
            print("\n", facts, end="")
    assert not failures(found)


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Write a valid sample for each of the readers of JSON. Returns their folders by the readers' names."""
    folders = {name: tmp_path_factory.mktemp("sample") for name in VALUES}
    for name, folder in folders.items():
        READERS[name].make(folder)
    return folders


@pytest.mark.parametrize("name", VALUES)
@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(value=JSON, key=st.integers(0, 30))
def test_any_json_is_read_or_refused_in_one_line(samples, name, value, key):
    """Check each reader of JSON with any value as the whole file, and in the place of one of the sample's values."""
    reader, folder = READERS[name], samples[name]
    file = folder / reader.file
    known = json.loads(file.read_bytes())
    sample = file.read_bytes()
    try:
        for data in (value, {**known, [*known][key % len(known)]: value} if isinstance(known, dict) else [value]):
            file.write_text(json.dumps(data))
            assert fuzz.verdict(reader, folder) is None, data
    finally:
        file.write_bytes(sample)


@pytest.mark.timeout(1800)
def test_pipes_devices_and_holes_are_refused_in_one_line(tmp_path):
    """Put what is no ordinary file, and a file with a hole of 30 GB, in the place of every kind of file.

    No reader may wait for a pipe, nor take more than 1 GB.
    """
    files = [name for name, reader in READERS.items() if reader.kind != "folder"]
    names = [name for name in files if name not in specials.READ_BY_THE_TEST]
    command = [sys.executable, "-c", "from tests.makers.specials import run; run()", str(tmp_path), *names]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    found = [json.loads(line) for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    assert len(found) == len(names) * len(specials.KINDS)
    assert [facts for facts in found if facts["said"] or facts["bytes"] > fuzz.MOST] == []
