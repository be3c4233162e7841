"""Train many captures while workers and Ray's head are killed, and while the disk is full. Nothing is lost, and nothing differs."""

import os
import random
import shutil
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.many import MADE
from refgs.errors import TRY_AGAIN
from tests.makers import processes
from tests.makers.batches import batch, ended
from tests.makers.disk import fill

pytest.importorskip("ray")
pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self"), reason="needs /proc")
EVERY = 20.0  # seconds from the kill of a worker to the next
FULL = 20.0  # seconds for which the disk is full after a step has noticed
CHANGES = ["train.iterations=300", "surfels.start=800", "surfels.budget=800"]
CHANGES += ["mesh.resolution=32", "mesh.triangles=500", "mesh.texture=64"]


@pytest.fixture
def shelf(ball_capture, tmp_path):
    """Make REFGS_CHAOS captures, 24 if that is not set, and their list. The last has a broken photo. Return the folder."""
    count = int(os.environ.get("REFGS_CHAOS", "24"))
    lines = []
    for number in range(count):
        capture = shutil.copytree(ball_capture, tmp_path / f"ball{number:02d}")
        lines.append(
            f'[[captures]]\nfolder = "{capture.name}"\nset = ["train.seed={number}"]\n'
        )  # no asset like another
    next(capture.rglob("*.png")).write_bytes(b"no picture")
    changes = ", ".join(f'"{change}"' for change in CHANGES)
    (tmp_path / "list.toml").write_text(f'preset = "quick"\nset = [{changes}]\n' + "".join(lines))
    return tmp_path


class Chaos:
    """Disturb a batch that writes to `out`, and count how. `disk` is the small disk that `out` is on."""

    def __init__(self, disk: Path, out: Path, runs: int):
        self._disk, self._out, self._runs = disk, out, runs
        self._random, self._next, self._free_at = random.Random(0), time.monotonic() + EVERY, None
        self.seen = Counter()

    def disturb(self, session: int) -> None:
        """Kill a random worker if it is time. Fill the disk after a third of the runs, and kill the head after two thirds."""
        found = processes.of_session(session)
        if time.monotonic() > self._next:
            workers = [number for number, line in found.items() if line.startswith("ray::ball") or "--once" in line]
            self._next += EVERY
            if workers:
                self._kill(self._random.choice(workers), "workers killed")
        done = len(list(self._out.glob("*/mesh.glb")))
        if done >= self._runs // 3 and not self.seen["disk full"]:
            self.seen["disk full"] += 1
            fill(self._disk / "filler")
        if self.seen["disk full"] and self._free_at is None and self._noticed():
            self._free_at = time.monotonic() + FULL
        if self._free_at and time.monotonic() > self._free_at:
            (self._disk / "filler").unlink(missing_ok=True)
        heads = [number for number, line in found.items() if "/gcs_server" in line.split(" ")[0]]
        if done >= 2 * self._runs // 3 and not self.seen["heads killed"] and heads:
            self._kill(heads[0], "heads killed")

    def _kill(self, number: int, what: str) -> None:
        os.kill(number, signal.SIGKILL)
        self.seen[what] += 1

    def _noticed(self) -> bool:
        return any("No space left" in log.read_text() for log in (self._out / "logs").glob("*/*.log"))


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_chaos_changes_no_asset(shelf, small_disk, capsys):
    """Kill a random worker every 20 s and the head once, and fill the disk once. Repeat the batch as long as it says "try again".

    Check that each asset is that of an undisturbed batch, bit for bit, and that the capture with a broken photo costs one line.
    """
    begun = time.monotonic()
    status, said = ended(batch(shelf / "list.toml", shelf / "runs", "--workers", "2"), 3600)
    seconds = time.monotonic() - begun
    names = sorted(file.parent.name for file in (shelf / "runs").glob("*/mesh.glb"))
    runs = len(list(shelf.glob("ball*")))
    assert status == 2 and len(names) == runs - 1, said

    subprocess.run(["mount", "-o", "remount,size=1g", str(small_disk)], check=True)
    out, begun, status = small_disk / "runs", time.monotonic(), TRY_AGAIN
    chaos = Chaos(small_disk, out, runs)
    while status == TRY_AGAIN:
        chaos.seen["batches"] += 1
        process = batch(shelf / "list.toml", out, "--workers", "2")
        try:
            while process.poll() is None:
                chaos.disturb(process.pid)
                time.sleep(0.5)
        finally:
            process.kill()
        status, said = ended(process, grace=150)  # without its head, Ray takes a minute and more
    assert status == 2, said
    assert [line for line in said.splitlines() if "failed" in line] == [
        line for line in said.splitlines() if "not an image" in line
    ]
    assert sum("failed" in line for line in said.splitlines()) == 1, said
    differing = [
        f"{name}/{file}"
        for name in names
        for file in MADE
        if (out / name / file).read_bytes() != (shelf / "runs" / name / file).read_bytes()
    ]
    assert not differing
    assert chaos.seen["disk full"] == chaos.seen["heads killed"] == 1 and chaos.seen["workers killed"]
    with capsys.disabled():
        took = f"{time.monotonic() - begun:.0f} s in place of {seconds:.0f}"
        print(f"\n{len(names)} assets of {runs} captures are the same, bit for bit: {dict(chaos.seen)}; {took}")
