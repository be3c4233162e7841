"""Find the cameras of photos by structure from motion, with COLMAP (pycolmap).

COLMAP runs in a child process, for three reasons: its OpenMP conflicts with torch's on some systems, it cannot be interrupted, and it ends
its process when it aborts.

If the camera moves around an object that stands still, the surroundings help to find the cameras. Therefore the whole photos are used
first, with or without masks.

If the object stands on a turntable instead, the surroundings do not turn with it and lead to wrong cameras. Therefore matches at the same
pixel in both photos are dropped. This does not help if the camera also moved a little: some cameras then follow the turntable and others
the surroundings (all 66 photos of a bronze head got cameras, 19° wrong on average). Such cameras disagree with many feature matches. If
there are masks, the cameras are then found anew from the pixels inside them, and kept if they disagree with less. A shiny object has few
strong features, so weaker ones count there. Without masks, the user gets a warning.
"""

import hashlib
import multiprocessing
import shutil
import signal
from collections import Counter
from collections.abc import Callable
from itertools import combinations
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from refgs import CORES
from refgs.capture import find_layout
from refgs.capture.files import Masks, find_photos
from refgs.capture.images import read_focal_length, read_header, read_image, read_mask, write_for_colmap
from refgs.capture.region import WHITE_MASKS, empty_masks
from refgs.errors import InputError

SIDE = 1600  # pixels on the longer side for finding features; presets train on fewer
ALL_PAIRS = 150  # photos; up to this many, every pair is matched
CAMERA_MODEL = "RADIAL"  # with few photos a second focal length and tangential distortion only fit noise
SEED = 1
TIED = 3  # points that a photo must share with others; COLMAP asks for 30 where it places one photo after the other
MATCH_TOLERANCE = 8.0  # pixels from its epipolar line, above which a match contradicts the cameras; COLMAP allows 4
CONTRADICTED = 0.2  # part of the matches, above which the cameras are not trusted
FEW_CAMERA_MODEL = "SIMPLE_RADIAL"  # of what tells little about the lens: see the next two
WELL_SEEN = 10  # photos of one lens and size. 23 of a statue, cropped to 7 sizes, are all placed; with RADIAL, 3 are
INSIDE_CAMERA_MODEL = FEW_CAMERA_MODEL  # an object fills little of the photos: with RADIAL 5 of 66 of a head are placed
FAINT = 0.002  # contrast of the weakest features inside masks; COLMAP's is 0.0067, which places 60 of 66 photos of a dark bronze, not all
INSIDE_FEATURES = (
    16384  # COLMAP takes the largest 8192 of a photo before it looks at the mask; the surroundings may use these up
)
DOUBTED = "as happens if an object turns in front of still surroundings: look at the cameras before you train (Show Cameras in Blender)"
AGAIN = "or put something plain behind the object, or walk around it, and take the photos again"
WITHOUT_MASKS = (
    f"If they are wrong, put masks of the object in the folder masks, remove sparse and search again; {AGAIN}"
)
WITH_MASKS = (
    "If they are wrong, see that the masks are white on what turns and nothing else, remove sparse and search again; "
    f"{AGAIN}"
)


class _Found(NamedTuple):
    """Hold what COLMAP found: names of the photos that got a camera, the mean reprojection error (pixels), and what casts doubt on them.

    `contradicted` is the fraction of feature matches that disagree with the cameras. `apart` are the names of photos that fit together but
    share nothing with those placed. `inside` says that only the pixels inside the masks were used.
    """

    placed: set[str]
    error: float
    contradicted: float
    apart: set[str]
    inside: bool


def find_cameras(folder: Path, report: Callable[[str, dict[str, Any]], None]) -> dict[str, Any]:
    """Find the cameras of the photos in a folder, or in its subfolder `images`. Write them to the subfolder `sparse/0` as a COLMAP model.

    If these cameras contradict the photos or there are hardly any, and all photos have masks, cameras are found anew from the pixels inside
    the masks. This is the way for an object on a turntable.

    Returns a dict: `photos` is their number, `placed` is how many got a camera, `error` is the mean reprojection error in pixels, and
    `inside` is whether only the pixels inside the masks were used.

    `report(event, facts)` is called with "progress" and a dict of `stage` ("features", "matching" or "mapping"), `done` and `total`, or
    with "warning" and a dict with the text `what`.

    An interrupted call leaves `sparse.tmp`. The next call for the same photos resumes from it. Raises InputError if there are fewer than
    three photos, if all masks are empty, if there are cameras already, if fewer than half of the photos got a camera, or if the photos fall
    into two large groups that share nothing.
    """
    folder = Path(folder)
    photos = find_photos(folder)
    if len(photos) < 3:
        raise InputError(f"{folder}: {len(photos)} photos in it or in its images folder; thirty or more are good")
    if find_layout(folder) is not None or (folder / "sparse").exists():
        raise InputError(f"{folder}: it has cameras already; to find them anew remove them (sparse, transforms*.json)")
    for photo in photos:
        read_header(photo)
    masks = _find_masks(folder, photos)
    if masks and _uniform(masks):
        report("warning", {"what": WHITE_MASKS})
        masks = []
    work = folder / "sparse.tmp"
    work.mkdir(exist_ok=True)
    database = work / f"{_hash_of_files([*photos, *masks])}.db"
    for path in list(work.iterdir()):  # from other photos, or half written
        if not path.name.startswith(database.name):
            _remove(path)
    model = work / "0"
    found = _run_colmap_in_child(photos, masks, database, model, report)
    placed = found.placed
    if found.apart and len(found.apart) >= len(placed) / 2 and len(placed | found.apart) >= 0.75 * len(photos):
        shutil.rmtree(work)
        raise InputError(
            f"{folder}: the photos are of two sessions: {len(placed)} from {min(placed)} on and {len(found.apart)} from {min(found.apart)} "
            "on share nothing. Put each session in a folder of its own, or add photos that show what both show."
        )
    if not _enough(placed, photos):
        shutil.rmtree(work)
        raise InputError(
            f"{folder}: only {len(placed)} of {len(photos)} photos could be placed. Take more, each showing most of what the one "
            "before it shows, sharp, in unchanging light; lay a patterned mat or newspaper under an object that is plain or shiny."
        )
    if missing := [photo.name for photo in photos if photo.name not in placed]:
        names = ", ".join(missing[:5]) + (" …" if len(missing) > 5 else "")
        what = f"{len(missing)} of {len(photos)} photos could not be placed and are left out: {names}; more photos between them help"
        report("warning", {"what": what})
    if found.contradicted > CONTRADICTED:
        what = f"the cameras contradict {found.contradicted:.0%} of what the photos have in common, {DOUBTED}"
        report("warning", {"what": f"{what}. {WITH_MASKS if masks else WITHOUT_MASKS}"})
    for path in list(work.glob(f"{database.name}*")):
        _remove(path)
    work.rename(folder / "sparse")
    return {"placed": len(placed), "photos": len(photos), "error": found.error, "inside": found.inside}


def pairs(count: int) -> list[tuple[int, int]]:
    """Choose which pairs of photos to match. Return pairs of indices; photos are sorted by name.

    With up to ALL_PAIRS photos, this is every pair. With more, each photo is matched with the next ten, and with those 16, 32, 64 … places
    further on. The last photos are matched with the first, because photographers walk around an object. To link several rounds around the
    object, the photos 0, 10, 20 … are also matched with one another.
    """
    if count <= ALL_PAIRS:
        return list(combinations(range(count), 2))
    steps = [*range(1, 11), *(2**k for k in range(4, count.bit_length() - 1))]
    near = {tuple(sorted((i, (i + step) % count))) for i in range(count) for step in steps}
    return sorted(near | set(combinations(range(0, count, 10), 2)))


def epipolar_distance(ours: np.ndarray, theirs: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the Sampson distance (M,) of each match: how far two matched points are from each other's epipolar lines.

    `ours` and `theirs` (M, 2) are the matched points in the two photos, on the image plane at depth 1. `pose` (3, 4) maps points from the
    first camera's coordinates to the second's.
    """
    turn, shift = pose[:, :3], pose[:, 3]
    x, y = (np.column_stack([rays, np.ones(len(rays))]) for rays in (ours, theirs))
    essential = np.cross(shift / max(np.linalg.norm(shift), 1e-12), turn, axisb=0, axisc=0)
    line, back = x @ essential.T, y @ essential
    slope = (line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    return np.abs((y * line).sum(axis=1)) / np.sqrt(np.maximum(slope, 1e-24))


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def _enough(placed: set[str], photos: list[Path]) -> bool:
    """Return whether enough photos got a camera to make a capture of them."""
    return len(placed) >= max(3, len(photos) / 2)


def _find_masks(folder: Path, photos: list[Path]) -> list[Path]:
    """Return the mask file of each photo. Return an empty list unless all photos have one. Raise InputError if one has another size."""
    known = Masks(folder)
    masks = [known.find(photo, None, "") for photo in photos]
    if not all(masks):
        return []
    for photo, mask in zip(photos, masks, strict=True):
        header, size = read_header(photo), read_header(mask).upright
        if size not in (header.upright, header[:2]):
            raise InputError(
                f"{mask}: the mask has {size[0]}×{size[1]} pixels but its photo {photo.name} {header.upright[0]}×{header.upright[1]}. "
                "Make the mask the photo's size."
            )
    return masks


def _uniform(masks: list[Path]) -> bool:
    """Return whether all masks are white everywhere. Raise InputError if all are empty. Few are read where masks show an object."""
    empty = white = True
    for mask in masks:
        inside = read_mask(mask) > 127
        empty, white = empty and not inside.any(), white and inside.all()
        if not (empty or white):
            return False
    if empty:
        raise empty_masks(masks)
    return True


def _hash_of_files(files: list[Path]) -> str:
    """Return a hash of the files' names, sizes and dates. It changes if a photo or mask is edited."""
    facts = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:16]


def _run_colmap_in_child(
    photos: list[Path], masks: list[Path], database: Path, model: Path, report: Callable
) -> _Found:
    """Run `_run_colmap` in a child process and return its result. The process is ended even if this call is interrupted.

    `report("progress", facts)` is called with the progress that the process sends. Raises InputError if a photo cannot be read.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(photos, masks, database, model, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        while True:
            if ours.poll(0.2):  # short, because an interrupt does not wake it
                event = ours.recv()
                if isinstance(event, InputError):
                    raise event
                if isinstance(event, _Found):
                    return event
                report("progress", event)
    except EOFError:
        process.join()
        raise RuntimeError(f"COLMAP ended with status {process.exitcode}") from None
    finally:
        process.kill()
        process.join()


def _child(photos: list[Path], masks: list[Path], database: Path, model: Path, events: Connection) -> None:
    """Run `_run_colmap`, and send an InputError to the pipe `events`."""
    try:
        _run_colmap(photos, masks, database, model, events)
    except InputError as error:
        events.send(error)


def _run_colmap(photos: list[Path], masks: list[Path], database: Path, model: Path, events: Connection) -> None:
    """Run COLMAP on the photos and write its model to the folder `model`. Send progress, and at the end a _Found, to the pipe `events`.

    The whole photos are used first. If that fails or its cameras are doubtful, the pixels inside the masks are tried.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    pycolmap.set_random_seed(SEED)

    def progress(stage: str, done: int, total: int) -> None:
        events.send({"stage": stage, "done": done, "total": total})

    best, found = _search(photos, [], database, progress)
    if masks and (not _enough(found.placed, photos) or found.contradicted > CONTRADICTED):
        other, inside = _search(photos, masks, database.with_name(f"{database.name}.inside"), progress)
        better = not _enough(found.placed, photos) or inside.contradicted < found.contradicted
        if _enough(inside.placed, photos) and better:
            best, found = other, inside
    if best is not None:
        _color_points(best, photos)
        for number in best.reg_image_ids():
            best.image(number).name = photos[int(best.image(number).name)].name
        model.mkdir()
        best.write_binary(model)
    events.send(found)


def _search(photos: list[Path], masks: list[Path], database: Path, progress: Callable) -> tuple[Any, _Found]:
    """Find cameras from the whole photos, or from the pixels inside the masks if there are any.

    Returns the largest model (a pycolmap.Reconstruction, whose images are named by the photos' indices) and what there is to say about it.
    The model is None if no photo got a camera.
    """
    import pycolmap

    with pycolmap.Database.open(database) as known:
        names = [image.name for image in known.read_all_images()]
        extracted = bool(names) and all(name.isdigit() for name in names)  # the last step of `_extract`
    if not extracted:
        _extract(photos, masks, database, progress)
    _match(len(photos), database, progress)
    models = _map(photos, database, progress)
    best, found = _describe(models, photos, database, bool(masks))
    if len(found.placed) < len(photos):
        other, at_once = _describe(_map_at_once(photos, database), photos, database, bool(masks))
        if len(at_once.placed) > len(found.placed) and at_once.contradicted <= CONTRADICTED:
            best, found = other, at_once
    return best, found


def _describe(models: list[Any], photos: list[Path], database: Path, inside: bool) -> tuple[Any, _Found]:
    """Return the largest model and what there is to say about it. `models` are sorted, the largest first. There may be none."""
    if not models:
        return None, _Found(set(), 0.0, 0.0, set(), inside)
    best = models[0]
    placed, *groups = (
        {photos[int(model.image(number).name)].name for number in model.reg_image_ids()} for model in models
    )
    apart = max((group for group in groups if group.isdisjoint(placed)), key=len, default=set())
    return best, _Found(placed, best.compute_mean_reprojection_error(), _contradicted(best, database), apart, inside)


def _extract(photos: list[Path], masks: list[Path], database: Path, progress: Callable) -> None:
    """Extract image features of all photos into COLMAP's database. If there are masks, only features inside them are kept.

    Photos with the same size and focal length (EXIF) share their intrinsics. COLMAP gets a temporary JPEG of a photo that it cannot read.
    At the end the photos in the database are renamed to their indices, because names in COLMAP's file of pairs cannot have spaces.
    """
    import pycolmap

    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = CAMERA_MODEL
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = SIDE
    written = database.with_name(f"{database.name}.masks")
    if masks:
        reading.camera_model = INSIDE_CAMERA_MODEL
        reading.mask_path = written
        extraction.sift.peak_threshold = FAINT
        extraction.sift.max_num_features = INSIDE_FEATURES
    with pycolmap.Database.open(database) as known:
        cameras = {_lens(camera): camera.camera_id for camera in known.read_all_cameras()}
    readable = database.with_name(f"{database.name}.photos")
    readable.mkdir(exist_ok=True)
    numbers: dict[str, str] = {}
    for start in range(0, len(photos), 2 * CORES):
        progress("features", start, len(photos))
        shared: dict[tuple[int, Path], list[str]] = {}
        for number, photo in list(enumerate(photos))[start : start + 2 * CORES]:
            folder, name = photo.parent, photo.name
            if write_for_colmap(photo, readable / f"{number}.jpg"):
                # In a folder of its own, because a photo may be named 0.jpg.
                folder, name = database.parent, f"{readable.name}/{number}.jpg"
            numbers[name] = str(number)
            if masks:
                _write_mask(photo, masks[number], written / f"{name}.png")
            camera = pycolmap.infer_camera_from_image(folder / name, reading)
            if focal := read_focal_length(photo):  # COLMAP knows only that for 35 mm film, in JPEG and PNG
                camera.focal_length, camera.has_prior_focal_length = focal, True
            if _lens(camera) not in cameras:
                with pycolmap.Database.open(database) as known:
                    cameras[_lens(camera)] = known.write_camera(camera)
            shared.setdefault((cameras[_lens(camera)], folder), []).append(name)
        for (reading.existing_camera_id, folder), names in shared.items():
            pycolmap.extract_features(
                database, folder, names, pycolmap.CameraMode.SINGLE, reading, extraction
            )  # skips photos that have features already
        for path in readable.iterdir():
            path.unlink()
        shutil.rmtree(written, ignore_errors=True)
    readable.rmdir()
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


def _simplify(camera) -> None:
    """Give a camera (pycolmap.Camera) the model FEW_CAMERA_MODEL. Its focal length stays."""
    import pycolmap

    focal = camera.mean_focal_length()
    simple = pycolmap.Camera.create_from_model_name(
        camera.camera_id, FEW_CAMERA_MODEL, focal, camera.width, camera.height
    )
    camera.model, camera.params = simple.model, simple.params


def _write_mask(photo: Path, mask: Path, out: Path) -> None:
    """Write a photo's mask as COLMAP reads it: black and white, and lying as the photo is stored."""
    header, pixels = read_header(photo), read_mask(mask)
    if pixels.shape == header.upright[::-1]:
        pixels = np.rot90(pixels, header.turns)
    out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(pixels > 127, 255, 0).astype(np.uint8)).save(out)


def _color_points(model: Any, photos: list[Path]) -> None:
    """Give each point of a model (a pycolmap.Reconstruction) the mean sRGB colour of the pixels that it was seen at.

    The images in the model are named by the photos' indices. COLMAP does the same, but not for HEIC.
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


def _lens(camera) -> tuple[int, int, float]:
    return camera.width, camera.height, camera.mean_focal_length()


def _match(count: int, database: Path, progress: Callable) -> None:
    """Match the features of `count` photos, in the pairs that `pairs(count)` chooses. Store the matches in COLMAP's database."""
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.filter_stationary_matches = True
    verification.ransac.random_seed = SEED
    listed = database.with_name(database.name + ".pairs.txt")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    with pycolmap.Database.open(database) as known:
        names = {image.name for image in known.read_all_images()}
    all_pairs = [f"{a} {b}" for a, b in pairs(count) if str(a) in names and str(b) in names]
    for start in range(0, len(all_pairs), 100):
        progress("matching", start, len(all_pairs))
        listed.write_text("\n".join(all_pairs[start : start + 100]), encoding="utf-8")
        pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification)


def _contradicted(model: Any, database: Path) -> float:
    """Return the fraction of feature matches that disagree with the cameras of a model (a pycolmap.Reconstruction).

    A match disagrees if its points are more than MATCH_TOLERANCE pixels from their epipolar lines.
    """
    import pycolmap

    placed = set(model.reg_image_ids())
    with pycolmap.Database.open(database) as known:
        places = {number: known.read_keypoints(number)[:, :2].astype(float) for number in placed}
        verified = list(zip(*known.read_two_view_geometries(), strict=True))
    rays = {number: model.image(number).camera.cam_from_img(places[number]) for number in placed}
    wrong, total = 0, 0
    for pair, geometry in verified:
        (a, b), matches = pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches
        if {a, b} <= placed:
            ours, theirs = model.image(a), model.image(b)
            pose = (theirs.cam_from_world() * ours.cam_from_world().inverse()).matrix()
            far = (
                epipolar_distance(rays[a][matches[:, 0]], rays[b][matches[:, 1]], pose)
                * ours.camera.mean_focal_length()
            )
            wrong, total = wrong + int((far > MATCH_TOLERANCE).sum()), total + len(far)
    return wrong / max(total, 1)


def _map(photos: list[Path], database: Path, progress: Callable) -> list[Any]:
    """Compute cameras from the feature matches, one photo after the other.

    COLMAP may return several models that share few photos or none. Return them (pycolmap.Reconstruction), the one with most photos first.
    """
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
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
    return _largest_first(
        pycolmap.incremental_mapping(database, photos[0].parent, written, options, "", first, another)
    )


def _map_at_once(photos: list[Path], database: Path) -> list[Any]:
    """Compute all cameras together (GLOMAP). Return the models as `_map` does.

    This links photos that share too little to be placed one after the other. Photos that it places by their direction alone, and not by
    points that several of them show, lose their cameras: how far apart they are was not known.
    """
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = SEED
    written = database.with_name(database.name + ".models")
    models = pycolmap.global_mapping(database, photos[0].parent, written, options)
    for model in models.values():
        tied = _tied(model)
        for number in set(model.reg_image_ids()) - tied:
            model.deregister_frame(model.image(number).frame_id)
    return _largest_first({number: model for number, model in models.items() if model.num_reg_images()})


def _tied(model: Any) -> set[int]:
    """Return the largest set of a model's images that common points hold together, grown from the two that share most points.

    An image is tied if it shows TIED points that two tied images show. Otherwise nothing says how far away it is: relative poses of two
    photos have no scale.
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


def _largest_first(models: dict[int, Any]) -> list[Any]:
    return sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
