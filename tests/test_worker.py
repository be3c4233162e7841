"""Test the protocol of commands and events between the add-on and the trainer, with a real worker process."""

import json
import multiprocessing
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from refgs import train_job
from refgs.asked import Asked
from refgs.errors import InputError
from refgs.lock import LOCK, PROGRESS, STOP, RunLock
from tests.makers.captures import nerfstudio
from tests.makers.films import write_video
from tests.makers.forks import Worker
from tests.makers.training import TINY, trained
from tests.makers.unmasked import photograph
from tests.makers.waiting import until

SMALL = [
    "surfels.start=1000",
    "surfels.budget=1000",
    "surfels.hull=48",
    "environment.resolution=16",
    "train.iterations=100000",
    "mesh.resolution=32",
    "mesh.triangles=500",
]
WORKER = [sys.executable, "-m", "refgs.cli", "worker"]
PATIENCE = 120  # seconds


class Talk:
    """Start a worker process, send it commands, and collect the events that it prints."""

    def __init__(self):
        pipe = subprocess.PIPE
        if "forkserver" in multiprocessing.get_all_start_methods():
            self.process = Worker()
        else:
            self.process = subprocess.Popen(WORKER, stdin=pipe, stdout=pipe, text=True, encoding="utf-8")
        self.lines: queue.Queue[str] = queue.Queue()
        self.heard: list[dict] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self.lines.put(line)
        self.lines.put("")

    def tell(self, command: str, **facts) -> None:
        self.process.stdin.write(json.dumps({"command": command} | facts) + "\n")
        self.process.stdin.flush()

    def until(self, event: str) -> dict:
        """Wait for the worker's next event with this name, and return it."""
        while line := self.lines.get(timeout=PATIENCE):
            self.heard.append(json.loads(line))
            if self.heard[-1]["event"] == event:
                return self.heard[-1]
        raise AssertionError(f"it ended before {event}: {self.heard[-3:]}")

    def end(self) -> int:
        """Close the worker's standard input, wait until it ends, and return its exit status."""
        self.process.stdin.close()
        return self.process.wait(timeout=PATIENCE)


@pytest.fixture
def talk():
    talk = Talk()
    yield talk
    talk.process.kill()
    talk.process.wait()


def train(capture, run, *changes) -> dict:
    """Return the fields of the command `train`, with settings for a small training and further `changes`."""
    return {"capture": str(capture), "out": str(run), "preset": "quick", "settings": [*SMALL, *changes]}


@pytest.fixture
def run(talk, ball_capture, tmp_path):
    """Start a training in the worker, and return the folder for its results."""
    talk.tell("train", **train(ball_capture, tmp_path / "run"))
    return tmp_path / "run"


def test_jobs_one_after_another(talk, ball_capture, tmp_path):
    """Check that commands run in order. A wrong command fails in its turn, with one line, and the next command still runs."""
    run = tmp_path / "größe 'a'"
    talk.tell("check", capture=str(ball_capture))
    talk.tell("check", capture=str(ball_capture), out=str(tmp_path / "found"))
    talk.tell("check", capture=str(tmp_path / "nothing"))
    talk.tell("train", **train(ball_capture, run))
    talk.tell("train", capture=str(ball_capture), out=str(run), preset="quick")
    talk.tell("train", capture=str(ball_capture))
    talk.process.stdin.write("no JSON\n")
    talk.tell("export", run=str(run), texture=64)
    ready = talk.until("ready")
    assert ready["protocol"] == 1 and (ready["card"] is None) == bool(ready["no_card"])
    assert any("28" in line for line in talk.until("done")["lines"])
    found = talk.until("done")
    assert Path(found["cameras"]).is_file() and len(found["thumbnails"]) == 12 and found["radius"] > 0
    failed = talk.until("failed")
    assert failed["job"] == "check" and not failed["no_cameras"] and not failed["fault"]
    assert "nothing" in failed["what"] and "\n" not in failed["what"]
    assert talk.until("progress").keys() >= {"iteration", "total", "seconds_left", "loss", "psnr", "splats"}
    talk.tell("stop")
    trained = talk.until("done")
    assert trained["run"] == str(run) and trained["psnr"] > 5
    assert any(part["what"] == "inter-reflection" for part in trained["left_out"])
    assert "holds another run" in talk.until("failed")["what"]
    wrong = [talk.until("failed") for _ in range(2)]
    assert [event["job"] for event in wrong] == ["train", None]
    assert "train.out Field required" in wrong[0]["what"] and "not a command" in wrong[1]["what"]
    assert talk.until("done")["mesh"] == str(run / "mesh.glb") and (run / "mesh.glb").exists()
    talk.tell("pause")
    assert "no job is running" in talk.until("warning")["what"]
    assert talk.end() == 0


def test_messages_that_are_no_commands_fail(talk, tmp_path):
    """Check that each bad line is answered by `failed` with one line, and that the worker then hears the next, and ends with its input."""
    lines = {
        b'{"command": "check", "capture": "caf\xe9"}': (None, "can't decode byte 0xe9"),
        b'{"command": "check", "capture": "caf\\udce9"}': ("check", "caf\\udce9: there is no such folder"),
        b'{"command": "export", "run"': (None, "delimiter"),
        b"[" * 100_000: (None, "recursion"),
        b'{"command": ["train"]}': (None, "command"),
        b'{"command": "pause", "now": 1}': (None, "pause.now"),
        b"null": (None, "not a command of protocol 1"),
        json.dumps({"command": "check", "capture": str(tmp_path / "two\nlines")}).encode(): ("check", "no such folder"),
    }
    for line, (job, says) in lines.items():
        talk.process.stdin.buffer.write(line + b"\n")
        talk.process.stdin.flush()
        failed = talk.until("failed")
        assert failed["job"] == job and not failed["fault"] and says in failed["what"] and "\n" not in failed["what"], (
            failed
        )
    assert talk.end() == 0


def test_a_batch_of_what_is_no_shelf_fails_before_ray_starts(talk, ball_capture, tmp_path):
    talk.tell("batch", captures=str(ball_capture), out=str(tmp_path / "runs"))
    failed = talk.until("failed")
    assert failed["job"] == "batch" and not failed["fault"] and "is a capture itself" in failed["what"]
    assert not (tmp_path / "runs").exists()


def test_a_training_is_paused_looked_at_cancelled_and_resumed(talk, ball_capture, run):
    talk.until("progress")
    talk.tell("pause")
    paused = talk.until("paused")["iteration"]
    time.sleep(0.5)
    assert talk.lines.empty()
    talk.tell("preview")
    shown = talk.until("preview")
    assert shown["iteration"] == paused
    assert Path(shown["view"]).read_bytes()[:4] == b"\x89PNG" and Path(shown["splats"]).read_bytes()[:3] == b"ply"
    talk.tell("resume")
    assert talk.until("resumed")["iteration"] == paused
    assert talk.until("progress")["seconds"] < 60
    talk.tell("cancel")
    cancelled = talk.until("cancelled")
    assert cancelled["iteration"] > paused and not (run / "splats.ply").exists()
    talk.tell("train", capture=str(ball_capture), out=str(run), resume=True)
    assert talk.until("progress")["iteration"] > cancelled["iteration"]
    # After its input is closed, the training is cancelled with a checkpoint, so it can be resumed.
    assert talk.end() == 0
    ended = talk.until("cancelled")
    assert (run / "checkpoints" / f"{ended['iteration']:08d}.toml").exists(), list((run / "checkpoints").iterdir())


def test_a_preview_that_cannot_be_written_does_not_end_the_training(talk, ball_capture, run):
    """Check that one line says so, once. On Windows, a preview that Blender reads cannot be replaced; here a folder is in its way."""
    talk.until("progress")
    (run / "preview" / "view.png").mkdir(parents=True)
    for _ in range(2):
        talk.tell("preview")
    said = talk.until("warning")["what"]
    assert said.startswith(f"{run / 'preview' / 'view.png'}: the preview cannot be written (") and "\n" not in said
    talk.until("progress")
    (run / "preview" / "view.png").rmdir()
    talk.tell("preview")
    assert talk.until("preview")["iteration"] > 0
    assert [event["what"] for event in talk.heard if event["event"] == "warning"] == [said]


def test_a_training_is_cancelled_while_it_makes_masks(talk, tmp_path):
    photograph(tmp_path / "photos")
    talk.tell("train", **train(tmp_path / "photos", tmp_path / "run"))
    assert talk.until("progress")["stage"] == "points"
    talk.tell("cancel")
    ended = talk.until("cancelled")
    assert ended["iteration"] == 0 and ended["run"] == str(tmp_path / "run")
    assert not (tmp_path / "run").exists() and not (tmp_path / "photos" / "masks").exists()
    assert not (tmp_path / "photos" / "masks.tmp").exists()
    # The next job runs.
    talk.tell("check", capture=str(tmp_path / "photos"))
    assert any(line.startswith("Object") for line in talk.until("done")["lines"])


def test_a_mesh_is_made_after_an_export_that_was_killed(talk, ball_capture, tmp_path):
    """Leave textures without a mesh, as a kill does. Check that they do not stop the export, and that a mesh does."""
    run = trained(ball_capture, tmp_path / "run", *TINY, "mesh.resolution=32", total=20).state.folder
    (run / "textures").mkdir()
    for _ in range(2):
        talk.tell("export", run=str(run), texture=64)
    assert talk.until("done")["mesh"] == str(run / "mesh.glb")
    parts = [event["done"] / event["total"] for event in talk.heard if event.get("stage") == "mesh"]
    assert parts[0] == 0 and parts[-1] == 0.91 and sorted(parts) == parts and len(set(parts)) > 5
    assert "mesh.glb exists" in talk.until("failed")["what"]


def test_a_run_is_continued_with_hints(talk, ball_capture, tmp_path):
    run, file, out = (
        trained(ball_capture, tmp_path / "run", *TINY, total=30).state.folder,
        tmp_path / "hints.json",
        tmp_path / "new",
    )
    file.write_text(json.dumps({"hints": [{"kind": "metal", "points": [[0, 0, 1]]}]}))
    told = {"capture": str(ball_capture), "out": str(out), "from": str(run)}
    talk.tell("train", **told)
    talk.tell("train", **told, hints=str(file))
    assert "--from and --hints go together" in talk.until("failed")["what"]
    done = talk.until("done")
    assert done["run"] == str(out) and done["iteration"] == 30
    assert any("hints hold" in event.get("what", "") for event in talk.heard)
    assert talk.end() == 0


def test_photos_without_cameras(talk, tmp_path):
    """Check that photos without cameras are reported.

    The search for their cameras can fail, start again, and be interrupted.
    """
    for number in range(4):
        noise = np.random.default_rng(number).integers(0, 255, (96, 128, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise)
    talk.tell("check", capture=str(tmp_path))
    assert talk.until("failed")["no_cameras"]
    talk.tell("poses", capture=str(tmp_path))
    assert talk.until("progress") == {"event": "progress", "stage": "features", "done": 0, "total": 4}
    failed = talk.until("failed")
    assert failed["job"] == "poses" and "0 of 4 photos" in failed["what"] and not failed["fault"]
    talk.tell("poses", capture=str(tmp_path))
    talk.until("progress")
    talk.end()
    assert not (tmp_path / "sparse").exists()


def write_film(path, seconds):
    """Write a video of a patterned wall that moves to the left, and is blurred from 0.8 to 1.2 seconds."""
    noise = np.random.default_rng(0).normal(0, 30, (96, 1200, 3))
    wall = 128 + sum(size * cv2.GaussianBlur(noise, (0, 0), size) for size in (1, 2, 4, 8, 16))  # detail of all sizes
    wall = np.clip(wall, 0, 255).astype(np.uint8)
    frames = [wall[:, 3 * number : 3 * number + 128] for number in range(30 * seconds)]
    write_video(path, [cv2.blur(frame, (15, 1)) if 24 <= number < 36 else frame for number, frame in enumerate(frames)])


def test_photos_of_a_video(talk, tmp_path):
    """Check that photos are chosen with a running count. An interrupted choice leaves nothing."""
    write_film(tmp_path / "film.mp4", 4)
    talk.tell("frames", video=str(tmp_path / "film.mp4"), out=str(tmp_path / "out"), count=10)
    found = talk.until("done")
    counts = {"frames": 120, "photos": 9, "blurred": 1, "duplicates": 0}
    assert found == {"event": "done", "job": "frames", "capture": str(tmp_path / "out")} | counts
    assert len(list((tmp_path / "out" / "images").iterdir())) == 9
    said = [event for event in talk.heard if event["event"] == "progress"]
    assert said[-1] == {"event": "progress", "stage": "frames", "done": 120, "total": 120, "kept": 8, "blurred": 1}
    talk.tell("frames", video=str(tmp_path / "film.mp4"), out=str(tmp_path / "out"))
    assert "images exists" in talk.until("failed")["what"]
    write_film(tmp_path / "long.mp4", 10)
    talk.tell("frames", video=str(tmp_path / "long.mp4"), out=str(tmp_path / "long"))
    talk.until("progress")
    talk.end()
    assert not (tmp_path / "long").exists()


def test_masks_are_made_and_their_box_is_told(talk, tmp_path):
    """Check that the object's box is in the frame of the masked capture, about its origin, and that `moved` tells of the change."""
    nerfstudio(tmp_path)
    talk.tell("masks", capture=str(tmp_path))
    assert talk.until("region")["region"][0].startswith("region.centre=")
    assert talk.until("progress")["stage"] == "points"
    found = talk.until("done")
    assert found["job"] == "masks" and found["objects"] == 1
    assert found["made"] == len(list((tmp_path / "masks").glob("*.png"))) == 16
    assert [line.split("=")[0] for line in found["region"]] == ["region.centre", "region.size"]
    values = {key: json.loads(value) for key, value in (word.split("=") for word in found["region"])}
    moved = np.array(found["moved"])
    assert not np.allclose(moved, np.eye(4), atol=0.05)
    np.testing.assert_allclose(values["region.centre"], 0, atol=0.15)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals")
@pytest.mark.parametrize("left", [False, True])
def test_a_terminated_training_ends_with_a_checkpoint(talk, run, left):
    """Check that a training whose process gets SIGTERM is cancelled and ends with status 0.

    If `left`, the command `keep` comes first: the training then goes on although its standard input is closed.
    """
    if left:
        talk.tell("keep", on=True)
    talk.until("progress")
    if left:
        talk.process.stdin.close()
    iteration = talk.until("progress")["iteration"]
    talk.process.terminate()
    assert talk.until("cancelled")["iteration"] >= iteration > 0
    assert talk.process.wait(timeout=PATIENCE) == 0


def free(run) -> bool:
    """Return True if no process holds the lock of a training's folder."""
    try:
        with RunLock(run):
            return True
    except InputError:
        return False


def test_a_training_that_is_kept_needs_nobody(ball_capture, tmp_path):
    """Check that after the command `keep` a training runs to its end even if its input and output pipes are closed.

    When the input closes, the training is paused. It resumes by itself, and the export that waits in the queue runs after it.
    """
    run = tmp_path / "run"
    small = train(ball_capture, run, "train.iterations=60")
    commands = [
        {"command": "train"} | small,
        {"command": "export", "run": str(run), "texture": 64},
        {"command": "keep", "on": True},
        {"command": "pause"},
    ]
    with subprocess.Popen(WORKER, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdin.write("\n".join(map(json.dumps, [*commands, ""])).encode())
        process.stdin.flush()
        while json.loads(process.stdout.readline())["event"] != "paused":
            pass
        process.stdin.close()
        process.stdout.close()
        assert process.wait(timeout=PATIENCE) == 0
    assert (run / "splats.ply").exists() and (run / "mesh.glb").exists() and free(run)
    assert not any((run / name).exists() for name in (LOCK, PROGRESS, STOP))


def test_what_waits_goes_with_the_input(talk, run):
    """Close a worker's input right after the command `stop`. Check that the worker writes the surfels, but skips a queued export."""
    talk.tell("export", run=str(run), texture=64)
    talk.until("progress")
    talk.tell("stop")
    assert talk.end() == 0
    assert (run / "splats.ply").exists() and not (run / "mesh.glb").exists()


def test_a_training_that_is_kept_no_longer(talk, run):
    talk.tell("export", run=str(run))
    talk.tell("keep", on=True)
    talk.tell("keep", on=False)
    talk.until("progress")
    assert talk.end() == 0
    assert talk.until("cancelled")["iteration"] > 0 and talk.lines.get(timeout=PATIENCE) == ""
    assert free(run) and any((run / "checkpoints").glob("*.toml"))


def test_a_folder_that_is_trained_in(talk, ball_capture, run):
    """Check that only one process at a time can write a training into a folder. Another can read its progress and stop it.

    After the process is killed, another process can resume the training in this folder.
    """
    until((run / PROGRESS).exists, PATIENCE)
    assert json.loads((run / PROGRESS).read_text()).keys() == {"iteration", "total", "seconds_left"}
    words = (Asked(ball_capture, run, "quick", "cpu", resume=True), lambda event, facts: None, lambda trainer: True)
    with pytest.raises(InputError, match="is in use: another process trains it") as refused:
        train_job.train(*words)
    assert "\n" not in str(refused.value)
    (run / STOP).touch()
    stopped = talk.until("cancelled")["iteration"]
    assert not (run / STOP).exists() and free(run)
    talk.tell("train", capture=str(ball_capture), out=str(run), resume=True)
    talk.until("progress")
    assert not free(run)
    talk.process.kill()
    talk.process.wait(timeout=PATIENCE)
    assert free(run)
    state, _ = train_job.train(*words)
    assert state.iteration >= stopped
