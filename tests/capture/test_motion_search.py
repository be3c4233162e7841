"""Test the ways to find cameras that are taken where the first one fails, and that of many photos, against the true angles."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from refgs.capture import colmap_steps, motion, read_capture, similar
from refgs.capture.files import find_photos
from refgs.capture.images import read_image
from refgs.capture.motion import find_cameras
from refgs.capture.poses import OPENGL_TO_OPENCV
from refgs.errors import InputError
from tests.makers.captures import look_at, write
from tests.makers.speckled import about_z, pose_errors, speckled

TURNTABLE = 18  # photos
MANY = 56  # photos


def orbit(azimuths, distance: float = 3.2, height: float = 1.8) -> list[np.ndarray]:
    """Return the poses of a camera that walks around the block. `azimuths` are in degrees."""
    angles = np.radians(azimuths)
    return [
        look_at((distance * np.cos(a), distance * np.sin(a), height + 0.2 * np.sin(3 * a)), (0, 0, 0.4)) for a in angles
    ]


def photograph(folder: Path, poses: list[np.ndarray]) -> None:
    for number, pose in enumerate(poses):
        write(folder / "images" / f"{number:03d}.png", speckled(pose)[0])


def warnings_of(folder: Path) -> tuple[dict, list[str]]:
    """Find the cameras of photos. Return the facts, and the warnings."""
    warnings = []
    found = find_cameras(folder, lambda event, facts: warnings.append(facts["what"]) if event == "warning" else None)
    return found, warnings


def turntable(folder: Path) -> list[np.ndarray]:
    """Photograph the block as it turns on a floor that does not, from a tripod that is nudged.

    Write photos and masks. Return the true poses in the block's own frame.
    """
    random, poses = np.random.default_rng(0), []
    for number in range(TURNTABLE):
        turn = 2 * np.pi * number / TURNTABLE
        pose = look_at(np.array([0, -2.6, 1.3]) + random.normal(0, 0.03, 3), (0, 0, 0.4))
        photo, mask = speckled(pose, turn, room=True, width=320, height=240)
        write(folder / "images" / f"{number:03d}.png", photo)
        write(folder / "masks" / f"{number:03d}.png", mask)
        poses.append(about_z(-turn) @ pose)
    return poses


def test_an_object_on_a_turntable(tmp_path):
    """Check that cameras about an object that turns before a still room are found from the pixels in its masks.

    Without masks, cameras follow the object in part and the room in part: they are wrong, and a warning says so.
    """
    poses = turntable(tmp_path)
    found, warnings = warnings_of(tmp_path)
    assert found["inside"] and found["placed"] == TURNTABLE and not warnings
    distances, angles = pose_errors(read_capture(tmp_path).views, poses)
    assert distances.max() < 0.15 and angles.max() < 3

    for mask in (tmp_path / "masks").iterdir():
        mask.unlink()
    (tmp_path / "sparse").rename(tmp_path / "before")
    try:
        found, warnings = warnings_of(tmp_path)
    except InputError as error:
        assert "could be placed" in str(error)
    else:
        assert not found["inside"] and any("put masks of the object in the folder masks" in line for line in warnings)


def test_masks_where_nothing_turns(tmp_path):
    """Check that the whole photos are used where they agree, though all have masks, and that masks leave only features inside them."""
    poses = orbit(np.arange(0, 60, 10))
    photograph(tmp_path, poses)
    masks = [speckled(pose)[1] for pose in poses]
    for number, mask in enumerate(masks):
        write(tmp_path / "masks" / f"{number:03d}.png", mask)
    places = in_child(features_inside_masks, tmp_path)
    for mask, found in zip(masks, places, strict=True):
        column, row = found.astype(int).T
        assert len(found) > 50 and (mask[row, column] > 0).all()
    found, warnings = warnings_of(tmp_path)
    assert found["placed"] == len(poses) and not found["inside"] and not warnings
    distances, angles = pose_errors(read_capture(tmp_path).views, poses)
    assert distances.max() < 0.1 and angles.max() < 2


def features_inside_masks(folder: Path) -> list[np.ndarray]:
    """Return the places (M, 2) of the features that are found inside the masks of each photo, in pixels."""
    import pycolmap

    photos, database = find_photos(folder), folder / "inside" / "inside.db"
    database.parent.mkdir()
    colmap_steps.extract_features(photos, sorted((folder / "masks").iterdir()), database, lambda *_: None)
    with pycolmap.Database.open(database) as known:
        images = sorted(known.read_all_images(), key=lambda image: int(image.name))
        return [known.read_keypoints(image.image_id)[:, :2] for image in images]


@pytest.fixture(scope="module")
def two_sides(tmp_path_factory):
    """Photograph two sides of the block that hardly anything links. Return the folder and the true poses."""
    folder = tmp_path_factory.mktemp("two sides")
    azimuths = np.arange(0, 70, 10)
    poses = orbit([*azimuths, *(azimuths + 180)], distance=3.0, height=1.5)
    photograph(folder, poses)
    return folder, poses


def test_photos_that_share_little_are_placed_together(two_sides):
    """Check that all photos are placed where too little links them to be placed one after the other."""
    folder, poses = two_sides
    one_by_one = in_child(placed_one_by_one, folder)
    found, warnings = warnings_of(folder)
    assert one_by_one < found["placed"] == len(poses) and not warnings
    distances, angles = pose_errors(read_capture(folder).views, poses)
    assert distances.max() < 0.1 and angles.max() < 2


def test_a_search_finds_the_same_cameras_again(two_sides, tmp_path):
    """Check that two searches in the same photos place the same ones, at the same poses, together and one after the other.

    On most machines the two models are equal byte for byte. On some, COLMAP's sums depend on where in memory the numbers are.
    """
    for photos in (14, 6):
        found = []
        for turn in range(2):
            folder = tmp_path / f"{photos} {turn}"
            for photo in find_photos(two_sides[0])[:photos]:
                write(folder / photo.name, read_image(photo)[0])
            find_cameras(folder, lambda *_: None)
            found.append(read_capture(folder).views)
        one, again = ({view.camera.name: view.camera.camera_to_world for view in views} for views in found)
        assert one.keys() == again.keys()
        distances, angles = pose_errors(found[1], [one[name] @ OPENGL_TO_OPENCV for name in sorted(one)])
        assert distances.max() < 0.02 * np.ptp([pose[:3, 3] for pose in one.values()]) and angles.max() < 0.5


def test_photos_without_cameras_are_unexplained(tmp_path):
    """Check that what photos without cameras share with others counts as unexplained: one photo of five is in 4 of 10 pairs."""
    photograph(tmp_path, orbit(np.arange(0, 50, 10)))
    with_all, without_one = in_child(unexplained, tmp_path)
    assert with_all < 0.02 and 0.2 < without_one < 0.6


def unexplained(folder: Path) -> tuple[float, float]:
    """Return the part of the feature matches that cameras leave unexplained: the cameras of all photos, and without that in the middle."""
    photos, database = find_photos(folder), folder / "all.db"
    colmap_steps.extract_features(photos, [], database, lambda *_: None)
    colmap_steps.match_features(database, lambda *_: None)
    model = colmap_steps.map_one_by_one(photos, database, lambda *_: None)[0]
    middle = next(image for image in model.images.values() if int(image.name) == len(photos) // 2)
    with_all = colmap_steps.unexplained_part(model, database)
    model.deregister_frame(middle.frame_id)
    return with_all, colmap_steps.unexplained_part(model, database)


def test_a_camera_that_contradicts_its_photo_is_removed(tmp_path):
    """Check that a camera that does not look where its photo does is removed from a model, and no other camera is."""
    photograph(tmp_path, orbit(np.arange(0, 50, 10)))
    assert in_child(supported, tmp_path) == [{0, 1, 2, 3, 4}, {0, 1, 3, 4}]


def supported(folder: Path) -> list[set[int]]:
    """Return the photos whose cameras stay: of the model as it is found, and once the camera in the middle is tilted by 20°."""
    import pycolmap

    photos, database = find_photos(folder), folder / "all.db"
    colmap_steps.extract_features(photos, [], database, lambda *_: None)
    colmap_steps.match_features(database, lambda *_: None)
    model = colmap_steps.map_one_by_one(photos, database, lambda *_: None)[0]
    middle = next(image for image in model.images.values() if int(image.name) == len(photos) // 2)
    tilt = pycolmap.Rigid3d(pycolmap.Rotation3d(np.radians([20.0, 0, 0])), np.zeros(3))
    found = []
    for change in (pycolmap.Rigid3d(), tilt):
        model.frame(middle.frame_id).rig_from_world = change * middle.cam_from_world()
        colmap_steps.remove_unsupported(model, database)
        found.append({int(model.image(number).name) for number in model.reg_image_ids()})
    return found


def in_child(work, folder: Path):
    """Return `work(folder)`, called in a process of its own, because COLMAP's OpenMP conflicts with torch's on some systems."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, folder).result()


def placed_one_by_one(folder: Path) -> int:
    """Return how many photos COLMAP places one after the other."""
    import pycolmap

    pycolmap.set_random_seed(colmap_steps.SEED)
    photos, database = find_photos(folder), folder / "apart" / "apart.db"
    database.parent.mkdir()
    colmap_steps.extract_features(photos, [], database, lambda *_: None)
    colmap_steps.match_features(database, lambda *_: None)
    return colmap_steps.map_one_by_one(photos, database, lambda *_: None)[0].num_reg_images()


@pytest.mark.slow
def test_many_photos_in_any_order(tmp_path):
    """Check that photos are matched with those that look like them, where these are too many for all pairs and names say nothing.

    They show two rounds at two heights.
    """
    azimuths = np.linspace(0, 360, MANY // 2, endpoint=False)
    poses = orbit(azimuths) + orbit(azimuths, height=2.3)
    poses = [poses[number] for number in np.random.default_rng(0).permutation(MANY)]
    photograph(tmp_path, poses)
    pairs = in_child(search_as_of_many, tmp_path)
    assert pairs < 0.5 * MANY * (MANY - 1) / 2
    distances, angles = pose_errors(read_capture(tmp_path).views, poses)
    assert len(angles) == MANY and distances.max() < 0.1 and angles.max() < 2


def search_as_of_many(folder: Path) -> int:
    """Find cameras as if ALL_PAIRS photos were few, and write them. Return how many pairs of photos were chosen."""
    colmap_steps.ALL_PAIRS, similar.RANKS = 16, (0, 1, 2, 3, 5, 8)
    photos, database = find_photos(folder), folder / "many.db"
    best, _ = motion._search(photos, [], database, lambda *_: None)
    for number in best.reg_image_ids():
        best.image(number).name = photos[int(best.image(number).name)].name
    (folder / "sparse" / "0").mkdir(parents=True)
    best.write_binary(folder / "sparse" / "0")
    return len(colmap_steps.choose_pairs(database))
