"""Test trainings of captures without masks: masks of the object are made first, once, and only where they can be."""

import json
import time
import tomllib

import numpy as np
import pytest

from refgs import train_job
from refgs.asked import Asked
from refgs.capture import masks, read_capture, silhouettes
from refgs.capture import nerfstudio as nerfstudio_reader
from refgs.capture.check import describe
from refgs.errors import InputError
from refgs.settings import load_settings
from tests.makers.captures import CENTRE, bits, edit, look_at, nerfstudio
from tests.makers.unmasked import COUNT, photograph

FEW = ["train.iterations=40", "image.max_side=64", "surfels.start=400", "surfels.budget=400", "surfels.hull=32"]
FEW += ["indirect.start=1", "needs.views=on"]


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Carve a coarse grid in few rounds, which is enough for balls of 30 pixels."""
    monkeypatch.setattr(silhouettes, "GRID", 24)
    monkeypatch.setattr(silhouettes, "ROUNDS", 3)


def train(capture, out, *changes, resume=False, minutes=None, until=10**9):
    """Train, stop after `until` iterations, and return the state and the events."""
    heard = []
    asked = Asked(capture, out, None if minutes else "quick", "cpu", minutes, (*FEW, *changes))
    state, _ = train_job.train(
        asked.resumed() if resume else asked,
        lambda *event: heard.append(event),
        lambda state: state.iteration >= until,
    )
    return state, heard


def events(heard, name):
    return [facts for event, facts in heard if event == name]


def test_the_object_is_trained_alone_and_a_resumed_training_keeps_its_masks(tmp_path):
    capture, out = tmp_path / "photos", tmp_path / "run"
    photograph(capture)
    state, heard = train(capture, out, until=20)
    (made,) = events(heard, "masks")
    assert made["made"] == COUNT and str(capture / "masks") in made["what"] and "look at them" in made["what"]
    assert {facts["stage"] for facts in events(heard, "progress") if "stage" in facts} == {
        "points",
        "reading",
        "carving",
        "edges",
    }
    assert all(view.alpha is not None for view in state.views) and not state.ended
    facts = tomllib.loads((out / "run.toml").read_text())
    assert facts["changed"]["image.masks"]["became"] == "made" and str(capture) in facts["chosen"]["image.masks"]
    before = {file: file.stat().st_mtime_ns for file in (capture / "masks").iterdir()}
    state, heard = train(capture, out, resume=True)
    assert state.ended and not events(heard, "masks")
    assert {file: file.stat().st_mtime_ns for file in (capture / "masks").iterdir()} == before
    # What was learned is the ball, of radius 0.6: none of the surfels is the ground.
    at = (
        state.surfels().positions.detach().numpy() @ state.capture.to_capture[:3, :3].T
        + state.capture.to_capture[:3, 3]
    )
    assert np.linalg.norm(at - CENTRE, axis=1).max() < 0.9
    # Another training of the capture takes the masks that are there.
    assert not events(train(capture, tmp_path / "other")[1], "masks")


def test_the_capture_is_read_once(tmp_path, monkeypatch):
    photograph(tmp_path / "photos")
    read, real = [], nerfstudio_reader.read_views
    monkeypatch.setattr(nerfstudio_reader, "read_views", lambda *given: read.append(given) or real(*given))
    state, _ = train(tmp_path / "photos", tmp_path / "run", until=1)
    assert len(read) == 1 and state.capture.masked
    anew = read_capture(tmp_path / "photos", state.settings.region)
    assert bits(state.capture) == bits(anew) and state.capture.fingerprint() == anew.fingerprint()


def test_off_learns_all_that_the_photos_show(tmp_path):
    photograph(tmp_path / "photos")
    state, heard = train(tmp_path / "photos", tmp_path / "run", "image.masks=off")
    assert not (tmp_path / "photos" / "masks").exists() and not events(heard, "masks")
    assert all(view.alpha is None for view in state.views)
    assert load_settings("paper").image.masks == "off" and load_settings("quick").image.masks == "auto"


def test_masks_are_made_in_the_box_which_stays_about_the_object(tmp_path):
    capture = tmp_path / "photos"
    photograph(capture, beside=True)
    frame = np.linalg.inv(read_capture(capture).to_capture)
    unit = np.linalg.norm(frame[:3, 0])
    centre, size = (frame[:3, :3] @ CENTRE + frame[:3, 3]).tolist(), [1.1 * unit] * 3
    state, heard = train(capture, tmp_path / "run", f"region.centre={centre}", f"region.size={size}")
    assert events(heard, "masks")[0]["objects"] == 1
    to_capture, box = state.capture.to_capture, state.capture.box
    assert box.moved(np.linalg.inv(np.linalg.inv(to_capture))).centre == pytest.approx(CENTRE, abs=1e-3)
    changed = tomllib.loads((tmp_path / "run" / "run.toml").read_text())["changed"]["region.size"]
    assert changed["asked"] == pytest.approx(size) and changed["became"] == pytest.approx(
        [1.1 / np.linalg.norm(to_capture[:3, 0])] * 3
    )
    # The run's own settings read its capture as it was trained.
    anew = read_capture(capture, train_job.read_run_facts(tmp_path / "run")[1].region)
    assert bits(anew) == bits(state.capture) and anew.fingerprint() == state.capture.fingerprint()


def test_the_time_for_masks_counts(tmp_path, monkeypatch):
    photograph(tmp_path / "photos")
    make, spent = masks.with_masks, 5.0

    def slow(*arguments):
        time.sleep(spent)
        return make(*arguments)

    monkeypatch.setattr(masks, "with_masks", slow)
    begun = time.perf_counter()
    train(tmp_path / "photos", tmp_path / "run", minutes=0.25)
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["total_seconds"] > spent
    assert time.perf_counter() - begun < 3 * 15  # far from a second 15 seconds besides the masks' on a busy machine


def test_without_an_object_all_is_trained(tmp_path):
    capture = tmp_path / "room"
    poses = []
    for k in range(COUNT):  # cameras in a ring that look outwards
        angle = 2 * np.pi * k / COUNT
        away = np.array([np.cos(angle), np.sin(angle), 0.0])
        poses.append(look_at(0.2 * away, 3 * away))
    nerfstudio(capture, poses=poses)
    state, heard = train(capture, tmp_path / "run")
    (warning,) = [facts["what"] for facts in events(heard, "warning") if "masks" in facts["what"]]
    assert "look outwards" in warning and "\n" not in warning
    assert state.ended and not (capture / "masks").exists()
    assert not any(line.startswith("Object") for line in describe(read_capture(capture)))


def test_a_capture_that_cannot_be_written_to(tmp_path):
    capture = tmp_path / "photos"
    photograph(capture)
    capture.chmod(0o555)
    try:
        with pytest.raises(InputError, match=r"read-only.*image\.masks=off"):
            train(capture, tmp_path / "run")
        assert not (tmp_path / "run").exists()
        state, _ = train(capture, tmp_path / "run", "image.masks=off")
    finally:
        capture.chmod(0o755)
    assert state.ended and not (capture / "masks").exists()


def test_masks_by_others_that_are_not_used_stay(tmp_path):
    photograph(tmp_path)
    (tmp_path / "masks").mkdir()
    white = np.full((72, 96), 255, np.uint8)
    from PIL import Image

    for i in range(COUNT):
        Image.fromarray(white).save(tmp_path / "masks" / f"{i:04d}.png")
    before = {file: file.read_bytes() for file in (tmp_path / "masks").iterdir()}
    with pytest.raises(InputError, match=f"all {COUNT} masks are white"):
        masks.make_masks(tmp_path, None, lambda *_: None)
    assert {file: file.read_bytes() for file in (tmp_path / "masks").iterdir()} == before


def test_check_says_where_the_object_is_looked_for(tmp_path):
    photograph(tmp_path)
    (line,) = [line for line in describe(read_capture(tmp_path)) if line.startswith("Object")]
    heard = []
    masks.make_masks(tmp_path, None, lambda *event: heard.append(event))
    assert line.endswith(f"{' '.join(events(heard, 'region')[0]['region'])}, a guess")
    assert not any(line.startswith("Object") for line in describe(read_capture(tmp_path)))
    edit(tmp_path / "transforms.json", lambda data: data["frames"].pop())
    assert not any(line.startswith("Object") for line in describe(read_capture(tmp_path)))
