"""Find the cameras of photos by structure from motion, with COLMAP (pycolmap).

COLMAP runs in a child process, for three reasons: its OpenMP conflicts with torch's on some systems, it cannot be interrupted, and it ends
its process when it aborts.

If the camera moves around an object that stands still, the surroundings help to find the cameras. Therefore the whole photos are used
first, with or without masks.

If the object stands on a turntable instead, the surroundings do not turn with it and lead to wrong cameras. Therefore matches at the same
pixel in both photos are dropped. This does not help if the camera also moved a little: some photos then get cameras that follow the
turntable, others follow the surroundings, and some get no camera. (The cameras of 66 photos of a bronze head were 19° wrong on average.)
Such cameras leave feature matches unexplained. If there are masks, the cameras are then found anew from the pixels inside them. The new
cameras are kept if they explain more matches. Wrong cameras of few photos, or of photos with rich surroundings, may explain nearly all
matches, so masks are tried where more than DOUBTFUL of them are unexplained. Inside the masks, weaker features are used, too, because a
shiny object has few strong ones. If many matches remain unexplained, the user gets a warning.

Cameras that contradict most of their photo's matches are removed from every result (`remove_unsupported`), so that no result wins by
wrong cameras.

If fewer than PLACED of the photos get a camera, the same is tried with learned features (`learned.py`), where these are installed. The
better of the two results is used.
"""

import contextlib
import hashlib
import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from refgs.capture import find_layout, learned
from refgs.capture.colmap_steps import (
    SEED,
    color_points,
    extract_features,
    linked_groups,
    map_at_once,
    map_one_by_one,
    match_features,
    unexplained_part,
)
from refgs.capture.contact_sheet import write_contact_sheet
from refgs.capture.files import Files, find_photos, photo_folder
from refgs.capture.images import read_header, read_mask
from refgs.capture.mask_files import find_masks
from refgs.capture.region import WHITE_MASKS, empty_masks
from refgs.errors import InputError
from refgs.paths import check_folder, check_room, disk_errors_named

PLACED = 0.9  # part of the photos, below which learned features are tried
GROUPS, SPANS = 4, 4  # groups of photos that an error names, and spans of names in each
SHEET = "unplaced/groups.png"  # in a folder of its own, where it is not taken for a photo
LEARNED = f"learned features find more on plain and shiny things (to install them: {learned.INSTALL})"
UNEXPLAINED = 0.2  # part of the matches, above which the cameras are not trusted
DOUBTFUL = 0.02  # part of the matches, above which masks are tried; of 17 photos of a turning head, 0.04 with all cameras wrong
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
    """Hold what COLMAP found: which photos got a camera, the mean reprojection `error` in pixels, and reasons to doubt the cameras.

    `placed` are the photos that got a camera. `unexplained` is the fraction of feature matches that the cameras do not explain. `apart` is
    the largest other group of photos that COLMAP could link to each other, but not to `placed`; it is empty if there is none. `inside` is
    true if only the pixels inside the masks were used, `learned` if the features were learned ones. `groups` are the photos' indices by
    which of them hang together (see `linked_groups`). `model` is the folder with the COLMAP model, if any photo was placed.
    """

    placed: set[Path]
    error: float
    unexplained: float
    apart: set[Path]
    inside: bool
    learned: bool
    groups: list[list[int]]
    model: Path


def find_cameras(folder: Path, report: Callable[[str, dict[str, Any]], None]) -> dict[str, Any]:
    """Find the cameras of the photos that `find_photos` lists. Write them to the folder's subfolder `sparse/0` as a COLMAP model.

    The whole photos are used first. This can fail in two ways: too few photos get a camera, or the cameras leave many feature matches
    unexplained, as for an object on a turntable. If it fails and all photos have masks, the cameras are found anew from the pixels inside
    the masks. If fewer than PLACED of the photos got a camera, and learned features are installed, all this is done with learned features.
    The better result is used (see `_better`).

    Returns a dict: `photos` is the number of photos, `placed` is how many of them got a camera, `error` is the mean reprojection error in
    pixels, `inside` is true if only the pixels inside the masks were used, and `learned` is true if the features were learned ones.

    `report(event, facts)` is called with one of two events:

    - "progress": the dict `facts` has `stage` ("features", "matching" or "mapping"), `done` and `total`.
    - "warning": the dict `facts` has the text `what`.

    An interrupted call leaves `sparse.tmp`. The next call for the same photos resumes from it. Raises InputError if there is no such
    folder, if there are fewer than three photos, if all masks are empty, if there are cameras already, if fewer than half of the photos got
    a camera, or if the photos fall into two large groups without common features. If fewer than half got a camera, the error says which
    photos hang together, and names a contact sheet of them, the file SHEET in the folder.
    """
    folder = Path(folder)
    check_folder(folder)
    photos = find_photos(folder)
    if len(photos) < 3:
        raise InputError(
            f"{folder}: {len(photos)} photos in it or in its folders images and input; thirty or more are good"
        )
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
    _remove_sheet(folder)
    top = photo_folder(Files(folder))
    with disk_errors_named([folder], "search again"):
        found = _find_inside_if_needed(top, photos, masks, database, False, report)
        few = len(found.placed) < PLACED * len(photos)
        if few and learned.installed():
            again = database.with_name(f"{database.name}.learned")
            found = _better(found, _find_inside_if_needed(top, photos, masks, again, True, report), photos)
    placed = found.placed
    if found.apart and len(found.apart) >= len(placed) / 2 and len(placed | found.apart) >= 0.75 * len(photos):
        shutil.rmtree(work)
        ours, others = min(placed).name, min(found.apart).name
        raise InputError(
            f"{folder}: the photos are of two sessions: {len(placed)} from {ours} on and {len(found.apart)} from {others} "
            "on share nothing. Put each session in a folder of its own, or add photos that show what both show."
        )
    if not _enough(placed, photos):
        shutil.rmtree(work)
        raise InputError(
            f"{folder}: only {len(placed)} of {len(photos)} photos could be placed. {_describe_groups(folder, photos, found.groups)}"
            "Take more, each showing most of what the one before it shows, sharp, in unchanging light; lay a patterned mat or newspaper "
            f"under an object that is plain or shiny{'' if learned.installed() else f'; {LEARNED}'}."
        )
    if missing := [photo.name for photo in photos if photo not in placed]:
        names = ", ".join(missing[:5]) + (" …" if len(missing) > 5 else "")
        what = f"{len(missing)} of {len(photos)} photos could not be placed and are left out: {names}; more photos between them help"
        if not masks:
            what += (
                "; if the object turned, put masks of the object in the folder masks, remove sparse and search again"
            )
        if few and not learned.installed():
            what += f"; {LEARNED}"
        report("warning", {"what": what})
    if found.unexplained > UNEXPLAINED:
        what = f"the cameras do not explain {found.unexplained:.0%} of what the photos have in common, {DOUBTED}"
        report("warning", {"what": f"{what}. {WITH_MASKS if masks else WITHOUT_MASKS}"})
    found.model.rename(work / "0")
    for path in list(work.glob(f"{database.name}*")):
        _remove(path)
    work.rename(folder / "sparse")
    facts = {"placed": len(placed), "photos": len(photos), "error": found.error}
    return facts | {"inside": found.inside, "learned": found.learned}


def _find_inside_if_needed(
    top: Path, photos: list[Path], masks: list[Path], database: Path, use_learned: bool, report: Callable
) -> _Found:
    """Find cameras from the whole photos. If this fails and there are masks, find them anew from the pixels inside the masks.

    It fails if too few photos get a camera, or if the cameras leave many feature matches unexplained. Returns the better result. Where
    the cameras leave some matches unexplained, masks are tried, too. Their result is then kept if it leaves less than half as many. If
    `use_learned` is true, the features are learned ones.
    """

    def find(masks: list[Path], database: Path) -> _Found:
        matches = None
        if use_learned:
            matches = database.with_name(f"{database.name}.npz")
            if not matches.exists():
                learned.match_photos(
                    photos,
                    masks,
                    matches,
                    lambda stage, done, total: report("progress", {"stage": stage, "done": done, "total": total}),
                )
        return _run_colmap_in_child(top, photos, masks, database, matches, report)

    found = find([], database)
    few = not _enough(found.placed, photos)
    failed = few or found.unexplained > UNEXPLAINED
    if masks and (few or found.unexplained > DOUBTFUL):
        inside = find(masks, database.with_name(f"{database.name}.inside"))
        better = few or inside.unexplained < found.unexplained * (1 if failed else 0.5)
        if _enough(inside.placed, photos) and better:
            return inside
    return found


def _better(one: _Found, other: _Found, photos: list[Path]) -> _Found:
    """Return the better of two results: that with more photos placed, or as many with a lower reprojection error.

    Cameras that leave many feature matches unexplained lose against a usable result without this fault.
    """

    def rank(found: _Found) -> tuple:
        trusted = _enough(found.placed, photos) and found.unexplained <= UNEXPLAINED
        return trusted, len(found.placed), -found.error

    return max(one, other, key=rank)


def _describe_groups(folder: Path, photos: list[Path], groups: list[list[int]]) -> str:
    """Say in one sentence which photos hang together, the largest group first, and write a contact sheet of the groups.

    `groups` has indices into `photos`. Returns "" if no two photos hang together.
    """
    linked = [group for group in groups if len(group) > 1]
    if not linked:
        return ""
    alone = sorted(number for group in groups if len(group) == 1 for number in group)
    sheet = folder / SHEET
    with disk_errors_named([folder], "search again"):
        sheet.parent.mkdir(exist_ok=True)
        write_contact_sheet([[photos[number] for number in group] for group in [*linked, alone] if group], sheet)
    said = [f"{len(group)} ({_name_spans(group, photos)})" for group in linked[:GROUPS]]
    if len(linked) > GROUPS:
        said.append(f"{len(linked) - GROUPS} smaller groups")
    if alone:
        said.append(f"{len(alone)} with none ({_name_spans(alone, photos)})")
    return f"These hang together: {', '.join(said)}; see {sheet}. "


def _name_spans(group: list[int], photos: list[Path]) -> str:
    """Name a group of photos, given by sorted indices. Of photos that follow each other, name the first and the last."""
    spans: list[list[int]] = []
    for number in group:
        if not spans or number != spans[-1][-1] + 1:
            spans.append([number])
        spans[-1][1:] = [number]
    names = [" to ".join(photos[number].name for number in dict.fromkeys(span)) for span in spans[:SPANS]]
    return ", ".join(names) + (" …" if len(spans) > SPANS else "")


def _remove_sheet(folder: Path) -> None:
    """Remove the contact sheet of an earlier search, and its folder if it has nothing else."""
    sheet = folder / SHEET
    sheet.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        sheet.parent.rmdir()


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def _enough(placed: set[Path], photos: list[Path]) -> bool:
    """Tell whether enough photos got a camera: at least three, and at least half of `photos`. `placed` are the photos with a camera."""
    return len(placed) >= max(3, len(photos) / 2)


def _find_masks(folder: Path, photos: list[Path]) -> list[Path]:
    """Return the mask file of each photo, in the order of the photos. Return [] if any photo has no mask.

    Raises InputError if a mask does not have the size of its photo.
    """
    found = find_masks(Files(folder), photos)
    if len(found) < len(photos):
        return []
    masks = [found[photo] for photo in photos]
    for photo, mask in zip(photos, masks, strict=True):
        header, size = read_header(photo), read_header(mask).upright
        if size not in (header.upright, header[:2]):
            raise InputError(
                f"{mask}: the mask has {size[0]}×{size[1]} pixels but its photo {photo.name} {header.upright[0]}×{header.upright[1]}. "
                "Make the mask the photo's size."
            )
    return masks


def _uniform(masks: list[Path]) -> bool:
    """Tell whether all masks are white everywhere. Raise InputError if all masks are empty.

    Reading stops at the first mask that shows both an object and its surroundings. So usually only one mask is read.
    """
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
    top: Path, photos: list[Path], masks: list[Path], database: Path, matches: Path | None, report: Callable
) -> _Found:
    """Run `_run_colmap` in a child process, and return the _Found that it sends. The process is ended even if this call is interrupted.

    `report("progress", facts)` is called with the progress that the process sends. Raises InputError if a photo cannot be read.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(top, photos, masks, database, matches, theirs), daemon=True)
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
        check_room(database.parent)  # COLMAP does not say that the disk is full
        if process.exitcode == -9:
            raise MemoryError from None  # Linux kills the largest program when memory is full
        raise RuntimeError(f"COLMAP ended with status {process.exitcode}") from None
    finally:
        process.kill()
        process.join()


def end_with_parent() -> None:
    """Make this child process end as soon as its parent does, even in the middle of its work."""

    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _child(
    top: Path, photos: list[Path], masks: list[Path], database: Path, matches: Path | None, events: Connection
) -> None:
    """Run `_run_colmap` in a child process. If it raises an InputError, send the error through the pipe `events`.

    The child ends when its parent process ends, even if the parent was killed.
    """
    end_with_parent()
    try:
        _run_colmap(top, photos, masks, database, matches, events)
    except InputError as error:
        events.send(error)


def _run_colmap(
    top: Path, photos: list[Path], masks: list[Path], database: Path, matches: Path | None, events: Connection
) -> None:
    """Run COLMAP on the photos and write its model beside the database. Send progress, and at the end a _Found, to the pipe `events`.

    The model names photos by their paths in the folder `top`. With `masks`, only the pixels inside them are used. `matches` is a file by
    `learned.match_photos`; if it is None, SIFT is used.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    pycolmap.set_random_seed(SEED)

    def progress(stage: str, done: int, total: int) -> None:
        events.send({"stage": stage, "done": done, "total": total})

    best, found = _search(photos, masks, database, progress, matches)
    if best is not None:
        color_points(best, photos)
        for number in best.reg_image_ids():
            best.image(number).name = photos[int(best.image(number).name)].relative_to(top).as_posix()
        found.model.mkdir(exist_ok=True)
        best.write_binary(found.model)
    events.send(found)


def _search(
    photos: list[Path], masks: list[Path], database: Path, progress: Callable, matches: Path | None = None
) -> tuple[Any, _Found]:
    """Find cameras from the pixels inside the masks. If `masks` is empty, use the whole photos. For `matches`, see `_run_colmap`.

    Returns the largest model and a _Found about it. The model is a pycolmap.Reconstruction, whose images are named by the photos' indices.
    It is None if no photo got a camera.
    """
    import pycolmap

    with pycolmap.Database.open(database) as known:
        names = [image.name for image in known.read_all_images()]
        extracted = bool(names) and all(name.isdigit() for name in names)  # the last step of `extract_features`
    if not extracted:
        extract_features(photos, masks, database, progress, matches)
    match_features(database, progress, matches)
    groups = linked_groups(database)

    def describe(models: list[Any]) -> tuple[Any, _Found]:
        """Return the largest COLMAP model, which is the first of `models`, None if there is none, and a _Found that describes it."""
        model = database.with_name(f"{database.name}.model")
        if not models:
            return None, _Found(set(), 0.0, 0.0, set(), bool(masks), matches is not None, groups, model)
        placed, *others = ({photos[int(m.image(number).name)] for number in m.reg_image_ids()} for m in models)
        apart = max((group for group in others if group.isdisjoint(placed)), key=len, default=set())
        error, unexplained = models[0].compute_mean_reprojection_error(), unexplained_part(models[0], database)
        return models[0], _Found(placed, error, unexplained, apart, bool(masks), matches is not None, groups, model)

    best, found = describe(map_one_by_one(photos, database, progress))
    if len(found.placed) < len(photos):
        other, at_once = describe(map_at_once(photos, database))
        if len(at_once.placed) > len(found.placed) and at_once.unexplained <= UNEXPLAINED:
            best, found = other, at_once
    return best, found
