"""Kill trainings, exports, workers and batches at random moments. Repeated, they end with the same files, and leave nothing.

The slow run kills 1,000 times, or as often as the environment variable REFGS_KILLS says, and prints the table of docs/stability.md.
"""

import os
import random
import shutil
import time
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.stability.cases import line
from refgs.errors import TRY_AGAIN
from tests.makers import processes
from tests.makers.kills import CHANGES, Batch, Command, files, files_of_batch, is_locked, result

pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self"), reason="needs /proc")
SHARES = {"batch": 0.05, "worker": 0.15, "export": 0.3, "train": 0.5}  # of all kills: a batch takes longest
GRACE = 15.0  # seconds for a command to end after its parent: a training writes a checkpoint
RAY = 180.0  # seconds for Ray's own processes to end after a batch was killed
WRONG = ("lost", "differing", "stale locks", "leftovers", "orphans")
CAPTURES = 2  # of a batch


def orphans(session: int, grace: float) -> list[str]:
    """Wait for the processes of a session to end, `grace` seconds at most. Return the command lines of those that do not."""
    end = time.monotonic() + grace
    while (left := processes.of_session(session)) and time.monotonic() < end:
        time.sleep(0.02)
    return list(left.values())


class Train:
    """Repeat `refgs train --once`, as schedulers do."""

    def __init__(self, capture: Path, folder: Path):
        self.capture, self.folder, self.run, self.said = capture, folder, folder / "run", folder / "said.txt"

    def start(self) -> Command | Batch:
        changes = [word for change in CHANGES for word in ("--set", change)]
        how = ["--preset", "quick", "--device", "cpu", *changes, "--once"]
        return Command(self.said, ["train", self.capture, "--out", self.run, *how])

    def clear(self) -> None:
        """Make the folder as it was before the command was started for the first time."""
        shutil.rmtree(self.run, ignore_errors=True)

    def made(self) -> dict[str, object]:
        return result(self.run)

    def locked(self) -> bool:
        return is_locked(self.run)

    def left(self, session: int) -> dict[str, int]:
        """Count what a kill has left: processes that do not end, and whether the run is locked still."""
        return {"orphans": len(orphans(session, GRACE)), "stale locks": self.locked()}


class Export(Train):
    """Repeat `refgs export --once` in a run that was trained before."""

    def clear(self) -> None:
        super().clear()
        if not (self.folder / "trained").exists():
            assert Train.start(self).wait(None) == 0, self.said.read_text()
            self.run.rename(self.folder / "trained")
        shutil.copytree(self.folder / "trained", self.run)

    def start(self) -> Command:
        return Command(self.said, ["export", self.run, "--once"])


class Worker(Train):
    """Start the trainer as Blender does, and tell it to train and to export, as far as that is not done."""

    def start(self) -> Command:
        begun, trained = (self.run / "run.toml").exists(), (self.run / "splats.ply").exists()
        asked = {} if begun else {"preset": "quick", "settings": CHANGES}
        train = {
            "command": "train",
            "capture": str(self.capture),
            "out": str(self.run),
            "device": "cpu",
            "resume": begun,
        }
        export = {"command": "export", "run": str(self.run)}
        jobs = (*(() if trained else (train | asked,)), *(() if (self.run / "mesh.glb").exists() else (export,)))
        return Command(self.said, ["worker"], jobs or ({"command": "check", "capture": str(self.capture)},))


class Batches(Train):
    """Repeat `refgs batch`."""

    def __init__(self, capture: Path, folder: Path):
        super().__init__(capture, folder)
        changes = ", ".join(f'"{change}"' for change in CHANGES)
        lines = [f'[[captures]]\nfolder = "{n}"\nset = ["train.seed={n}"]\n' for n in range(CAPTURES)]
        for number in range(CAPTURES):
            shutil.copytree(capture, folder / str(number))
        (folder / "list.toml").write_text(f'preset = "quick"\nset = [{changes}]\n' + "".join(lines))

    def start(self) -> Batch:
        return Batch(self.folder / "list.toml", self.run)

    def made(self) -> dict[str, object]:
        captures = {
            f"{n} {name}": value for n in range(CAPTURES) for name, value in files(self.folder / str(n)).items()
        }
        return captures | files_of_batch(self.run)

    def locked(self) -> bool:
        return any(is_locked(file.parent) for file in self.run.rglob("run.lock"))

    def left(self, session: int) -> dict[str, int]:
        """Count nothing yet. The same command is given at once, while commands and Ray's own processes still end."""
        return {}


VICTIMS = {"train": Train, "export": Export, "worker": Worker, "batch": Batches}


def kill(victim: Train, kills: int, moments: random.Random) -> tuple[Counter, list[str]]:
    """Start a command, and kill it at a random moment between its start and its end, until it was killed `kills` times.

    Start it again after each kill. Where it has ended, compare its files with those of an undisturbed one, and begin anew. Return how often
    it was killed, how often it ended, and what was wrong; and the files that differed, were missing, or too many.
    """
    found, sessions, whole, longest, names, ended = Counter(), [], None, None, [], False
    victim.clear()
    while found["kills"] < kills or not ended:
        process, begun = victim.start(), time.monotonic()
        status = process.wait(moments.uniform(0, longest) if whole and found["kills"] < kills else None)
        ended = whole is not None and status not in (None, TRY_AGAIN)
        if status is None:
            found["kills"] += 1
            found["of the parent"] += process.kill(moments) == "parent"
            sessions.append(process.session)
            found.update(victim.left(process.session))
            continue
        if status == TRY_AGAIN:  # what was killed still works in the run, or keeps the machine too busy
            continue
        if whole is None:
            assert status == 0, victim.said.read_text()
            whole, longest = victim.made(), time.monotonic() - begun
            victim.clear()
            continue
        made = victim.made()
        found["ended"] += 1
        found["lost"] += status != 0 or not whole.keys() <= made.keys()
        found["differing"] += any(made[name] != whole[name] for name in whole.keys() & made.keys())
        found["leftovers"] += len(made.keys() - whole.keys())
        found["stale locks"] += victim.locked()
        names += [name for name in {*made, *whole} if made.get(name, 0) != whole.get(name, 0)]
        victim.clear()
    found["orphans"] += sum(len(orphans(session, RAY)) for session in sessions)
    found["seconds"] = round(longest)
    return found, names


def table_row(name: str, found: Counter) -> str:
    return line([name, *(str(found[what]) for what in ("kills", "of the parent", "ended", *WRONG))])


@pytest.mark.parametrize(("name", "kills"), [("train", 3), ("export", 2), ("worker", 2)])
def test_killed_it_ends_the_same(ball_capture, tmp_path, name, kills):
    found, names = kill(VICTIMS[name](ball_capture, tmp_path), kills, random.Random())
    assert found["ended"] and not any(found[what] for what in WRONG), (found, names)


@pytest.mark.slow
@pytest.mark.timeout(0)
def test_a_thousand_kills(ball_capture, tmp_path, capsys):
    pytest.importorskip("ray")
    total, rows = int(os.environ.get("REFGS_KILLS", "1000")), []
    for name, share in SHARES.items():
        (tmp_path / name).mkdir()
        begun = time.monotonic()
        victim = VICTIMS[name](ball_capture, tmp_path / name)
        found, names = kill(victim, max(1, round(share * total)), random.Random())
        rows.append((name, found))
        with capsys.disabled():
            took = f"{time.monotonic() - begun:.0f} s, undisturbed {found['seconds']} s"
            print(f"\n{table_row(name, found)} {took} {' '.join(names)}", flush=True)
    headings = ["command", "kills", "of them its parent", "ended", *WRONG]
    with capsys.disabled():
        print("\n" + "\n".join([line(headings), line(["---"] * len(headings)), *(table_row(*row) for row in rows)]))
    assert not any(found[what] for _, found in rows for what in WRONG)
