"""Test that captures with an origin far away, or of any unit, are read as the same captures at the origin."""

import numpy as np
import pytest

from refgs.capture import read_capture
from refgs.capture.check import describe
from refgs.errors import InputError
from refgs.settings import load_settings
from tests.makers.captures import CENTRE, colmap, edit, nerf_blender, nerfstudio

UTM, ECEF = (456789.0, 5432100.0, 300.0), (4.1e6, 6.2e5, 4.8e6)
REGION = load_settings("quick", ["region.centre=[0.1,0,0.2]", "region.size=[0.8,0.9,1.0]"]).region


def nerfstudio_with_points(folder):
    """Write nerfstudio's layout with points of 64 bits: 32 do not hold map coordinates."""
    rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in _points(np.zeros(3), 1.0).tolist())
    head = "ply\nformat ascii 1.0\nelement vertex 60\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    nerfstudio(folder)
    (folder / "points.ply").write_text(f"{head}end_header\n{rows}")
    edit(folder / "transforms.json", lambda data: data.update(ply_file_path="points.ply"))
    return folder


def _points(offset, scale):
    rays = np.random.default_rng(1).normal(size=(60, 3))
    return (CENTRE + 0.5 * rays / np.linalg.norm(rays, axis=1, keepdims=True)) * scale + offset


def move(folder, offset, scale):
    """Scale the capture's coordinates and move them by `offset`, in its files."""

    def each(data):
        for frame in data["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = scale * pose[:3, 3] + offset
            frame["transform_matrix"] = pose.tolist()

    for file in folder.glob("transforms*.json"):
        edit(file, each)
    if (folder / "points.ply").exists():
        head = (folder / "points.ply").read_text().partition("end_header\n")
        rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in _points(np.array(offset), scale).tolist())
        (folder / "points.ply").write_text(head[0] + head[1] + rows)
    sparse = folder / "sparse" / "0"
    if sparse.is_dir():
        lines = (sparse / "images.txt").read_text().splitlines()
        for i, line in enumerate(lines):
            if line.endswith(".png"):
                number, *pose, camera, name = line.split()
                w, x, y, z = np.array(pose[:4], float)
                turn = 2 * np.array(
                    [[.5 - y*y - z*z, x*y - w*z, x*z + w*y], [x*y + w*z, .5 - x*x - z*z, y*z - w*x], [x*z - w*y, y*z + w*x, .5 - x*x - y*y]]
                )  # fmt: skip
                moved = scale * np.array(pose[4:], float) - turn @ offset
                lines[i] = " ".join([number, *pose[:4], *map(repr, moved.tolist()), camera, name])
        (sparse / "images.txt").write_text("\n".join(lines))
        rows = [line.split() for line in (sparse / "points3D.txt").read_text().splitlines() if line[0] != "#"]
        for row in rows:
            row[1:4] = map(repr, (scale * np.array(row[1:4], float) + offset).tolist())
        (sparse / "points3D.txt").write_text("\n".join(" ".join(row) for row in rows))


def seen(capture):
    """Return a capture's cameras and points about its centre, in units of its radius."""
    positions = np.array([view.camera.position for view in capture.views])
    turns = np.array([view.camera.world_to_camera[:3, :3] for view in capture.views])
    placed = [positions] if capture.points is None else [positions, capture.points]
    return [turns, *((each - capture.centre) / capture.radius for each in placed)]


@pytest.mark.parametrize("make", [nerfstudio, nerfstudio_with_points, nerf_blender, lambda f: colmap(f, False)])
@pytest.mark.parametrize(
    ("offset", "scale"), [(UTM, 0.15), (ECEF, 0.15), (1e3 * np.array(UTM), 150.0), ((0, 0, 0), 1e-9), ((0, 0, 0), 1e8)]
)
@pytest.mark.parametrize("wanted", [None, REGION])
def test_map_coordinates(tmp_path, make, offset, scale, wanted):
    if make is nerf_blender:
        wanted = None  # its box would be in other coordinates: a capture near the origin keeps its own
    folder = make(tmp_path)
    plain = read_capture(folder, wanted)
    centre = plain.to_capture @ [*plain.centre, 1]
    move(folder, offset, scale)
    moved = read_capture(folder, wanted)
    assert moved.bounded_because == plain.bounded_because
    for one, other in zip(seen(moved), seen(plain), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    found = moved.to_capture @ [*moved.centre, 1]
    np.testing.assert_allclose(
        found[:3], scale * centre[:3] + offset, rtol=0, atol=1e-6 * scale + 1e-15 * np.max(offset)
    )
    assert moved.radius == pytest.approx(1) or wanted  # 32 bits hold what is trained


def test_the_extent_is_told_to_a_hundredth_of_the_radius(tmp_path):
    folder = nerfstudio(tmp_path)
    move(folder, UTM, 0.15)
    line = next(line for line in describe(read_capture(folder)) if line.startswith("Extent"))
    place = [float(x) for x in line.partition("(")[2].partition(")")[0].split(",")]
    np.testing.assert_allclose(place, 0.15 * CENTRE + UTM, atol=0.02)


def test_cameras_in_one_place_far_away(tmp_path):
    folder = nerfstudio(tmp_path)
    edit(
        folder / "transforms.json",
        lambda data: [
            row.__setitem__(3, at) for f in data["frames"] for row, at in zip(f["transform_matrix"], UTM, strict=False)
        ],
    )
    with pytest.raises(InputError, match="all cameras are in one place"):
        read_capture(folder)


def test_points_far_away_are_left_out(tmp_path):
    folder = colmap(tmp_path, False)
    file = folder / "sparse" / "0" / "points3D.txt"
    lines = file.read_text().splitlines()
    for i, value in enumerate(("1e308", "-1e150", "inf", "nan"), 5):
        lines[i] = " ".join([lines[i].split()[0], value, *lines[i].split()[2:]])
    file.write_text("\n".join(lines))
    assert len(read_capture(folder).points) == 46


@pytest.mark.parametrize("counted", [True, False])
@pytest.mark.parametrize("names", ["{:04d}.png", "{:04d}"])
def test_images_without_lines_of_keypoints(tmp_path, counted, names):
    """Check that all images of a text file are read that has one line an image, as some programs write it."""
    folder = colmap(tmp_path, False)
    expected = read_capture(folder)
    file = folder / "sparse" / "0" / "images.txt"
    lines = [line for line in file.read_text().splitlines() if line.endswith(".png") or (counted and line[:1] == "#")]
    file.write_text("\n".join(line.replace(".png", "") if "." not in names else line for line in lines))
    capture = read_capture(folder)
    assert len(capture.views) == 16
    for one, other in zip(capture.views, expected.views, strict=True):
        assert one.image_path == other.image_path
        np.testing.assert_array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
