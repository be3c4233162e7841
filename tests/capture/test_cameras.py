"""Test camera files: write and read a run folder's cameras.json, and read cameras from a capture's transforms file."""

import json

import numpy as np
import pytest

from refgs.capture import read_cameras, read_capture, read_run_cameras, write_cameras
from refgs.capture.poses import in_frame
from tests.makers.captures import colmap, edit, nerf_blender, nerfstudio, nero, write


def assert_same(a, b):
    assert (a.name, a.width, a.height) == (b.name, b.width, b.height)
    np.testing.assert_allclose((a.fx, a.fy, a.cx, a.cy), (b.fx, b.fy, b.cx, b.cy), rtol=1e-12)
    np.testing.assert_allclose(a.world_to_camera, b.world_to_camera, atol=1e-9)


@pytest.mark.parametrize("make", [nerf_blender, nerfstudio, colmap])
def test_run_cameras_round_trip(tmp_path, make):
    capture = read_capture(make(tmp_path / "capture"))
    file = tmp_path / "cameras.json"
    names = [view.camera.name for view in capture.train_views]
    given = {names[1]: [1.25, 1.25, 1.25], names[2]: [1.0, 1.25, 0.75]}
    write_cameras(file, capture, exposures=given)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["cameras.json"]
    cameras, splits, to_capture, exposures, _ = read_run_cameras(file)
    assert splits == [view.split for view in capture.views]
    # A held-out view of the same name has no exposure.
    known = {names[1]: 1.25, names[2]: [1.0, 1.25, 0.75]}  # one number stands for three equal ones
    assert exposures == [known.get(view.camera.name, 1.0) if view.split == "train" else 1.0 for view in capture.views]
    np.testing.assert_array_equal(to_capture, capture.to_capture)
    for camera, view in zip(cameras, capture.views, strict=True):
        assert_same(camera, view.camera)
    # Read as a camera path, the same file is in the capture's frame.
    for camera, view in zip(read_cameras(file), capture.views, strict=True):
        assert_same(camera, in_frame(view.camera, capture.to_capture))


def test_photos_and_their_masks_are_named(tmp_path):
    folder = nerfstudio(tmp_path / "capture")
    for name in ("mask/0001.png.mask.png", "masks/0002.jpg", "silhouettes/3.png"):
        write(folder / name, np.tri(48, 64, dtype=np.uint8) * 255)
    (tmp_path / "other.png").write_bytes((folder / "masks" / "0002.jpg").read_bytes())
    edit(folder / "transforms.json", lambda data: data["frames"][3].update(mask_path="silhouettes/3.png"))
    edit(folder / "transforms.json", lambda data: data["frames"][4].update(mask_path="../other.png"))
    write_cameras(tmp_path / "cameras.json", read_capture(folder))
    frames = json.loads((tmp_path / "cameras.json").read_text())["frames"]
    assert [frame["photo"] for frame in frames] == [f"images/{i:04d}.png" for i in range(16)]
    assert {frame["photo"][7:11]: frame["mask"] for frame in frames if "mask" in frame} == {
        "0001": "mask/0001.png.mask.png",
        "0002": "masks/0002.jpg",
        "0003": "silhouettes/3.png",
        "0004": "../other.png",
    }


def test_depth_maps_are_named_as_no_masks(tmp_path):
    write_cameras(tmp_path / "cameras.json", read_capture(nero(tmp_path / "bell")))
    assert "mask" not in (tmp_path / "cameras.json").read_text()


@pytest.mark.parametrize(("make", "name"), [(nerf_blender, "transforms_test.json"), (nerfstudio, "transforms.json")])
def test_the_captures_own_file_gives_its_cameras(tmp_path, make, name):
    capture = read_capture(make(tmp_path))
    views = {view.camera.name: view for view in (capture.test_views if make is nerf_blender else capture.views)}
    cameras = read_cameras(tmp_path / name)
    assert len(cameras) == len(views)
    for camera in cameras:
        assert_same(camera, in_frame(views[camera.name].camera, capture.to_capture))


def test_moving_between_frames_keeps_the_picture(tmp_path):
    camera = read_capture(nerf_blender(tmp_path)).views[0].camera
    to_frame = np.eye(4)
    to_frame[:3, :3] = 2.5 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    to_frame[:3, 3] = (1, -2, 3)
    moved = in_frame(camera, to_frame)
    point = np.array([1.2, 2.1, 2.9, 1])
    old, new = camera.world_to_camera @ point, moved.world_to_camera @ (to_frame @ point)
    np.testing.assert_allclose(new[:3], 2.5 * old[:3], rtol=1e-12)
    assert_same(in_frame(moved, np.linalg.inv(to_frame)), camera)
