"""Test reading captures in every supported layout. The cameras must project points of the scene to where the photos show them."""

import json
import shutil
from functools import partial
from itertools import count

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from refgs.capture import load_view, published_normals, read_capture, read_run_cameras, write_cameras
from refgs.capture.stanford_orb import novel_views
from tests.makers.captures import (
    CENTRE,
    RADIUS,
    ball,
    ball_normals,
    colmap,
    edit,
    move_photos,
    nerf_blender,
    nerfstudio,
    nero,
    ring,
    shiny_blender,
    stanford_orb,
    tensoir,
    write,
)

RED, GREEN, NOTHING = (220, 0, 0), (20, 200, 0), (0, 0, 0)


def project(camera, point):
    x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    assert z > 0
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def assert_sees_the_ball(capture):
    """Assert that the cameras and photos of a capture of the red and green ball agree.

    Points on the ball must project to pixels of their colour, and points just beside it to the background.
    """
    to_run = np.linalg.inv(capture.to_capture)
    for view in capture.views:
        loaded = load_view(view, None)
        towards = (capture.to_capture @ np.append(view.camera.position, 1))[:3] - CENTRE
        towards[2] = 0
        towards /= np.linalg.norm(towards)
        up, right = np.array([0, 0, 1.0]), np.array([-towards[1], towards[0], 0])
        for offset, expected in (
            (0.8 * towards + 0.4 * up, RED),
            (0.8 * towards - 0.4 * up, GREEN),
            (0.7 * right + 0.3 * up, RED),
            (-0.7 * right + 0.3 * up, RED),
            (1.2 * right, NOTHING),
            (-1.2 * right, NOTHING),
        ):
            point = (to_run @ np.append(CENTRE + RADIUS * offset, 1))[:3]
            u, v = project(view.camera, point).astype(int)
            shown = loaded.bytes[v, u] if loaded.alpha is None or loaded.alpha[v, u] else NOTHING
            assert tuple(shown) == expected


MAKERS = {"nerf-blender": nerf_blender, "nerfstudio": nerfstudio, "colmap": colmap, "nero": nero}
MAKERS["colmap-text"] = partial(colmap, binary=False)
MAKERS["tensoir"] = lambda folder: tensoir(folder / "synthetic" / "ball")
MAKERS |= {"stanford-orb": stanford_orb, "stanford-orb-ldr": partial(stanford_orb, suffix=".png")}


@pytest.fixture(params=MAKERS)
def capture(request, tmp_path):
    """Write a capture in one of the supported layouts, and read it. A test that uses this fixture runs once for each layout."""
    capture = read_capture(MAKERS[request.param](tmp_path / "été dans le jardin"))
    assert capture.layout == request.param.removesuffix("-text").removesuffix("-ldr")
    return capture


def test_cameras_see_what_the_photos_show(capture):
    assert_sees_the_ball(capture)


def test_region_is_the_ball_and_up_is_z(capture):
    scale = np.cbrt(np.linalg.det(capture.to_capture[:3, :3]))
    centre = (capture.to_capture @ np.append(capture.centre, 1))[:3]
    assert np.linalg.norm(centre - CENTRE) < 0.35 * RADIUS
    assert 0.8 * RADIUS < capture.radius * scale < 3 * RADIUS
    np.testing.assert_allclose(capture.to_capture[:3, 2] / scale, (0, 0, 1), atol=0.02)
    if capture.layout in ("nerf-blender", "tensoir"):
        assert np.array_equal(capture.to_capture, np.eye(4))
    else:
        assert capture.radius == 1 and not capture.centre.any()
    assert capture.bounded
    for view in capture.views:
        rotation = view.camera.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_points_go_with_the_cameras(capture):
    if capture.layout != "colmap":
        assert capture.points is None
        return
    points = capture.points @ capture.to_capture[:3, :3].T + capture.to_capture[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(points - CENTRE, axis=1), RADIUS, rtol=1e-9)
    np.testing.assert_allclose(capture.point_colors[0], (1, 128 / 255, 0))


def test_split(tmp_path):
    for folder, splits in (("a", {"train": 12, "test": 4}), ("b", {"train": 12, "val": 3})):
        capture = read_capture(nerf_blender(tmp_path / folder, splits))
        assert [len(capture.train_views), len(capture.test_views)] == list(splits.values())
    capture = read_capture(nerf_blender(tmp_path / "c", {"train": 12}))
    assert [view.camera.name for view in capture.test_views] == ["r_0", "r_6"]  # by name: r_0 r_1 r_10 r_11 r_2 … r_6
    folder = nerfstudio(tmp_path / "d")
    assert [view.camera.name for view in read_capture(folder).test_views] == ["0000", "0008"]

    def split(data):
        data["train_filenames"] = [f"images/{i:04d}.png" for i in range(10)]
        data["test_filenames"] = ["images/0012.png", "images/0013.png"]

    edit(folder / "transforms.json", split)
    capture = read_capture(folder)
    assert len(capture.train_views) == 10
    assert [view.camera.name for view in capture.test_views] == ["0012", "0013"]


def test_mixed_sizes_and_intrinsics_per_frame(tmp_path):
    folder = nerfstudio(tmp_path)

    def mix(data):
        for frame in data["frames"][1::2]:
            write(folder / frame["file_path"], ball(np.array(frame["transform_matrix"]), 40, 56, 75.0)[..., :3])
            frame.update(fl_x=75.0, fl_y=75.0, cx=20.0, cy=28.0, w=40, h=56)

    edit(folder / "transforms.json", mix)
    capture = read_capture(folder)
    assert {(view.camera.width, view.camera.height) for view in capture.views} == {(64, 48), (40, 56)}
    assert_sees_the_ball(capture)


def test_intrinsics_for_another_resolution_are_scaled(tmp_path):
    folder = nerfstudio(tmp_path)
    double = {"fl_x": 120.0, "fl_y": 120.0, "cx": 64.0, "cy": 48.0, "w": 128, "h": 96}
    edit(folder / "transforms.json", lambda data: data.update(double))
    assert_sees_the_ball(read_capture(folder))


@pytest.mark.parametrize("named", ["masks/{}.png", "masks/{}.png.png", "masks/{}.webp", "silhouettes/{}.png"])
def test_masks(tmp_path, named):
    folder = nerfstudio(tmp_path)

    def add_masks(data):
        for i, pose in enumerate(ring(16)):
            mask = named.format(f"{i:04d}")
            write(folder / mask, ball(pose, 64, 48, 60.0)[..., 3])
            if not mask.startswith("masks"):
                data["frames"][i]["mask_path"] = mask

    edit(folder / "transforms.json", add_masks)
    capture = read_capture(folder)
    assert capture.masked and capture.bounded and "masks" in capture.bounded_because
    scale = np.cbrt(np.linalg.det(capture.to_capture[:3, :3]))
    assert RADIUS < scale < 1.35 * RADIUS
    np.testing.assert_allclose(capture.to_capture[:3, 3], CENTRE, atol=0.1 * RADIUS)
    loaded = load_view(capture.views[3], None)
    assert np.array_equal(loaded.alpha > 127, ball(ring(16)[3], 64, 48, 60.0)[..., 3] > 127)


def test_masks_of_ones_are_masks(tmp_path):
    folder = colmap(tmp_path)
    for i, pose in enumerate(ring(16)):
        write(folder / "masks" / f"{i:04d}.png", ball(pose, 64, 48, 60.0)[..., 3] // 255)
    assert load_view(read_capture(folder).views[0], None).alpha.max() == 255


def test_opaque_alpha_is_no_mask(tmp_path):
    folder = nerf_blender(tmp_path)
    for path in folder.rglob("*.png"):
        write(path, np.full((48, 64, 4), 255, np.uint8))
    capture = read_capture(folder)
    assert not capture.masked
    assert load_view(capture.views[0], None).alpha is None
    assert any("opaque" in warning for warning in capture.warnings)


def test_same_name_in_two_folders(tmp_path):
    folder = nerfstudio(tmp_path)
    move_photos(folder, lambda i: f"images/{'left' if i % 2 else 'right'}/{i // 2:04d}.png")
    names = [view.camera.name for view in read_capture(folder).train_views]
    assert len(set(names)) == len(names) == 14
    assert "left_0003" in names


def test_photos_both_trained_and_tested_on_are_warned_of(tmp_path):
    file = nerf_blender(tmp_path, {"train": 12}) / "transforms_train.json"
    (tmp_path / "transforms_test.json").write_bytes(file.read_bytes())
    (warning,) = read_capture(tmp_path).warnings
    assert warning.startswith("12 photos are both trained and tested on, first r_0.png: ")


@pytest.mark.parametrize("make", MAKERS)
def test_a_removed_photo_leaves_its_camera_out(tmp_path, make):
    folder = MAKERS[make](tmp_path / "capture")
    before = read_capture(folder)
    gone = before.train_views[2].image_path
    gone.unlink()
    capture = read_capture(folder)
    assert [v.image_path for v in capture.views if v.split == "train"] == [
        v.image_path for v in before.train_views if v.image_path != gone
    ] or make in ("nerfstudio", "colmap", "colmap-text", "nero")  # which hold out other photos then
    assert {v.image_path for v in capture.views} == {v.image_path for v in before.views} - {gone}
    (said,) = set(capture.warnings) - set(before.warnings)
    name = gone.parent.name if make == "tensoir" else gone.stem
    assert said.startswith("1 of the 1") and "are missing and left out, first " in said and name in said
    assert_sees_the_ball(capture)


@pytest.mark.parametrize("keep", ["none", "empty", "some", "numbers"])
def test_colmap_text_without_keypoints(tmp_path, keep):
    """Check images.txt without the lines of keypoints, with empty ones, and with photos whose names look like keypoints."""
    folder = colmap(tmp_path, binary=False)
    file = folder / "sparse" / "0" / "images.txt"
    lines = [line for line in file.read_text().splitlines() if line.endswith(".png")]
    between = {"none": [], "empty": [""], "some": ["1 2 -1 3 4 5"], "numbers": ["1 2 -1"]}[keep]
    if keep == "some":
        lines[3] += "\n1.5 2.5 77"
    if keep == "numbers":
        for i in range(16):
            lines[i] = lines[i].replace(".png", "" if i % 2 else " 7 8.png")
            (folder / "images" / f"{i:04d}.png").rename(
                folder / "images" / (f"{i:04d}.png" if i % 2 else f"{i:04d} 7 8.png")
            )
    file.write_text("\n".join(line for image in lines for line in [image, *between]) + "\n")
    capture = read_capture(folder)
    assert len(capture.views) == 16
    assert_sees_the_ball(capture)


def test_nerfstudio_points(tmp_path):
    folder = nerfstudio(tmp_path)
    rows = np.zeros(30, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    rows["x"], rows["y"], rows["z"], rows["red"] = *CENTRE, 255
    PlyData([PlyElement.describe(rows, "vertex")]).write(folder / "sparse_pc.ply")
    edit(folder / "transforms.json", lambda data: data.update(ply_file_path="sparse_pc.ply"))
    capture = read_capture(folder)
    back = capture.points @ capture.to_capture[:3, :3].T + capture.to_capture[:3, 3]
    np.testing.assert_allclose(back, np.tile(CENTRE, (30, 1)), atol=1e-6)
    np.testing.assert_allclose(capture.point_colors[0], (1, 0, 0))


def test_scaled_poses_and_rounding_are_made_rigid(tmp_path):
    folder = nerf_blender(tmp_path)

    def scale(data):
        for frame in data["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] = np.round(1.7 * pose[:3, :3], 4)
            frame["transform_matrix"] = pose.tolist()

    edit(folder / "transforms_train.json", scale)
    assert_sees_the_ball(read_capture(folder))


def test_one_sided_cameras_do_not_surround_an_object(tmp_path):
    poses = [pose for pose in ring(48) if pose[0, 3] > CENTRE[0] + 1.2]
    capture = read_capture(nerfstudio(tmp_path, poses=poses))
    assert not capture.bounded and "one side" in capture.bounded_because


def test_cameras_that_look_outwards_are_a_room(tmp_path):
    poses = [pose @ np.diag([-1, 1, -1, 1]) for pose in ring(16, distance=0.5)]  # rotated by 180°
    capture = read_capture(nerfstudio(tmp_path, poses=poses))
    assert not capture.bounded and "outwards" in capture.bounded_because


def test_up_is_found_though_cameras_look_down_from_one_side(tmp_path):
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]  # the capture's frame leans
    poses = [tilt @ pose for pose in ring(24)[1:12:2]]
    capture = read_capture(nerfstudio(tmp_path, poses=poses))
    up = capture.to_capture[:3, 2]
    assert np.degrees(np.arccos(up @ tilt[:3, 2] / np.linalg.norm(up))) < 8


def test_fingerprint(tmp_path):
    folder = nerf_blender(tmp_path)
    first = read_capture(folder).fingerprint()
    assert first == read_capture(folder).fingerprint()
    moved = tmp_path.rename(tmp_path.with_name("moved"))
    assert first == read_capture(moved).fingerprint()
    edit(moved / "transforms_train.json", lambda data: data["frames"][2]["transform_matrix"][0].__setitem__(3, 5.0))
    changed = read_capture(moved).fingerprint()
    assert changed != first
    (moved / "train" / "r_1.png").write_bytes((moved / "train" / "r_1.png").read_bytes() + b"\0")
    assert read_capture(moved).fingerprint() not in (first, changed)


def test_json_with_a_byte_order_mark(tmp_path):
    file = nerfstudio(tmp_path) / "transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text())), encoding="utf-8-sig")
    assert len(read_capture(tmp_path).views) == 16


def test_nerf_synthetic_passes_over_depth_and_normals(tmp_path):
    folder = nerf_blender(tmp_path, {"train": 12, "val": 3, "test": 4})
    for photo in sorted((folder / "test").glob("r_?.png")):
        for what in ("depth", "normal"):
            write(photo.with_name(f"{photo.stem}_{what}_0001.png"), np.zeros((48, 64, 4), np.uint8))
    capture = read_capture(folder)
    assert [view.image_path.name for view in capture.test_views] == ["r_0.png", "r_1.png", "r_2.png", "r_3.png"]
    assert published_normals(capture.test_views[0]) is None
    assert_sees_the_ball(capture)


def test_shiny_blenders_ball_has_its_alpha_beside_it(tmp_path):
    capture = read_capture(shiny_blender(tmp_path))
    assert capture.masked and capture.bounded and not capture.warnings
    assert (len(capture.train_views), len(capture.test_views)) == (12, 4)
    assert_sees_the_ball(capture)


@pytest.mark.parametrize("max_side", [None, 32])
def test_published_normals(tmp_path, max_side):
    capture = read_capture(shiny_blender(tmp_path))
    for view, pose in zip(capture.test_views, ring(4), strict=True):
        loaded = load_view(view, max_side)
        normals, alpha = published_normals(view, max_side)
        assert normals.shape == loaded.image.shape and alpha.shape == loaded.alpha.shape
        assert normals.dtype == alpha.dtype == np.float32
        np.testing.assert_allclose(alpha * 255, loaded.alpha, atol=0.51)
        assert not normals[alpha == 0].any()
        height, width = alpha.shape
        true = ball_normals(pose, width, height, loaded.camera.fx)
        inside = (alpha > 0.99) & np.isfinite(true[..., 0])
        assert inside.sum() > 20
        np.testing.assert_allclose(np.linalg.norm(normals[inside], axis=-1), 1, atol=1e-5)
        angle = np.degrees(np.arccos(np.clip((normals * true).sum(-1)[inside], -1, 1)))
        assert np.median(angle) < (1.5 if max_side else 0.5)


def test_other_layouts_publish_no_normals(tmp_path):
    folder = nerfstudio(tmp_path)
    write(folder / "images" / "0000_normal.png", np.zeros((48, 64, 3), np.uint8))
    capture = read_capture(folder)
    assert published_normals(capture.test_views[0]) is None


def test_glossy_synthetic_with_its_split(tmp_path):
    split = (["3", "1", "12"], [str(i) for i in range(16) if i not in (1, 3, 12)])
    capture = read_capture(nero(tmp_path / "bell", split=split))
    assert [view.camera.name for view in capture.test_views] == ["1", "3", "12"]
    assert len(capture.train_views) == 13 and capture.masked and not capture.warnings
    write_cameras(tmp_path / "cameras.json", capture)
    cameras, splits, to_capture, _, _ = read_run_cameras(tmp_path / "cameras.json")
    assert splits.count("test") == 3 and np.allclose(to_capture, capture.to_capture)
    assert [camera.fx for camera in cameras] == [60] * 16


def test_glossy_synthetic_without_its_split(tmp_path):
    capture = read_capture(nero(tmp_path / "bell", count=18))
    assert [view.camera.name for view in capture.test_views] == ["0", "8", "16"]
    assert len(capture.warnings) == 1 and "synthetic_split_128.pkl" in capture.warnings[0]


def test_glossy_synthetic_without_depth_takes_the_photos_alpha(tmp_path):
    folder = nero(tmp_path / "bell")
    for i, pose in enumerate(ring(16)):
        (folder / f"{i}-depth.png").unlink()
        write(folder / f"{i}.png", ball(pose, 64, 48, 60.0))
    capture = read_capture(folder)
    assert capture.masked
    assert_sees_the_ball(capture)


def test_glossy_synthetic_converted_to_nerf_blender(tmp_path):
    """Check that a Glossy Synthetic scene converted to the NeRF-Blender layout can be read.

    Photos of both splits are in the folder `rgb`. The JSON files give the image size and the focal lengths.
    """
    folder = nerf_blender(tmp_path)
    (folder / "rgb").mkdir()
    numbers = count()

    def convert(data):
        data.update(w=64, h=48, fl_x=60.0, fl_y=60.0)
        for frame in data["frames"]:
            name = f"rgb/{next(numbers)}"
            (folder / f"{frame['file_path']}.png").rename(folder / f"{name}.png")
            frame["file_path"] = name

    for split in ("train", "test"):
        edit(folder / f"transforms_{split}.json", convert)
    capture = read_capture(folder)
    assert capture.masked and len(capture.test_views) == 4
    assert_sees_the_ball(capture)


def test_tensoir_leaves_validation_views_out(tmp_path):
    folder = tensoir(tmp_path / "synthetic" / "ball")
    (folder / "transforms_train.json").write_text(
        "{}"
    )  # copies of the data set have one that names photos in other folders
    capture = read_capture(folder)
    assert capture.layout == "tensoir" and capture.masked and not capture.warnings
    assert [view.camera.name for view in capture.test_views] == [f"test_{i:03d}" for i in range(4)]
    assert len(capture.train_views) == 12


def test_tensoir_with_photos_under_another_name(tmp_path):
    folder = tensoir(tmp_path / "synthetic" / "ball")
    for photo in folder.glob("*/rgba.png"):
        photo.rename(photo.with_name("rgba_sunset.png"))
    assert_sees_the_ball(read_capture(folder))


def test_tensoir_without_its_lights_is_warned_of(tmp_path):
    folder = tensoir(tmp_path / "synthetic" / "ball")
    shutil.rmtree(tmp_path / "synthetic" / "Environment_Maps")
    (warning,) = read_capture(folder).warnings
    assert "Environment_Maps" in warning and "does not relight" in warning


def test_photos_of_the_object_in_other_scenes(tmp_path):
    folder = stanford_orb(tmp_path)
    found = novel_views(folder)
    assert [view.camera.name for _, view in found] == [f"ball_scene002_{i:04d}" for i in range(4)]
    for (scene, view), pose in zip(found, ring(4), strict=True):
        assert scene == "ball_scene002" and view.image_path.parts[-3] == scene and view.masked
        np.testing.assert_allclose(view.camera.position, pose[:3, 3])
        u, v = project(view.camera, CENTRE + 0.8 * RADIUS * np.array([0, 0, 1])).astype(int)
        loaded = load_view(view)
        assert loaded.alpha[v, u] and loaded.encoded[v, u, 0] > 0.5 > loaded.encoded[v, u, 1]
    shutil.rmtree(folder.with_name("ball_scene002"))
    assert novel_views(folder) == []


@pytest.mark.parametrize("suffix", [".png", ".PNG", ".webp"])
def test_reduced_photos_of_a_colmap_capture(tmp_path, suffix):
    """Check that reading the folder `images_4` of a capture uses the reduced photos in this folder, and cameras that match their size.

    Every eighth photo is held out, as for the photos of full size.
    """
    folder = colmap(tmp_path / "sedan")
    for i, pose in enumerate(ring(16)):
        write(folder / "images_4" / f"{i:04d}.png", ball(pose, 16, 12, 15.0)[..., :3])
        (folder / "images_4" / f"{i:04d}.png").rename(folder / "images_4" / f"{i:04d}{suffix}")
    capture = read_capture(folder / "images_4")
    assert capture.layout == "colmap" and capture.points is not None
    assert [view.camera.name for view in capture.test_views] == ["0000", "0008"]
    whole = read_capture(folder)
    assert [view.camera.name for view in whole.test_views] == ["0000", "0008"]
    for small, large in zip(capture.views, whole.views, strict=True):
        assert (small.camera.width, small.camera.height) == (16, 12)
        assert small.camera.fx == pytest.approx(large.camera.fx / 4)
        assert small.image_path.parent.name == "images_4"
