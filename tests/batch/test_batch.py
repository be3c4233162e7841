"""Test batches of small captures with Ray: stopped, resumed, killed, and added to while they run."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest
from filelock import FileLock

from benchmarks.many import MADE
from refgs import commands
from refgs.asked import Asked
from refgs.batch import engine
from refgs.errors import InputError
from refgs.paths import ROOT
from tests.makers import processes
from tests.makers.batches import PATIENCE, batch, ended, until
from tests.makers.training import TINY

pytest.importorskip("ray")
pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self"), reason="needs /proc")
CHANGES = [*TINY, "environment.resolution=16", "train.iterations=1500", "indirect.start=0.9", "indirect.resolution=48"]
CHANGES += ["mesh.resolution=32", "mesh.triangles=500", "mesh.texture=64"]


def rows(out) -> dict[str, dict]:
    """Read the table that a batch writes for other programs. Return its rows by name."""
    return {row["name"]: row for row in json.loads((out / "logs" / "rows.json").read_text())["rows"]}


@pytest.fixture
def shelf(ball_capture, tmp_path):
    """Make two captures, one of which has a broken photo, and a list of them. Return the folder."""
    for name in ("ball", "broken"):
        shutil.copytree(ball_capture, tmp_path / name)
    next((tmp_path / "broken").rglob("*.png")).write_bytes(b"no picture")
    changes = ", ".join(f'"{change}"' for change in CHANGES)
    lines = [f'[[captures]]\nfolder = "{name}"\n' for name in ("ball", "broken")]
    (tmp_path / "list.toml").write_text(f'preset = "quick"\nset = [{changes}]\n' + "".join(lines))
    return tmp_path


def test_stopped_resumed_killed_and_added_to(shelf, ball_capture):
    """Check that each asset is the one of a plain training, bit for bit, whatever happened to the processes that made it."""
    out, training = shelf / "runs", (shelf / "runs" / "ball" / "progress.json")
    stopped = batch(shelf / "list.toml", out)
    until(stopped, training.exists)
    stopped.send_signal(signal.SIGTERM)
    status, said = ended(stopped, grace=120)  # a busy machine takes more than the 25 s after which it ends without Ray
    assert status == 75, said
    assert list((out / "ball" / "checkpoints").glob("*.toml")) and not (out / "ball" / "splats.ply").exists()
    assert "stopped" in (out / "index.html").read_text()
    assert rows(out)["ball"]["state"] == "stopped"

    again = batch(shelf / "list.toml", out)
    [(_, worker)] = until(again, lambda: training.exists() and processes.commands("refgs.cli train", str(out / "ball")))
    os.kill(worker, signal.SIGKILL)
    late = shutil.copytree(ball_capture, shelf / "late")
    for path in [late, *late.rglob("*")]:
        os.utime(path, (1e9, 1e9))
    with open(shelf / "list.toml", "a") as file:
        file.write('[[captures]]\nfolder = "late"\n')
    status, said = ended(again)
    assert status == 2, said
    assert re.search(r"broken: train failed: .*\.png: this is not an image", said), said
    page = (out / "index.html").read_text()
    assert page.count("data:image/jpeg") == 2 and page.count('class="failed"') == 1 and "not an image" in page
    table = rows(out)
    assert {name: row["state"] for name, row in table.items()} == {"ball": "done", "broken": "failed", "late": "done"}
    assert table["ball"]["figures"]["psnr"] > 10 and os.path.isfile(table["ball"]["picture"])
    assert "not an image" in table["broken"]["what"] and os.path.isfile(table["broken"]["log"])
    for name in ("ball", "late"):
        masks = (out / "logs" / name / "masks.log").read_text()
        assert masks.count("$ refgs masks") == 1  # done once, and not again by the batch that went on

    commands.train(Asked(ball_capture, shelf / "plain", "quick", "cpu", changes=tuple(CHANGES)))
    commands.export(shelf / "plain")
    for file in MADE:
        plain = (shelf / "plain" / file).read_bytes()
        assert all((out / name / file).read_bytes() == plain for name in ("ball", "late")), file


def test_a_second_sigterm_ends_a_batch_at_once_with_75(shelf):
    out = shelf / "runs"
    process = batch(shelf / "list.toml", out)
    until(process, (out / "ball" / "progress.json").exists)
    process.send_signal(signal.SIGTERM)
    time.sleep(1)  # the batch waits for its commands now
    process.send_signal(signal.SIGTERM)
    status, said = ended(process, grace=120)  # Ray's own processes take about a minute
    assert status == 75, said


def test_a_batch_whose_process_is_killed_leaves_no_command(shelf):
    """Kill a batch. Check that its commands end: Ray kills them. Ray's own processes end within about a minute."""
    out = shelf / "runs"
    process = batch(shelf / "list.toml", out)
    until(process, (out / "ball" / "progress.json").exists)
    process.kill()
    end = time.monotonic() + PATIENCE
    while processes.commands("refgs.cli", str(out)):
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--address", "127.0.0.1:1"], "no Ray cluster is there \\(.*refused"),
        (["--address", "nobody"], "write it as HOST:PORT"),
        (["--address", "127.0.0.1:6379", "--workers", "2"], "--workers is for this machine"),
        (["--device", "gpu"], "auto, cpu or cuda"),
    ],
)
def test_bad_words_give_one_line_and_leave_nothing(shelf, words, says):
    status, said = ended(batch(shelf / "list.toml", shelf / "runs", *words))
    assert status == 2 and re.search(says, said) and len(said.strip().splitlines()) == 1
    assert not (shelf / "runs").exists()


def test_folders_of_killed_batches_are_removed():
    """Make folders as batches do.

    They are of one that was killed, one that works, one that is about to lock its folder, one that ended badly without a lock in it, and
    one of somebody else's files.
    """
    folders = [Path(tempfile.mkdtemp(prefix=engine.FOLDERS, dir="/tmp")) for _ in range(5)]
    for folder, age in zip(folders, (100, 100, 0, 100, 100), strict=True):
        (folder / {3: engine.RAY, 4: "photo.jpg"}.get(folders.index(folder), engine.LOCKED)).touch()
        os.utime(folder, (time.time() - age, time.time() - age))
    try:
        with FileLock(folders[1] / engine.LOCKED):
            made = engine._make_folder()
        assert [folder.exists() for folder in (*folders, made)] == [False, True, True, False, True, True]
        assert made.stat().st_mode & 0o777 == 0o700
    finally:
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)


def test_another_ray_is_refused(monkeypatch):
    for name in (*engine.ENVIRONMENT, *engine.ALONE, "RAY_AUTH_TOKEN"):  # restored for the processes of other tests
        monkeypatch.setenv(name, "")
    pinned = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["farm"]
    assert pinned == [f"ray=={engine.VERSION}"]
    monkeypatch.setattr(engine, "VERSION", "1.0.0")
    with (
        pytest.raises(InputError, match=r"Ray 2\.60\.0 is installed, and refgs batch needs 1\.0\.0"),
        engine.started(None, 1, 1),
    ):
        pass


LISTENS = "0A"  # the state of a socket in /proc/net/tcp (Linux's include/net/tcp_states.h: TCP_LISTEN)


def listening(session: int) -> set[str]:
    """Return the addresses, in hexadecimal, on which the processes of a session listen, and Ray's that have left it."""
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    known = {f"socket:[{row[9]}]": row[1].partition(":")[0] for row in rows if row[3] == LISTENS}
    found = set()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (process / "cmdline").read_bytes()
            own = int((process / "stat").read_text().rpartition(")")[2].split()[3]) == session
            if own or b"refgs-ray-" in words or words.startswith(b"ray::"):
                found |= {known[link] for file in (process / "fd").iterdir() if (link := os.readlink(file)) in known}
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
def test_a_batch_is_closed_to_other_users_and_to_modules_beside_the_captures(shelf, tmp_path):
    """Check whom Ray listens to, who can open its folder, and that no module of the current folder is imported."""
    for name in ("typer", "filelock", "multiprocessing", "pydantic", "json", "ray"):
        (shelf / f"{name}.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'a').write({name!r})")
    before = set(Path("/tmp").glob(f"{engine.FOLDERS}*"))
    out = shelf / "runs"
    process = batch(shelf / "list.toml", out, cwd=shelf)
    until(process, (out / "ball" / "progress.json").exists)
    addresses = listening(process.pid)
    (folder,) = set(Path("/tmp").glob(f"{engine.FOLDERS}*")) - before
    modes = [path.stat().st_mode & 0o777 for path in (folder, folder / engine.RAY)]
    process.send_signal(signal.SIGTERM)
    status, said = ended(process, grace=120)
    assert status == 75, said
    assert addresses and addresses <= {
        "0100007F",
        "0000000000000000FFFF00000100007F",
        f"{0:024X}01000000",
    }  # 127.0.0.1 and ::1
    assert modes[0] == 0o700 and not folder.exists()
    assert not (tmp_path / "imported").exists()


def test_a_batch_whose_ray_does_not_start_leaves_no_folder(shelf, tmp_path):
    before = set(Path("/tmp").glob(f"{engine.FOLDERS}*"))
    code = f"""
import sys
from refgs.batch import engine
from refgs import cli
import ray
def fail(*_, **how):
    from pathlib import Path
    Path(how["_temp_dir"], "session").mkdir(parents=True, exist_ok=True)
    raise RuntimeError("its parts wait for each other")
ray.init = fail
sys.argv = ["refgs", "batch", {str(shelf / "list.toml")!r}, "--out", {str(shelf / "runs")!r}, "--device", "cpu"]
cli.main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 75, done.stderr
    assert done.stderr.strip() == (
        "refgs: Ray does not start here (its parts wait for each other): wait until the machine is less busy"
    )
    assert set(Path("/tmp").glob(f"{engine.FOLDERS}*")) <= before
