"""Save the add-on's paths relative to the .blend file (`//`), so that a copied project uses its own run and capture.

While a .blend is open, these paths are absolute. They are made relative before it is saved, and absolute again afterwards. Blender itself
makes the paths of images relative, but not paths in other properties.

A .blend that was copied alone may still lead into the runs of the original. `check_own` refuses to write there.
"""

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy

from .errors import InputError
from .nodes.panorama_world import get_light, is_panorama
from .scene.camera_objects import MASK, PHOTO, STROKES
from .scene.capture_cameras import CAPTURE
from .scene.run_parts import EXAMPLE, FOLDER

SAVED = "refgs_saved"  # custom property of a scene: the file that it was saved in
BORROWED = "refgs_borrowed"  # custom property of a scene, JSON: folders of another .blend, of which this one is a copy, and that .blend
_EXAMPLE_END = "/" + "/".join(EXAMPLE.parts[-3:])


def check_own(scene: bpy.types.Scene, folder: Path) -> None:
    """Raise InputError if a folder with results belongs to another .blend, of which the open one is a copy."""
    owner = json.loads(scene.get(BORROWED, "{}")).get(str(folder))
    if owner and os.path.isfile(owner) and not _same(owner, bpy.data.filepath):
        raise InputError(
            f"{folder} belongs to {owner}, of which this file is a copy: continue there, or choose a copy of the folder"
        )


def _borrow(scene: bpy.types.Scene) -> None:
    """Note which folders of a scene, as it was saved, are those of the file that it was saved in, if the open file is a copy of that."""
    saved, now = scene.get(SAVED, ""), bpy.data.filepath
    if not now or not os.path.isfile(saved) or _same(saved, now):
        return
    settings = scene.refgs
    paths = [settings.many.captures, settings.many.results, *(known.folder for known in settings.runs)]
    here, there = ([_absolute(path, os.path.dirname(file)) for path in paths] for file in (now, saved))
    shared = [mine for mine, theirs in zip(here, there, strict=True) if _same(mine, theirs)]
    scene[BORROWED] = json.dumps(dict.fromkeys(shared, saved) | json.loads(scene.get(BORROWED, "{}")))


def _same(one: str, other: str) -> bool:
    """Check whether two paths lead to the same file or folder, and it exists."""
    return os.path.exists(one) and os.path.exists(other) and os.path.samefile(one, other)


def change_paths(change: Callable[[str], str]) -> None:
    """Apply `change` to each path that the add-on stores in the open file."""
    for item, key in _custom_properties():
        item[key] = change(item[key])
    for settings, key in _settings():
        old = getattr(settings, key)
        if old and (new := change(old)) != old:
            setattr(settings, key, new)


def _custom_properties() -> Iterator[tuple[bpy.types.ID, str]]:
    for items in (bpy.data.collections, bpy.data.cameras, bpy.data.images):
        for item in items:
            for key in (FOLDER, CAPTURE, PHOTO, MASK, STROKES):
                if isinstance(item.get(key), str) and item[key] and item.library is None:
                    yield item, key


def _settings() -> Iterator[tuple[bpy.types.PropertyGroup, str]]:
    for scene in _own_scenes():
        yield from ((scene.refgs, "capture"), (scene.refgs, "out"))
        yield from ((scene.refgs.many, "captures"), (scene.refgs.many, "results"))
        yield from ((known, key) for known in scene.refgs.runs for key in ("folder", "capture"))


def _own_scenes() -> list[bpy.types.Scene]:
    """List the scenes of the open file, without those linked from other files: these cannot be changed."""
    return [scene for scene in bpy.data.scenes if scene.library is None]


def _absolute(path: str, start: str) -> str:
    return os.path.normpath(bpy.path.abspath(path, start=start)) if path.startswith("//") and start else path


def _loaded(path: str, start: str) -> str:
    """Return a path of a .blend in the folder `start` as absolute.

    The add-on's example is where this add-on is: on another machine, or for another Blender, it was elsewhere.
    """
    path = _absolute(path, start)
    return str(EXAMPLE) if path.replace("\\", "/").endswith(_EXAMPLE_END) else path


def _relative(path: str, start: str) -> str:
    """Return an absolute path relative to the folder `start`, or as it is if it is on another drive."""
    if not os.path.isabs(path):
        return path
    try:
        relative = bpy.path.relpath(path, start=start)
        # Through a symbolic link or a mapped drive, a path into the project can look like one out of it, and a copy would use the original.
        real = bpy.path.relpath(os.path.realpath(path), start=os.path.realpath(start))
        return real if relative.startswith("//..") and not real.startswith("//..") else relative
    except ValueError:
        return path


@bpy.app.handlers.persistent
def _before_saving(file: str, *_) -> None:
    before, after = os.path.dirname(bpy.data.filepath), os.path.dirname(file)
    if before:
        # Blender makes the paths of images relative when a file is saved first, and then keeps relative ones right.
        runs = tuple(os.path.join(item[key], "") for item, key in _custom_properties() if key == FOLDER)
        photos = {item[key] for item, key in _custom_properties() if key == PHOTO}
        lights = {get_light(world)[0] for world in bpy.data.worlds if is_panorama(world)}
        for image in bpy.data.images:
            ours = image.filepath.startswith(runs) or image.filepath in photos or image in lights
            if image.library is None and ours:
                image.filepath_raw = _relative(image.filepath, before)
    if after:  # else it is the startup file
        change_paths(lambda path: _relative(_absolute(path, before), after))
        _remember_file(file)


@bpy.app.handlers.persistent
def _after_saving(file: str, *_) -> None:
    change_paths(lambda path: _absolute(path, os.path.dirname(file)))
    _remember_file(bpy.data.filepath)  # another than `file`, if a copy was saved


def _remember_file(file: str) -> None:
    for scene in _own_scenes():
        scene[SAVED] = file


@bpy.app.handlers.persistent
def _after_loading(*_) -> None:
    for scene in _own_scenes():
        _borrow(scene)
    change_paths(lambda path: _loaded(path, os.path.dirname(bpy.data.filepath)))


@bpy.app.handlers.persistent
def _after_appending(context, *_) -> None:
    """Make paths absolute in data that was appended from another .blend."""
    libraries = [item.source_library for item in context.import_items if item.source_library is not None]
    if libraries:
        start = os.path.dirname(bpy.path.abspath(libraries[0].filepath))
        for item, key in _custom_properties():
            item[key] = _loaded(item[key], start)


_HANDLERS = {
    "save_pre": _before_saving,
    "save_post": _after_saving,
    "save_post_fail": _after_saving,
    "load_post": _after_loading,
    "blend_import_post": _after_appending,
}


def register() -> None:
    for event, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, event).append(handler)


def unregister() -> None:
    for event, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, event).remove(handler)
