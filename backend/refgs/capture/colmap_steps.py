"""Call COLMAP (pycolmap) for each step of structure from motion: features, matches and cameras.

`motion.find_cameras` decides which steps to take, and judges the cameras found.
"""

import os
import shutil
from collections import Counter
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.sparse.csgraph import connected_components

from refgs import CORES
from refgs.capture.images import read_focal_length, read_header, read_image, read_mask, write_for_colmap
from refgs.capture.learned import read_matches
from refgs.capture.similar import pairs_to_match

SIDE = 1600  # pixels on the longer side for finding features; presets train on fewer
ALL_PAIRS = 150  # photos; up to this many, every pair is matched
CAMERA_MODEL = "RADIAL"  # with few photos a second focal length and tangential distortion only fit noise
SEED = 1
# Of the cameras' computation: the sums of several threads differ from run to run, and with them which photos are placed.
ONE_THREAD = 1
TIED = 3  # points that a photo must share with others; COLMAP asks for 30 where it places one photo after the other
LINKED = 30  # matches between two photos of a group; COLMAP asks for as many where it places one photo after the other
MATCH_TOLERANCE = 8.0  # pixels from its epipolar line, above which a match contradicts the cameras; COLMAP allows 4
SUPPORTED = 0.5  # part of a photo's matches with other placed photos, below which its camera is taken to be wrong
FEW_CAMERA_MODEL = "SIMPLE_RADIAL"  # of what tells little about the lens: see the next two
WELL_SEEN = 10  # photos of one lens and size. 23 of a statue, cropped to 7 sizes, are all placed; with RADIAL, 3 are
INSIDE_CAMERA_MODEL = FEW_CAMERA_MODEL  # an object fills little of the photos: with RADIAL 5 of 66 of a head are placed
FAINT = 0.002  # contrast of the weakest features inside masks; COLMAP's is 0.0067, which places 60 of 66 photos of a dark bronze, not all
INSIDE_FEATURES = (
    16384  # COLMAP takes the largest 8192 of a photo before it looks at the mask; the surroundings may use these up
)


def choose_pairs(database: Path) -> list[tuple[int, int]]:
    """Choose which photos in COLMAP's database to match (see `pairs_to_match`). Returns pairs of photo indices.

    Photos are numbered in order of their file names.
    """
    import pycolmap

    with pycolmap.Database.open(database) as known:
        images = {int(image.name): image.image_id for image in known.read_all_images()}
        photos = sorted(images)
        pairs = pairs_to_match(len(photos), lambda place: known.read_descriptors(images[photos[place]]).data, ALL_PAIRS)
    return [(photos[a], photos[b]) for a, b in pairs]


def extract_features(
    photos: list[Path], masks: list[Path], database: Path, progress: Callable, learned: Path | None = None
) -> None:
    """Extract image features of all photos into COLMAP's database. If `masks` is not empty, keep only features inside the masks.

    `masks` has a mask file for each photo, in the same order, or is empty. If `learned` is given, a file by `learned.match_photos`, its
    features are taken in place of SIFT's. `progress("features", done, total)` is called for each batch of photos. Photos with the same size
    and focal length (EXIF) share their intrinsics. COLMAP gets a temporary JPEG of a photo that it cannot read. At the end the photos in
    the database are renamed to their indices, because names in COLMAP's file of pairs cannot have spaces.
    """
    import pycolmap

    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = CAMERA_MODEL
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = SIDE
    written = database.with_name(f"{database.name}.masks")
    if masks:
        reading.camera_model = INSIDE_CAMERA_MODEL
    if masks and learned is None:
        reading.mask_path = written
        extraction.sift.peak_threshold = FAINT
        extraction.sift.max_num_features = INSIDE_FEATURES
    with pycolmap.Database.open(database) as known:
        cameras = {_lens(camera): camera.camera_id for camera in known.read_all_cameras()}
    readable = database.with_name(f"{database.name}.photos")
    readable.mkdir(exist_ok=True)
    top = Path(os.path.commonpath([photo.parent for photo in photos]))
    numbers: dict[str, str] = {}
    for start in range(0, len(photos), 2 * CORES):
        progress("features", start, len(photos))
        shared: dict[tuple[int, Path], list[str]] = {}
        for number, photo in list(enumerate(photos))[start : start + 2 * CORES]:
            folder, name = top, photo.relative_to(top).as_posix()
            if write_for_colmap(photo, readable / f"{number}.jpg"):
                # In a folder of its own, because a photo may be named 0.jpg.
                folder, name = database.parent, f"{readable.name}/{number}.jpg"
            numbers[name] = str(number)
            if masks and learned is None:
                _write_mask(photo, masks[number], written / f"{name}.png")
            camera = pycolmap.infer_camera_from_image(folder / name, reading)
            if focal := read_focal_length(photo):  # COLMAP knows only that for 35 mm film, in JPEG and PNG
                camera.focal_length, camera.has_prior_focal_length = focal, True
            if _lens(camera) not in cameras:
                with pycolmap.Database.open(database) as known:
                    cameras[_lens(camera)] = known.write_camera(camera)
            shared.setdefault((cameras[_lens(camera)], folder), []).append(name)
        for (reading.existing_camera_id, folder), names in shared.items():
            # Number the images in the order of the photos. Threads number them as they finish, which leads to other cameras each time.
            pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, names, reading)
            if learned is None:
                pycolmap.extract_features(
                    database, folder, names, pycolmap.CameraMode.SINGLE, reading, extraction
                )  # skips photos that have features already
        for path in readable.iterdir():
            path.unlink()
        shutil.rmtree(written, ignore_errors=True)
    readable.rmdir()
    places = {} if learned is None else read_matches(learned)[0]
    with pycolmap.Database.open(database) as known, pycolmap.DatabaseTransaction(known):
        images = known.read_all_images()
        counts = Counter(image.camera_id for image in images)
        for camera in known.read_all_cameras():
            if counts[camera.camera_id] < WELL_SEEN:
                _simplify(camera)
                known.update_camera(camera)
        for image in images:
            image.name = numbers[image.name]
            known.update_image(image)
            if places:
                known.write_keypoints(image.image_id, places[int(image.name)])


def _simplify(camera) -> None:
    """Give a camera (pycolmap.Camera) with few photos the simpler model FEW_CAMERA_MODEL. Its focal length stays."""
    import pycolmap

    focal = camera.mean_focal_length()
    simple = pycolmap.Camera.create_from_model_name(
        camera.camera_id, FEW_CAMERA_MODEL, focal, camera.width, camera.height
    )
    camera.model, camera.params = simple.model, simple.params


def _write_mask(photo: Path, mask: Path, out: Path) -> None:
    """Write a photo's mask as COLMAP reads it: black and white, in the orientation in which the photo is stored."""
    header, pixels = read_header(photo), read_mask(mask)
    if pixels.shape == header.upright[::-1]:
        pixels = np.rot90(pixels, header.turns)
    out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(pixels > 127, 255, 0).astype(np.uint8)).save(out)


def _lens(camera) -> tuple[int, int, float]:
    return camera.width, camera.height, camera.mean_focal_length()


def match_features(database: Path, progress: Callable, learned: Path | None = None) -> None:
    """Match features within each pair of photos from `choose_pairs`. Store the matches in COLMAP's database.

    If `learned` is given, a file by `learned.match_photos`, its matches are stored. `progress("matching", done, total)` is called for every
    100 pairs.
    """
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.filter_stationary_matches = True
    verification.ransac.random_seed = SEED
    listed = database.with_name(database.name + ".pairs.txt")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    matches = {} if learned is None else read_matches(learned)[1]
    all_pairs = choose_pairs(database) if learned is None else sorted(matches)
    for start in range(0, len(all_pairs), 100):
        progress("matching", start, len(all_pairs))
        pairs = all_pairs[start : start + 100]
        listed.write_text("\n".join(f"{a} {b}" for a, b in pairs), encoding="utf-8")
        if learned is None:
            pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification)
        else:
            _write_matches(database, {pair: matches[pair] for pair in pairs})
            pycolmap.verify_matches(database, listed, verification)


def _write_matches(database: Path, matches: dict[tuple[int, int], np.ndarray]) -> None:
    """Write the matches (N, 2) of pairs of photo indices into COLMAP's database. Pairs that it has already stay."""
    import pycolmap

    with pycolmap.Database.open(database) as known, pycolmap.DatabaseTransaction(known):
        images = {int(image.name): image.image_id for image in known.read_all_images()}
        for (a, b), matched in matches.items():
            if not known.exists_matches(images[a], images[b]):
                known.write_matches(images[a], images[b], matched)


def map_one_by_one(photos: list[Path], database: Path, progress: Callable) -> list[Any]:
    """Compute cameras from the feature matches, one photo after the other.

    Returns COLMAP's models (pycolmap.Reconstruction), the one with most photos first. If some photos could not be linked to the others,
    there are several models. Two models share few photos or none. `progress("mapping", done, total)` is called for each photo.
    """
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, ONE_THREAD
    options.min_model_size = 3
    options.extract_colors = False
    placed = 0

    def first() -> None:
        nonlocal placed
        placed = 2
        progress("mapping", placed, len(photos))

    def another() -> None:
        nonlocal placed
        placed = min(placed + 1, len(photos))
        progress("mapping", placed, len(photos))

    written = database.with_name(database.name + ".models")  # COLMAP writes all models here, the small ones too
    written.mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(database, photos[0].parent, written, options, "", first, another)
    return _largest_first(models, database)


def map_at_once(photos: list[Path], database: Path) -> list[Any]:
    """Compute all cameras together (GLOMAP). Return the models as `map_one_by_one` does.

    GLOMAP also links photos that share too little to be placed one after the other. If a photo shares too few points with the others,
    GLOMAP finds its direction from them, but not its distance. This function removes the cameras of such photos.
    """
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads = SEED, ONE_THREAD
    written = database.with_name(database.name + ".models")
    models = pycolmap.global_mapping(database, photos[0].parent, written, options)
    for model in models.values():
        tied = _tied(model)
        for number in set(model.reg_image_ids()) - tied:
            model.deregister_frame(model.image(number).frame_id)
    return _largest_first(models, database)


def _tied(model: Any) -> set[int]:
    """Return the image IDs of a model's images that are tied together by common points.

    The first two tied images are those that share most points. A point is known if at least two tied images show it. Another image is tied
    if it shows at least TIED known points. The distance of an image that is not tied is unknown, because the relative pose of two photos
    has no scale.
    """
    shown = {
        number: {seen.point3D_id for seen in model.image(number).get_observation_points2D()}
        for number in model.reg_image_ids()
    }
    first = max(combinations(shown, 2), key=lambda pair: len(shown[pair[0]] & shown[pair[1]]), default=())
    tied, added, views = set(), set(first), Counter()
    while added:
        views.update(point for number in added for point in shown[number])
        tied |= added
        known = {point for point, count in views.items() if count > 1}
        added = {number for number in shown.keys() - tied if len(shown[number] & known) >= TIED}
    return tied


def _largest_first(models: dict[int, Any], database: Path) -> list[Any]:
    """Remove unsupported cameras from all models, and return those that have cameras left, the one with most photos first."""
    for model in models.values():
        remove_unsupported(model, database)
    placed = (model for model in models.values() if model.num_reg_images())
    return sorted(placed, key=lambda model: model.num_reg_images(), reverse=True)


def epipolar_distance(ours: np.ndarray, theirs: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the Sampson distance (M,) of each match: how far two matched points are from each other's epipolar lines.

    `ours` and `theirs` (M, 2) are the matched points in the two photos, on the image plane at depth 1. `pose` (3, 4) maps points from the
    first camera's coordinates to the second's. Multiply the result by the focal length to get pixels.
    """
    turn, shift = pose[:, :3], pose[:, 3]
    x, y = (np.column_stack([rays, np.ones(len(rays))]) for rays in (ours, theirs))
    essential = np.cross(shift / max(np.linalg.norm(shift), 1e-12), turn, axisb=0, axisc=0)
    line, back = x @ essential.T, y @ essential
    slope = (line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    return np.abs((y * line).sum(axis=1)) / np.sqrt(np.maximum(slope, 1e-24))


def unexplained_part(model: Any, database: Path) -> float:
    """Return the fraction of feature matches that the cameras of a model (a pycolmap.Reconstruction) do not explain.

    Matches of photos without cameras count as unexplained. This detects an object that turns, as on a turntable, while the room stands
    still. COLMAP may then find cameras only for photos whose matches follow the object, and none for photos whose matches follow the room.
    """
    pairs = _explained_matches(model, database)
    explained, total = sum(pair[2] for pair in pairs), sum(pair[3] for pair in pairs)
    return 1 - explained / total if total else 0.0


def _explained_matches(model: Any, database: Path) -> list[tuple[int, int, int, int]]:
    """Count the feature matches of each pair of photos that the cameras of a model (a pycolmap.Reconstruction) explain.

    A match is explained if both its photos have cameras, and its points are at most MATCH_TOLERANCE pixels from their epipolar lines.
    Returns a list of (image ID, image ID, explained matches, all matches).
    """
    import pycolmap

    placed = set(model.reg_image_ids())
    with pycolmap.Database.open(database) as known:
        places = {number: known.read_keypoints(number)[:, :2].astype(float) for number in placed}
        verified = list(zip(*known.read_two_view_geometries(), strict=True))
    rays = {number: model.image(number).camera.cam_from_img(places[number]) for number in placed}
    pairs = []
    for pair, geometry in verified:
        (a, b), matches, explained = pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches, 0
        if {a, b} <= placed:
            ours, theirs = model.image(a), model.image(b)
            pose = (theirs.cam_from_world() * ours.cam_from_world().inverse()).matrix()
            far = epipolar_distance(rays[a][matches[:, 0]], rays[b][matches[:, 1]], pose)
            explained = int((far * ours.camera.mean_focal_length() <= MATCH_TOLERANCE).sum())
        pairs.append((a, b, explained, len(matches)))
    return pairs


def remove_unsupported(model: Any, database: Path) -> None:
    """Remove cameras from a model (a pycolmap.Reconstruction) that contradict most of their photos' matches with other placed photos.

    A camera stays if it explains more than SUPPORTED of these matches. The worst camera goes first, and its matches no longer count
    against its neighbours.
    """
    pairs = _explained_matches(model, database)
    while placed := set(model.reg_image_ids()):
        explained, total = Counter(), Counter()
        for a, b, right, count in pairs:
            if {a, b} <= placed:
                for number in (a, b):
                    explained[number] += right
                    total[number] += count
        worst = min(placed, key=lambda number: explained[number] / max(total[number], 1))
        if explained[worst] > SUPPORTED * total[worst]:
            break
        model.deregister_frame(model.image(worst).frame_id)


def linked_groups(database: Path) -> list[list[int]]:
    """Return the photos that hang together: groups of photo indices, the largest group first, sorted in each group.

    Two photos are linked if they have at least LINKED matches that fit one epipolar geometry. A group has all photos that are linked
    directly or by others. A photo without links is a group of its own.
    """
    import pycolmap

    with pycolmap.Database.open(database) as known:
        numbers = {image.image_id: int(image.name) for image in known.read_all_images()}
        verified = list(zip(*known.read_two_view_geometries(), strict=True))
    links = np.zeros((len(numbers), len(numbers)), bool)
    for pair, geometry in verified:
        if len(geometry.inlier_matches) >= LINKED:
            a, b = pycolmap.pair_id_to_image_pair(pair)
            links[numbers[a], numbers[b]] = True
    _, labels = connected_components(links, directed=False)
    groups = [np.flatnonzero(labels == label).tolist() for label in range(labels.max() + 1)]
    return sorted(groups, key=len, reverse=True)


def color_points(model: Any, photos: list[Path]) -> None:
    """Give each point of a model (a pycolmap.Reconstruction) the mean sRGB colour of the pixels that it was seen at.

    The name of an image in the model is the index of its photo in `photos`. COLMAP can colour points itself, but does not read HEIC.
    """
    sums = {number: np.zeros(4) for number in model.points3D}  # red, green, blue, count
    for number in model.reg_image_ids():
        photo = photos[int(model.image(number).name)]
        pixels = np.rot90(read_image(photo)[0], read_header(photo).turns)  # as stored, like COLMAP's features
        height, width = pixels.shape[:2]
        for seen in model.image(number).get_observation_points2D():
            x, y = np.clip(seen.xy.astype(int), 0, (width - 1, height - 1))
            sums[seen.point3D_id] += (*pixels[y, x], 1)
    for number, (*color, count) in sums.items():
        model.point3D(number).color = np.rint(np.divide(color, count)).astype(np.uint8)
