"""Tests of making masks: against the true silhouettes of rendered balls and of a ring, with strokes, boxes, and masks by the artist."""

import hashlib
import json
import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from refgs import commands
from refgs.camera import Camera
from refgs.capture import load_view, read_capture, silhouettes, to_run_frame
from refgs.capture import masks as making
from refgs.capture.backdrop import HIDDEN, Backdrop, Plane, find_plane
from refgs.capture.check import describe
from refgs.capture.images import read_image
from refgs.capture.masks import make_masks, region_settings
from refgs.errors import InputError
from refgs.geometry.project import project
from refgs.settings import load_settings
from tests.makers.captures import (
    CENTRE,
    ball,
    ball_normals,
    bits,
    colmap,
    edit,
    look_at,
    move_photos,
    nerf_blender,
    nerfstudio,
    nero,
    ring,
    tensoir,
    write,
    write_as_phone,
)
from tests.makers.unmasked import ASIDE, COUNT, FOCAL, SIZE, colored, overlap, photograph, read_masks

LENS = {"k1": 0.1, "k2": -0.02, "p1": 0.002, "p2": -0.001}


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Carve a coarse grid in few rounds, which is enough for balls of 30 pixels."""
    monkeypatch.setattr(silhouettes, "GRID", 24)
    monkeypatch.setattr(silhouettes, "ROUNDS", 3)


@pytest.fixture(autouse=True)
def compared(monkeypatch):
    """Compare each capture that gets masks with the same capture when it is read anew: bit for bit."""
    real = making.with_masks

    def with_masks(*arguments):
        files, found = real(*arguments)
        assert bits(to_run_frame(files)) == bits(read_capture(files.folder))
        return files, found

    monkeypatch.setattr(making, "with_masks", with_masks)


def washer(pose, width, height, focal):
    """Render a flat red ring about CENTRE as RGBA, by steps along each ray."""
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([u / focal, -v / focal, -np.ones_like(u)], axis=-1) @ pose[:3, :3].T
    hit = np.zeros(u.shape, bool)
    for depth in np.linspace(2.2, 3.8, 81):
        x, y, z = np.moveaxis(pose[:3, 3] + depth * rays - CENTRE, -1, 0)
        hit |= (np.abs(z) < 0.08) & (np.hypot(x, y) < 0.65) & (np.hypot(x, y) > 0.35)
    return np.where(hit[..., None], np.uint8([220, 0, 0, 255]), np.uint8(0))


VIEWS = [(np.cos(a), np.sin(a), (0.6, 1.3)[i % 2]) for i, a in enumerate(np.arange(14) * 2 * np.pi / 14)]


def mottled(pose):
    """Render a ball on a floor, both mottled alike in the same colours. Return the photo (H, W, 3) and the ball's mask."""
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2, np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2)
    rays = np.stack([u / FOCAL, -v / FOCAL, -np.ones_like(u)], axis=-1) @ pose[:3, :3].T
    normals = ball_normals(pose, *SIZE, FOCAL)
    mask = ~np.isnan(normals[..., 0])
    depth = (CENTRE[2] - 0.5 - pose[2, 3]) / np.minimum(rays[..., 2], -1e-3)
    point = np.where(mask[..., None], 7 + 0.5 * normals, pose[:3, 3] + depth[..., None] * rays)
    waves = np.random.default_rng(1).normal(size=(2, 10, 3)) * [[[7.0]], [[14.0]]]
    tone = sum(np.sin(point @ wave + 2 * i) for i, wave in enumerate(waves.reshape(-1, 3))) / np.sqrt(20)
    colors = np.array([[60, 40, 30], [150, 110, 80], [210, 190, 160]])
    return np.stack([np.interp(tone, [-1, 0, 1], colors[:, c]) for c in range(3)], axis=-1), mask


def region(*changes):
    return load_settings("quick", list(changes)).region


def silent(event, facts):
    pass


def test_masks_are_the_silhouettes_and_the_capture_has_them(tmp_path):
    truths = photograph(tmp_path)
    heard = []
    found = make_masks(tmp_path, None, lambda event, facts: heard.append(facts.get("stage", event)))
    assert (found["made"], found["kept"], found["objects"]) == (COUNT, 0, 1)
    assert min(overlap(read_masks(tmp_path), truths)) > 0.9
    assert read_capture(tmp_path).masked
    assert found["masks"] == {f"images/{i:04d}.png": f"masks/{i:04d}.png" for i in range(COUNT)}
    assert set(heard) == {"region", "points", "reading", "carving", "edges"}
    assert not (tmp_path / "masks.tmp").exists()


def test_masks_of_photos_with_16_bits(tmp_path):
    truths = photograph(tmp_path)
    for path in (tmp_path / "images").iterdir():
        write(path, read_image(path)[0].astype(np.uint16) * 257)
    make_masks(tmp_path, None, silent)
    assert min(overlap(read_masks(tmp_path), truths)) > 0.9


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


def test_box_chooses_the_object_and_two_in_it_are_both_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(silhouettes, "GRID", 44)  # a voxel must fit between the balls
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


@pytest.mark.parametrize(("value", "what"), [(255, "white"), (0, "empty")])
def test_masks_that_say_nothing_are_refused_until_they_are_deleted(tmp_path, value, what):
    photograph(tmp_path)
    for i in range(COUNT):
        write(tmp_path / "masks" / f"{i:04d}.png", np.full(SIZE[::-1], value, np.uint8))
    with pytest.raises(InputError, match=f"masks: all {COUNT} masks are {what}.*0000.png too"):
        make_masks(tmp_path, None, silent)
    for file in (tmp_path / "masks").iterdir():
        assert (read_image(file)[0] == value).all()
        file.unlink()
    assert make_masks(tmp_path, None, silent)["made"] == COUNT


def test_photos_with_opaque_alpha_get_masks(tmp_path):
    truths = photograph(tmp_path)
    for file in (tmp_path / "images").iterdir():
        write(file, np.dstack([read_image(file)[0], np.full(SIZE[::-1], 255, np.uint8)]))
    make_masks(tmp_path, None, silent)
    assert min(overlap(read_masks(tmp_path), truths)) > 0.9
    assert read_capture(tmp_path).masked


def test_photos_of_one_name_in_two_folders_get_masks_of_their_own(tmp_path):
    folder = nerfstudio(tmp_path)
    move_photos(folder, lambda i: f"cam{1 + i % 2}/{i // 2:04d}.png")
    views = read_capture(folder).views
    targets = making._targets(folder, views)
    assert [targets[view] for view in views] == [folder / "masks" / v.image_path.relative_to(folder) for v in views]
    for i, target in enumerate(targets.values()):
        write(target, np.tri(48, 64, i, dtype=np.uint8) * 255)
    assert [view.mask_path for view in read_capture(folder).views] == list(targets.values())


@pytest.mark.parametrize("layout", [nerf_blender, tensoir, nero])
def test_opaque_photos_of_a_layout_with_masks_of_its_own_get_masks(tmp_path, layout):
    """Check layouts whose masks are usually the photos' alpha channels or depth maps, in photos that have neither."""
    folder = layout(tmp_path / "scene")
    random, truths = np.random.default_rng(0), {}
    for view in read_capture(folder).views:
        image, alpha = load_view(view).bytes, load_view(view).alpha
        write(view.image_path, colored(np.dstack([image, alpha]), random))
        truths[view.image_path] = alpha > 127
    for depth in folder.glob("*-depth.png"):
        depth.unlink()
    assert any("looks for it" in line or "look for it" in line for line in describe(read_capture(folder)))
    make_masks(folder, None, silent)
    again = read_capture(folder)
    assert len({view.mask_path for view in again.views}) == len(truths) and again.masked
    masks = [read_image(view.mask_path)[0][..., 0] > 127 for view in again.views]
    assert min(overlap(masks, [truths[view.image_path] for view in again.views])) > 0.85


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
    with monkeypatch.context() as patch, pytest.raises(OSError, match="disk full"):
        patch.setattr(making.os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
        patch.setattr(making, "write_text", lambda file, text: file.write_text(text))
        make_masks(tmp_path, None, silent)
    assert make_masks(tmp_path, None, silent)["made"] == COUNT


def test_box_is_in_the_frame_of_the_capture_with_its_masks(tmp_path):
    photograph(tmp_path)
    heard = []
    found = make_masks(tmp_path, None, lambda event, facts: heard.append((event, facts)))
    capture = read_capture(tmp_path, region(*found["region"]))
    unit = np.linalg.norm(capture.to_capture[:3, 0])
    to_capture = capture.box.moved(capture.to_capture)
    assert to_capture.centre == pytest.approx(CENTRE, abs=0.1)
    assert 2 * np.linalg.norm(to_capture.matrix[:3, :3], axis=0) == pytest.approx(1.1, abs=0.25)
    assert unit == pytest.approx(0.5, abs=0.15) and region_settings(capture.box) == found["region"]
    # The guess comes before anything is read, and contains the ball.
    event, facts = heard[0]
    assert event == "region" and " ".join(facts["region"]) in facts["what"]
    for file in (tmp_path / "masks").iterdir():
        file.unlink()
    capture = read_capture(tmp_path, region(*facts["region"]))
    assert capture.box.moved(capture.to_capture).contains(CENTRE + 0.5 * np.vstack([np.eye(3), -np.eye(3)])).all()


def test_plane_is_the_floor_below_the_object_or_the_wall_behind_it():
    random = np.random.default_rng(0)
    object_points = random.normal(0, 0.3, (300, 3))
    table = np.column_stack([random.uniform(-2, 2, (300, 2)), random.normal(-1, 0.003, 300)])
    up = np.array([0.0, 0.0, 1.0])
    above = np.array([[3.0, 0.0, 2.0], [-3.0, 0.0, 2.0]])
    plane = find_plane(np.vstack([object_points, table]), np.zeros(3), 1.0, up, above)
    assert plane.normal == pytest.approx(up, abs=0.02) and plane.distance == pytest.approx(-1, abs=0.02)
    assert find_plane(object_points, np.zeros(3), 1.0, up, above) is None
    # The same plane is a wall if the world's up direction is along it, and none if a camera stands behind it.
    side, wall = np.array([1.0, 0.0, 0.0]), np.vstack([object_points, table])
    assert find_plane(wall, np.zeros(3), 1.0, side, above).normal == pytest.approx(up, abs=0.02)
    assert find_plane(wall, np.zeros(3), 1.0, side, np.vstack([above, [[3.0, 0.0, -2.0]]])) is None


def test_object_of_the_floors_colours_is_told_from_it(tmp_path):
    poses = [look_at(CENTRE + 3 * np.array(x) / np.linalg.norm(x), CENTRE) for x in VIEWS]
    shown = [mottled(pose) for pose in poses]
    nerfstudio(tmp_path, poses=poses)
    random = np.random.default_rng(0)
    for i, (photo, _) in enumerate(shown):
        exposed = photo * random.uniform(0.8, 1.1) + random.normal(0, 2, photo.shape)
        write(tmp_path / "images" / f"{i:04d}.png", exposed.clip(0, 255).astype(np.uint8))
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1]}
    edit(tmp_path / "transforms.json", lambda data: data.update(intrinsics))
    make_masks(tmp_path, None, silent)
    assert np.mean(overlap(read_masks(tmp_path, len(VIEWS)), [mask for _, mask in shown])) > 0.8


def test_covered_floor_counts_for_the_object_only_where_photos_disagree():
    poses = [look_at(CENTRE + 3 * np.array(x) / np.linalg.norm(x), CENTRE) for x in VIEWS]
    shown = [mottled(pose) for pose in poses]
    floor, aside = CENTRE + np.array([[0, 0, -0.5], [0.9, 0, -0.5]])
    backdrop = Backdrop(Plane(np.array([0.0, 0.0, 1.0]), floor[2]), CENTRE, 1.0)
    cameras, hidden = [], []
    for pose, (_, mask) in zip(poses, shown, strict=True):
        world_to_camera = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
        camera = Camera("", *SIZE, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, world_to_camera)
        (u, v), _ = (x[0] for x in project(camera, aside[None]))
        columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
        cameras.append(camera)
        hidden.append(cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) > 0)
        hidden[-1] |= np.hypot(columns + 0.5 - u, rows + 0.5 - v) < 12
    backdrop.learn([photo.astype(np.uint8) for photo, _ in shown], cameras, hidden)

    def odds(point):
        """Return the odds of object to plane at the texels close to a point of the floor."""
        column, row = np.linalg.lstsq(backdrop.to_world[:3, :2], point - backdrop.to_world[:3, 2], rcond=None)[
            0
        ].astype(int)
        return backdrop.odds[row - 3 : row + 4, column - 3 : column + 4]

    assert np.mean(odds(floor) == HIDDEN) > 0.8
    assert np.mean(np.isnan(odds(aside))) > 0.8


def test_made_masks_are_noted(tmp_path):
    truths = photograph(tmp_path)
    make_masks(tmp_path, None, silent)
    files = (tmp_path / "masks").glob("*.png")
    noted = json.loads((tmp_path / "masks" / "made.json").read_text())
    assert {hashlib.sha256(file.read_bytes()).hexdigest() for file in files} == set(noted)

    def said() -> str:
        (line,) = [line for line in describe(read_capture(tmp_path)) if line.startswith("Masks")]
        return line.partition(", covering")[0]

    assert said() == f"Masks: {COUNT} views (made by RefGS)"
    write(tmp_path / "masks" / "0003.png", np.where(truths[3], 255, 0).astype(np.uint8))
    assert said() == f"Masks: {COUNT} views (made by RefGS: {COUNT - 1}, mask files: 1)"
    (tmp_path / "masks" / "made.json").unlink()
    assert said() == f"Masks: {COUNT} views (mask files)"


def test_a_ring_is_seen_through_and_highlights_are_not(tmp_path):
    away = [(np.cos(a), np.sin(a), t) for t in (0.6, 2.0) for a in np.arange(8) * np.pi / 4]
    truths = photograph(
        tmp_path, poses=[look_at(CENTRE + 3 * np.array(x) / np.linalg.norm(x), CENTRE) for x in away], show=washer
    )
    make_masks(tmp_path, None, silent)
    for truth, mask in zip(truths[8:], read_masks(tmp_path, 16)[8:], strict=True):
        assert (truth & mask).sum() / (truth | mask).sum() > 0.75 and not mask[34:38, 46:50].any()

    photograph(tmp_path / "ball")
    photo = tmp_path / "ball" / "images" / "0000.png"
    pixels = np.asarray(Image.open(photo)).copy()
    pixels[30:40, 42:52] = pixels[:10, :10]
    write(photo, pixels)
    make_masks(tmp_path / "ball", None, silent)
    assert read_masks(tmp_path / "ball")[0][30:40, 42:52].all()


def test_masks_of_a_phones_photos_are_upright(tmp_path):
    truths = photograph(tmp_path)
    for photo in sorted((tmp_path / "images").iterdir()):
        write_as_phone(photo.with_suffix(".jpg"), np.asarray(Image.open(photo)), turns=1)
        photo.unlink()
    edit(
        tmp_path / "transforms.json",
        lambda data: [f.update(file_path=f["file_path"].replace("png", "jpg")) for f in data["frames"]],
    )
    make_masks(tmp_path, None, silent)
    assert min(overlap(read_masks(tmp_path), truths)) > 0.85


def test_points_of_colmap_tell_the_table_from_what_stands_on_it(tmp_path):
    random = np.random.default_rng(0)
    colmap(tmp_path)
    truths = []
    for i, pose in enumerate(ring(16)):
        shown = ball(pose, 64, 48, 60.0)
        truths.append(shown[..., 3] > 0)
        # A mat of the ball's lower colour lies under it.
        u, v = np.meshgrid(np.arange(64) + 0.5 - 32, np.arange(48) + 0.5 - 24)
        rays = np.stack([u / 60, -v / 60, -np.ones_like(u)], axis=-1) @ pose[:3, :3].T
        depth = (CENTRE[2] - 0.5 - pose[2, 3]) / np.where(rays[..., 2] < 0, rays[..., 2], np.nan)
        mat = np.linalg.norm((pose[:3, 3] + depth[..., None] * rays - CENTRE)[..., :2], axis=-1) < 0.7
        shown[mat & ~truths[-1]] = (20, 200, 0, 255)
        write(tmp_path / "images" / f"{i:04d}.png", colored(shown, random))
    on_ball = random.normal(size=(200, 3))
    on_ball = CENTRE + 0.5 * on_ball / np.linalg.norm(on_ball, axis=1, keepdims=True)
    on_table = CENTRE + np.column_stack([random.uniform(-2.5, 2.5, (300, 2)), np.full(300, -0.5)])
    points = np.vstack([on_ball, on_table])
    data = struct.pack("<Q", len(points))
    for i, point in enumerate(points):
        data += struct.pack("<Q3d3BdQ", i, *point, 255, 128, 0, 0.5, 2) + struct.pack("<iiii", 1, 0, 2, 1)
    (tmp_path / "sparse" / "0" / "points3D.bin").write_bytes(data)

    def width():
        """Return how wide the found object is, in diameters of the ball, from its box in the frame with its masks."""
        capture = read_capture(tmp_path, region(*make_masks(tmp_path, None, silent)["region"]))
        return 2 * np.linalg.norm(capture.box.moved(capture.to_capture).matrix[:3, 0])

    with_points = width()
    (tmp_path / "sparse" / "0" / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    assert with_points < 1.15 < 1.2 < width()


def test_command_prints_where_the_masks_and_the_object_are(tmp_path, capsys):
    photograph(tmp_path)
    commands.masks(tmp_path, [])
    printed = capsys.readouterr().out
    assert f"{COUNT} masks made: {tmp_path / 'masks'}" in printed and printed.count("region.size=") == 2
