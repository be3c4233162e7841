"""Test structure from motion: compare the poses found from photos alone with known poses."""

import multiprocessing
import sqlite3
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from refgs.capture import load_view, read_capture
from refgs.capture.colmap_steps import MATCH_TOLERANCE, _write_mask, epipolar_distance
from refgs.capture.contact_sheet import GAP, SIDE, TEXT
from refgs.capture.images import read_header, read_image
from refgs.capture.motion import UNEXPLAINED, find_cameras
from refgs.capture.poses import OPENGL_TO_OPENCV
from refgs.color import srgb_decode
from refgs.errors import InputError, NoCameras
from tests.makers.captures import look_at, write, write_as_phone
from tests.makers.disk import fill
from tests.makers.dng import write_dng
from tests.makers.speckled import FOCAL, HEIGHT, WIDTH, pose_errors, speckled
from tests.makers.waiting import until

POSES = [
    look_at(np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.8 + 0.5 * np.sin(3 * angle)]), np.array([0, 0, 0.4]))
    for angle in np.linspace(0, 1.4, 10)
]


def quiet(event: str, facts: dict) -> None:
    pass


@pytest.fixture(scope="module")
def pictures():
    return [speckled(pose)[0] for pose in POSES]


@pytest.fixture
def photos(tmp_path, pictures):
    """Write the pictures as photo files with a space in their names, without cameras. Returns the folder."""
    for number, picture in enumerate(pictures):
        write(tmp_path / f"stone {number:02d}.png", picture)
    return tmp_path


def test_photos_become_a_capture(photos):
    write(photos / "masks" / "stone 00.png", np.tri(HEIGHT, WIDTH, dtype=np.uint8) * 255)
    write(photos / "unlike the others.png", np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(NoCameras, match=r"11 photos, but no cameras.*refgs poses"):
        read_capture(photos)
    said = []
    found = find_cameras(photos, lambda event, facts: said.append((event, facts)))
    assert found["placed"] == 10 and found["photos"] == 11 and 0 < found["error"] < 1
    stages = [facts["stage"] for event, facts in said if event == "progress"]
    assert list(dict.fromkeys(stages)) == ["features", "matching", "mapping"]
    assert all(facts["done"] <= facts["total"] for event, facts in said if event == "progress")
    (warning,) = [facts["what"] for event, facts in said if event == "warning"]
    assert "1 of 11" in warning and "unlike the others.png" in warning
    assert {path.name for path in photos.iterdir() if path.is_dir()} == {"masks", "sparse"}
    assert {path.name for path in (photos / "sparse").iterdir()} == {"0"}
    capture = read_capture(photos)
    assert capture.layout == "colmap" and len(capture.points) > 100 and np.ptp(capture.point_colors) > 0.1
    views = sorted(capture.views, key=lambda view: view.camera.name)
    assert views[0].masked and not views[1].masked
    distances, angles = pose_errors(views, POSES)
    assert distances.max() < 0.02 and angles.max() < 1
    with pytest.raises(InputError, match="cameras already"):
        find_cameras(photos, quiet)


def test_photos_of_two_cameras_in_subfolders(tmp_path, pictures):
    """Check photos that have the same names in two folders, in formats that COLMAP does not read."""
    for number, picture in enumerate(pictures):
        file = tmp_path / "images" / f"cam{1 + number % 2}" / f"{number // 2}.{'jfif' if number % 2 else 'avif'}"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(file, "JPEG" if number % 2 else "AVIF", quality=95)
        write(
            tmp_path / "masks" / file.parent.name / f"{number // 2}.png",
            np.full((HEIGHT, WIDTH), 255 * (number > 0), np.uint8),
        )
    assert find_cameras(tmp_path, quiet)["placed"] == 10
    capture = read_capture(tmp_path)
    views = sorted(capture.views, key=lambda view: view.camera.name)
    taken = [(view.image_path.parent.name, view.image_path.stem) for view in views]
    assert sorted(taken) == [(camera, str(i)) for camera in ("cam1", "cam2") for i in range(5)]
    assert [view.mask_path for view in views] == [tmp_path / "masks" / camera / f"{name}.png" for camera, name in taken]
    distances, angles = pose_errors(views, [POSES[2 * int(name) + int(camera[3:]) - 1] for camera, name in taken])
    assert distances.max() < 0.02 and angles.max() < 1


def test_one_that_is_interrupted_goes_on(photos):
    """Check that an interrupted search for camera poses writes no capture. The next search must reuse the image features already found."""

    def interrupt(event: str, facts: dict) -> None:
        if facts.get("stage") == "matching":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_cameras(photos, interrupt)
    assert not multiprocessing.active_children()
    with pytest.raises(NoCameras):
        read_capture(photos)
    stages = []
    find_cameras(photos, lambda event, facts: stages.append(facts.get("stage")))
    assert "features" not in stages and "mapping" in stages
    assert len(read_capture(photos).views) == 10


def test_masks_lie_as_their_photos_are_stored(tmp_path, pictures):
    """Check that a mask is turned with a photo held sideways, as COLMAP reads photos without their EXIF orientation."""
    write_as_phone(tmp_path / "photo.png", pictures[0], 1, 30)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:10, :20] = 200
    write(tmp_path / "mask.png", mask)
    _write_mask(tmp_path / "photo.png", tmp_path / "mask.png", tmp_path / "masks" / "photo.png.png")
    stored = read_image(tmp_path / "masks" / "photo.png.png")[0][..., 0]
    header = read_header(tmp_path / "photo.png")
    assert stored.shape == (header.height, header.width) == (WIDTH, HEIGHT)
    assert (np.rot90(stored, -header.turns) == np.where(mask, 255, 0)).all()


def test_a_mask_of_another_size(tmp_path, pictures):
    for number, picture in enumerate(pictures[:3]):
        write(tmp_path / "images" / f"{number}.png", picture)
        write(tmp_path / "masks" / f"{number}.png", np.zeros((HEIGHT, WIDTH - number), np.uint8))
    with pytest.raises(InputError, match=r"1\.png: the mask has 255×192 pixels but its photo 1\.png 256×192"):
        find_cameras(tmp_path, quiet)
    assert {path.name for path in tmp_path.iterdir()} == {"images", "masks"}


@pytest.mark.parametrize("value", [0, 255])
def test_masks_that_say_nothing(tmp_path, value):
    """Check that masks that are all empty are refused before the search, and masks that are all white are not used."""
    random, warnings = np.random.default_rng(0), []
    for number in range(4):
        write(tmp_path / "images" / f"{number}.png", random.integers(0, 255, (96, 128, 3), np.uint8))
        write(tmp_path / "masks" / f"{number}.png", np.full((96, 128), value, np.uint8))
    match = "only 0 of 4 photos" if value else r"/masks: all 4 masks are empty, 0\.png too"
    with pytest.raises(InputError, match=match):
        find_cameras(tmp_path, lambda event, facts: warnings.append(facts) if event == "warning" else None)
    assert len(warnings) == (1 if value else 0)
    assert all("white (opaque) everywhere" in facts["what"] for facts in warnings)
    assert {path.name for path in tmp_path.iterdir()} == {"images", "masks"}


def test_raw_of_an_unknown_camera(tmp_path, pictures):
    for number, picture in enumerate(pictures[:3]):
        write(tmp_path / f"{number}.png", picture)
    (tmp_path / "3.cr3").write_bytes(b"something else" * 100)
    with pytest.raises(InputError, match=r"3\.cr3: LibRaw does not know"):
        find_cameras(tmp_path, quiet)
    assert {path.name for path in tmp_path.iterdir()} == {"0.png", "1.png", "2.png", "3.cr3"}


def test_lenses_of_few_photos_are_simple(tmp_path, pictures):
    """Check that photos of many sizes, three of each, are all placed: their lenses have one parameter of distortion."""
    for number, picture in enumerate(pictures[:9]):
        write(tmp_path / f"{number}.png", picture[: HEIGHT - 2 * (number // 3)])
    assert find_cameras(tmp_path, quiet)["placed"] == 9
    capture = read_capture(tmp_path)
    assert len({view.camera.height for view in capture.views}) == 3
    import pycolmap

    cameras = pycolmap.Reconstruction(tmp_path / "sparse" / "0").cameras.values()
    assert {camera.model_name for camera in cameras} == {"SIMPLE_RADIAL"}


def test_photos_of_two_sessions(tmp_path, pictures):
    for number, pose in enumerate(POSES[:8]):
        write(tmp_path / f"monday {number}.png", pictures[number])
        if number < 6:
            write(tmp_path / f"tuesday {number}.png", speckled(pose, seed=1)[0])
    photos = {path.name for path in tmp_path.iterdir()}
    match = r"two sessions: 8 from monday 0\.png on and 6 from tuesday 0\.png on share nothing"
    with pytest.raises(InputError, match=match):
        find_cameras(tmp_path, quiet)
    assert {path.name for path in tmp_path.iterdir()} == photos


def test_photos_that_hang_together_are_named_and_shown(tmp_path, pictures):
    """Check that a failed search tells which photos share features, and shows them on a sheet that the next search removes."""
    random = np.random.default_rng(0)
    for number in range(8):
        write(tmp_path / f"noise {number}.png", random.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8))
        if number < 6:
            write(tmp_path / f"a {number}.png", pictures[number])
        if 2 <= number < 5:
            write(tmp_path / f"b {number}.png", speckled(POSES[number], seed=1)[0])
    photos = {path.name for path in tmp_path.iterdir()}
    sheet = tmp_path / "unplaced" / "groups.png"
    match = (
        r"only 6 of 17 photos could be placed\. These hang together: 6 \(a 0\.png to a 5\.png\), 3 \(b 2\.png to b 4\.png\), "
        r"8 with none \(noise 0\.png to noise 7\.png\); see .*groups\.png\. Take more"
    )
    with pytest.raises(InputError, match=match) as error:
        find_cameras(tmp_path, quiet)
    assert str(sheet) in str(error.value) and "\n" not in str(error.value)
    assert {path.name for path in tmp_path.iterdir()} == photos | {"unplaced"}
    rows = read_image(sheet)[0]
    across, down = SIDE + GAP, SIDE + 2 * TEXT + 3 * GAP
    assert rows.shape == (GAP + 3 * down, GAP + 8 * across, 3)
    shown = rows[
        GAP + TEXT + GAP : GAP + TEXT + GAP + SIDE * HEIGHT // WIDTH, GAP + 5 * across : GAP + 5 * across + SIDE
    ]
    wanted = Image.fromarray(pictures[5]).resize((SIDE, SIDE * HEIGHT // WIDTH))
    assert np.abs(shown.astype(int) - np.asarray(wanted)).mean() < 10
    assert (rows[GAP + TEXT + GAP, GAP + 7 * across :] == 32).all()  # the first row has six photos

    for photo in tmp_path.glob("noise *.png"):
        photo.unlink()
    for photo in tmp_path.glob("b *.png"):
        photo.unlink()
    assert find_cameras(tmp_path, quiet)["placed"] == 6
    assert not sheet.parent.exists()


def test_photos_of_a_phone(tmp_path, pictures):
    """Check photos in HEIC and RAW, and photos held sideways.

    They get upright cameras under their own names. COLMAP starts with the focal length in EXIF, and nothing is left behind.
    """
    for number, picture in enumerate(pictures):
        film, suffix = round(FOCAL / np.hypot(WIDTH, HEIGHT) * np.hypot(36, 24)), (".HEIC", ".png", ".dng")[number % 3]
        if suffix == ".dng":
            write_dng(tmp_path / f"IMG {number}.dng", srgb_decode(picture / 255), turns=number % 4, film=film)
        else:
            write_as_phone(tmp_path / f"IMG {number}{suffix}", picture, number % 4, film)
    photos = {path.name for path in tmp_path.iterdir()}

    def interrupt(event: str, facts: dict) -> None:
        if facts.get("stage") == "matching":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_cameras(tmp_path, interrupt)
    assert not [path for path in (tmp_path / "sparse.tmp").iterdir() if path.is_dir()]
    (file,) = (tmp_path / "sparse.tmp").glob("*.db")
    database = sqlite3.connect(file)
    cameras = database.execute("SELECT width, height, prior_focal_length, params FROM cameras").fetchall()
    database.close()
    assert {camera[:3] for camera in cameras} == {(WIDTH, HEIGHT, 1), (HEIGHT, WIDTH, 1)}
    for *_, parameters in cameras:
        assert np.frombuffer(parameters)[0] == pytest.approx(FOCAL, rel=0.02)

    assert find_cameras(tmp_path, quiet)["placed"] == len(pictures)
    assert {path.name for path in tmp_path.iterdir()} == photos | {"sparse"}
    assert {path.name for path in (tmp_path / "sparse").iterdir()} == {"0"}
    capture = read_capture(tmp_path)
    views = sorted(capture.views, key=lambda view: view.camera.name)
    assert {view.image_path.name for view in views} == photos
    distances, angles = pose_errors(views, POSES)
    assert distances.max() < 0.05 and angles.max() < 2
    for view, picture in zip(views, pictures, strict=True):
        loaded = load_view(view)
        assert loaded.image.shape == picture.shape
        x, y, depth = loaded.camera.projection @ np.column_stack([capture.points, np.ones(len(capture.points))]).T
        u, v = (x / depth).astype(int), (y / depth).astype(int)
        inside = (depth > 0) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
        seen = loaded.encoded[v[inside], u[inside]]
        assert np.median(np.abs(seen - capture.point_colors[inside])) < 0.1


def test_photos_that_have_nothing_in_common(tmp_path):
    rng = np.random.default_rng(0)
    for number in range(4):
        write(tmp_path / "images" / f"{number}.png", rng.integers(0, 255, (96, 128, 3), np.uint8))
    with pytest.raises(InputError, match=r"only 0 of 4 photos could be placed.*newspaper"):
        find_cameras(tmp_path, quiet)
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_a_photo_that_is_broken(tmp_path):
    """Check that the process that runs COLMAP names a photo that it cannot decode."""
    for number in range(3):
        write_as_phone(tmp_path / f"{number}.tif", np.full((96, 128, 3), number, np.uint8), turns=1)
    photo = tmp_path / "1.tif"
    photo.write_bytes(photo.read_bytes()[:-3000])
    with pytest.raises(InputError, match=r"1\.tif: the image is truncated"):
        find_cameras(tmp_path, quiet)


def test_no_photos(tmp_path):
    with pytest.raises(InputError, match="0 photos"):
        find_cameras(tmp_path, quiet)
    (tmp_path / "a.jpg").touch()
    with pytest.raises(InputError, match=r"a\.jpg: this is a file\. Name the folder that holds it"):
        find_cameras(tmp_path / "a.jpg", quiet)
    with pytest.raises(InputError, match="nowhere: there is no such folder"):
        find_cameras(tmp_path / "nowhere", quiet)


def test_what_stands_still_contradicts_what_turns():
    """Check how matches that contradict the camera poses are recognised.

    A block turns in front of a room that stands still. Poses that fit the block contradict the matches in the room, and poses that fit
    the room contradict the matches on the block.
    """
    rng, focal, count = np.random.default_rng(0), 1000, 36
    block, room = rng.uniform(-0.8, 0.8, (100, 3)), np.add(rng.uniform(-2, 2, (50, 3)), [0, 6, 0])
    places, around, inside = [], [], []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        eye = look_at(np.array([0, -4, 1.5]) + rng.normal(0, 0.05, 3), np.zeros(3))
        inside.append(np.linalg.inv(eye @ OPENGL_TO_OPENCV))
        around.append(inside[-1] @ turn)
        seen = np.concatenate([block @ turn[:3, :3].T, room]) @ inside[-1][:3, :3].T + inside[-1][:3, 3]
        places.append(seen[:, :2] / seen[:, 2:])

    def contradicted(poses: list[np.ndarray], reach: int, features: slice) -> np.ndarray:
        """Return for each match between two photos whether the poses contradict it: bool (N,).

        The photos form a closed ring. Only photos at most `reach` places apart are matched, and only the scene's points in the slice
        `features`.
        """
        far = []
        for a, b in combinations(range(count), 2):
            if min(b - a, count - b + a) <= reach:
                way = (poses[b] @ np.linalg.inv(poses[a]))[:3]
                far.append(epipolar_distance(places[a][features], places[b][features], way))
        return np.concatenate(far) * focal > MATCH_TOLERANCE

    of_block, of_room = (6, slice(100)), (count, slice(100, None))  # six photos on, the block's features are hidden
    for poses in (around, inside):
        both = [contradicted(poses, *of_block), contradicted(poses, *of_room)]
        assert np.concatenate(both).mean() > UNEXPLAINED
        assert both[0 if poses is around else 1].mean() == 0


def test_a_search_on_a_full_disk(small_disk):
    for number in range(3):
        write(small_disk / f"{number}.png", np.random.default_rng(number).integers(0, 255, (48, 64, 3), np.uint8))
    fill(small_disk / "filler")
    with pytest.raises(
        InputError, match=r"disk cannot be written \(No space left on device\): .* search again"
    ) as error:
        find_cameras(small_disk, lambda event, facts: None)
    assert "\n" not in str(error.value)


CHILD = """
import multiprocessing, os, time
from refgs.capture.motion import end_with_parent

def child():
    end_with_parent()
    print(os.getpid(), flush=True)
    time.sleep(600)

if __name__ == "__main__":
    process = multiprocessing.get_context("spawn").Process(target=child)
    process.start()
    process.join()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks for a process in /proc")
def test_a_search_ends_with_its_process(tmp_path):
    """Check that the child process in which COLMAP runs ends when its parent is killed."""
    (tmp_path / "search.py").write_text(CHILD)
    with subprocess.Popen([sys.executable, tmp_path / "search.py"], stdout=subprocess.PIPE, text=True) as parent:
        child = Path("/proc") / parent.stdout.readline().strip()
        assert child.exists()
        parent.kill()
    until(lambda: not child.exists() or "Z" in (child / "stat").read_text().rpartition(")")[2], 60)
