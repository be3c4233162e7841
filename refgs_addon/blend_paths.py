"""Save the add-on's paths relative to the .blend file (`//`), so that a copied project uses its own run and capture.

While a .blend is open, these paths are absolute. They are made relative before it is saved, and absolute again afterwards. Blender itself
makes the paths of images relative, but not paths in other properties.
"""

import os
from collections.abc import Callable, Iterator

import bpy

from .nodes.panorama_world import get_light, is_panorama
from .scene.camera_objects import MASK, PHOTO, STROKES
from .scene.capture_cameras import CAPTURE
from .scene.run_parts import FOLDER


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
    for scene in bpy.data.scenes:
        if scene.library is None:
            yield from ((scene.refgs, "capture"), (scene.refgs, "out"))
            yield from ((scene.refgs.many, "captures"), (scene.refgs.many, "results"))
            yield from ((known, key) for known in scene.refgs.runs for key in ("folder", "capture"))


def _absolute(path: str, start: str) -> str:
    return os.path.normpath(bpy.path.abspath(path, start=start)) if path.startswith("//") and start else path


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


@bpy.app.handlers.persistent
def _after_saving(file: str, *_) -> None:
    change_paths(lambda path: _absolute(path, os.path.dirname(file)))


@bpy.app.handlers.persistent
def _after_loading(*_) -> None:
    change_paths(lambda path: _absolute(path, os.path.dirname(bpy.data.filepath)))


@bpy.app.handlers.persistent
def _after_appending(context, *_) -> None:
    """Make paths absolute in data that was appended from another .blend."""
    libraries = [item.source_library for item in context.import_items if item.source_library is not None]
    if libraries:
        start = os.path.dirname(bpy.path.abspath(libraries[0].filepath))
        for item, key in _custom_properties():
            item[key] = _absolute(item[key], start)


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
