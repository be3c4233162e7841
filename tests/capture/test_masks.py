"""Tests of making masks: against the true silhouettes of rendered balls, with strokes, boxes, and masks by the artist."""

import json

import numpy as np
import pytest
from PIL import Image

from refgs.capture import masks as making
from refgs.capture import read_capture
from refgs.capture.masks import make_masks, region_settings
from refgs.capture.silhouettes import find_floor
from refgs.errors import InputError
from refgs.settings import load_settings
from tests.makers.captures import CENTRE, ball, edit, nerfstudio, ring, write

SIZE, FOCAL, COUNT = (96, 72), 110.0, 12
ASIDE = CENTRE + np.array([0.0, 1.1, 0.0])
LENS = {"k1": 0.1, "k2": -0.02, "p1": 0.002, "p2": -0.001}


def photograph(folder, beside=False):
    """Write photos of a ball before a mottled blue ground. With `beside`, a second ball lies beside it. Return the true masks."""
    random = np.random.default_rng(0)
    poses, truths = ring(COUNT), []
    nerfstudio(folder, poses=poses)
    for i, pose in enumerate(poses):
        shown = ball(pose, *SIZE, FOCAL)
        if beside:
            other = ball(pose, *SIZE, FOCAL, ASIDE)
            shown = np.where(shown[..., 3:] > 0, shown, other)
        ground = np.array([60, 70, 150]) + random.normal(0, 12, (SIZE[1], SIZE[0], 3))
        photo = np.where(shown[..., 3:] > 0, shown[..., :3] + random.normal(0, 8, ground.shape), ground)
        write(folder / "images" / f"{i:04d}.png", np.clip(photo, 0, 255).astype(np.uint8))
        truths.append(shown[..., 3] > 0)
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1]}
    edit(folder / "transforms.json", lambda data: data.update(intrinsics))
    return truths


def read_masks(folder):
    return [np.asarray(Image.open(folder / "masks" / f"{i:04d}.png")) > 127 for i in range(COUNT)]


def overlap(ours, truths):
    """Return the intersection over union of each mask."""
    return [(a & b).sum() / (a | b).sum() for a, b in zip(ours, truths, strict=True)]


def region(*changes):
    return load_settings("quick", list(changes)).region


def silent(event, facts):
    pass


def test_masks_are_the_silhouettes_and_the_capture_has_them(tmp_path):
    truths = photograph(tmp_path)
    heard = []
    found = make_masks(tmp_path, None, lambda event, facts: heard.append(facts["stage"]))
    assert (found["made"], found["kept"], found["objects"]) == (COUNT, 0, 1)
    assert min(overlap(read_masks(tmp_path), truths)) > 0.9
    assert read_capture(tmp_path).masked
    assert set(heard) == {"reading", "carving", "edges"}
    assert not (tmp_path / "masks.tmp").exists()


def test_masks_fit_the_distorted_photo(tmp_path):
    truths = photograph(tmp_path)
    edit(tmp_path / "transforms.json", lambda data: data.update(LENS))
    # The photo is warped as its lens says, and so is the truth.
    view = read_capture(tmp_path).views[0]
    ideal = view.lens.pinhole(view.camera, "")
    x, y = view.lens.maps(ideal)
    back_x, back_y = view.lens.maps_back(ideal)
    rows, columns = np.mgrid[20:50, 20:70]
    assert (
        np.abs(back_x[np.rint(y).astype(int)[rows, columns], np.rint(x).astype(int)[rows, columns]] - columns).max() < 1
    )
    assert np.abs(back_y[np.rint(y).astype(int)[rows, columns], np.rint(x).astype(int)[rows, columns]] - rows).max() < 1
    make_masks(tmp_path, None, silent)
    # The photos are not distorted, so that masks must come out where the object is in them, whatever the lens is said to be.
    assert min(overlap(read_masks(tmp_path), truths)) > 0.85


def test_box_chooses_the_object_and_two_in_it_are_both_taken(tmp_path):
    photograph(tmp_path, beside=True)
    frame = np.linalg.inv(read_capture(tmp_path).to_capture)
    unit = np.linalg.norm(frame[:3, 0])

    def box(low, high):
        middle, edges = frame[:3, :3] @ ((low + high) / 2) + frame[:3, 3], unit * (high - low)
        return region(f"region.centre={middle.tolist()}", f"region.size={edges.tolist()}")

    warnings = []

    def hear(event, facts):
        warnings.extend([facts["what"]] if event == "warning" else [])

    assert make_masks(tmp_path, box(CENTRE - 0.55, CENTRE + 0.55), hear)["objects"] == 1
    assert not warnings
    one = [mask.sum() for mask in read_masks(tmp_path)]
    # The masks changed the run's frame; without them it is as before.
    for file in (tmp_path / "masks").iterdir():
        file.unlink()
    assert make_masks(tmp_path, box(CENTRE - 0.6, ASIDE + 0.6), hear)["objects"] == 2
    assert warnings == ["2 separate objects are in the box: all of them are in the masks"]
    assert np.mean([mask.sum() for mask in read_masks(tmp_path)]) > 1.3 * np.mean(one)


def test_box_that_no_photo_shows_is_an_error(tmp_path):
    photograph(tmp_path)
    with pytest.raises(InputError, match="no photo shows the region"):
        make_masks(tmp_path, region("region.centre=[0,0,500]", "region.size=[1,1,1]"), silent)
    assert not (tmp_path / "masks").exists()


def test_strokes_win_and_masks_are_remade(tmp_path):
    photograph(tmp_path)
    make_masks(tmp_path, None, silent)
    before = read_masks(tmp_path)
    strokes = np.zeros((2 * SIZE[1], 2 * SIZE[0], 4), np.uint8)  # of another size than the photo
    strokes[60:84, 80:110] = (0, 0, 0, 255)
    strokes[4:24, 4:24] = 255
    write(tmp_path / "strokes" / "0000.png", strokes)
    make_masks(tmp_path, None, silent)
    after = read_masks(tmp_path)
    assert before[0][31:41, 41:54].all() and not after[0][31:41, 41:54].any()
    assert not before[0][3:11, 3:11].any() and after[0][3:11, 3:11].all()


@pytest.mark.parametrize(
    ("strokes", "what"),
    [
        (np.zeros((72, 72, 4), np.uint8), "not the shape of the photo"),
        (np.zeros((72, 96, 3), np.uint8), "no transparency"),
    ],
)
def test_strokes_that_do_not_fit_are_an_error(tmp_path, strokes, what):
    photograph(tmp_path)
    write(tmp_path / "strokes" / "0000.png", strokes)
    with pytest.raises(InputError, match=what):
        make_masks(tmp_path, None, silent)
    assert not (tmp_path / "masks").exists()


def test_the_artists_masks_are_kept(tmp_path):
    truths = photograph(tmp_path)
    make_masks(tmp_path, None, silent)
    mine = np.where(truths[3], 255, 0).astype(np.uint8)
    mine[30:34] = 0
    write(tmp_path / "masks" / "0003.png", mine)
    found = make_masks(tmp_path, None, silent)
    assert (found["made"], found["kept"]) == (COUNT - 1, 1)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "masks" / "0003.png")), mine)
    (tmp_path / "masks" / "made.json").unlink()  # all are taken for the artist's now
    with pytest.raises(InputError, match="not made here"):
        make_masks(tmp_path, None, silent)


def test_interrupted_call_leaves_the_masks_of_before(tmp_path, monkeypatch):
    photograph(tmp_path)
    make_masks(tmp_path, None, silent)
    files = {file: file.read_bytes() for file in (tmp_path / "masks").iterdir()}

    def interrupt(event, facts):
        if facts.get("stage") == "edges" and facts["done"] == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_masks(tmp_path, None, interrupt)
    assert not (tmp_path / "masks.tmp").exists()
    assert {file: file.read_bytes() for file in (tmp_path / "masks").iterdir()} == files
    # A crash between two files must not make the artist's what is ours.
    monkeypatch.setattr(making.os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    monkeypatch.setattr(making, "write_text", lambda file, text: file.write_text(text))
    with pytest.raises(OSError, match="disk full"):
        make_masks(tmp_path, None, silent)
    monkeypatch.undo()
    assert make_masks(tmp_path, None, silent)["made"] == COUNT


def test_region_settings_are_read_as_the_same_box(tmp_path):
    photograph(tmp_path)
    found = make_masks(tmp_path, None, silent)
    box = region(*found["region"])
    # The ball has radius 0.5 of the capture, and the frame is the run's of before the masks.
    for file in (tmp_path / "masks").iterdir():
        file.unlink()
    capture = read_capture(tmp_path, box)
    unit = np.linalg.norm(capture.to_capture[:3, 0])
    assert np.array(box.size) * unit == pytest.approx(1.1, abs=0.25)
    assert capture.to_capture[:3, :3] @ box.centre + capture.to_capture[:3, 3] == pytest.approx(CENTRE, abs=0.1)
    assert region_settings(capture.box) == found["region"]


def test_floor_is_the_plane_below_the_object():
    random = np.random.default_rng(0)
    object_points = random.normal(0, 0.3, (300, 3))
    table = np.column_stack([random.uniform(-2, 2, (300, 2)), random.normal(-1, 0.003, 300)])
    up = np.array([0.0, 0.0, 1.0])
    normal, distance = find_floor(np.vstack([object_points, table]), np.zeros(3), 1.0, up)
    assert normal == pytest.approx(up, abs=0.02) and distance == pytest.approx(-0.97, abs=0.02)
    assert find_floor(object_points, np.zeros(3), 1.0, up) is None


def test_made_masks_are_noted(tmp_path):
    photograph(tmp_path)
    make_masks(tmp_path, None, silent)
    assert len(json.loads((tmp_path / "masks" / "made.json").read_text())) == COUNT
