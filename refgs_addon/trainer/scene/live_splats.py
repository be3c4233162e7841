"""Show in the 3D view what a training has learned so far, as surfels (flat splats). They are removed when the training ends."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import bpy

from ... import compat, jobs
from ...errors import InputError
from ...nodes.splats_tree import NAME


@dataclass
class _LiveObject:
    job: jobs.Job
    scene: str
    item: str  # the object's name: undo replaces the object itself
    iteration: int = -1
    reading: Future | None = None


_shown: list[_LiveObject] = []
_reader = ThreadPoolExecutor(1)


def watch(job: jobs.Job, scene: bpy.types.Scene, on: bool = True) -> None:
    """Show the surfels of a training job in a scene. With `on` False, remove them.

    This function adds an object without points, and makes its nodes, which takes some time. Later a timer calls `update`, which must be
    fast: it only replaces the points, each time the training writes a preview.
    """
    for live in [live for live in _shown if live.job is job]:
        _remove(live)
    if on and not job.ended:
        from ...scene.splat_cloud import add_splats

        name = f"{job.name} in training"
        item = add_splats(name, bpy.data.pointclouds.new(name), scene.collection)
        compat.set_modifier_input(item.modifiers[NAME], "Display", "Base Color")  # there is no light yet
        _shown.append(_LiveObject(job, scene.name, item.name))


def is_watched(job: jobs.Job) -> bool:
    return any(live.job is job for live in _shown)


def update() -> None:
    """Show the newest preview of each watched training: the surfels that it wrote last. Remove the surfels of ended trainings.

    A timer calls this function. A background thread reads the files, so that this function returns at once.
    """
    for live in list(_shown):
        deleted = live.item not in bpy.data.objects
        if live.job.ended or deleted or live.scene not in bpy.data.scenes:
            _remove(live)
        elif live.reading is not None and live.reading.done():
            values, live.reading = live.reading.result(), None
            if values is not None:
                _replace_points(live, values)
        elif live.reading is None and live.job.preview and live.job.preview["iteration"] != live.iteration:
            live.iteration = live.job.preview["iteration"]
            live.reading = _reader.submit(_read, Path(live.job.preview["splats"]))


def _read(path: Path) -> dict | None:
    """Read a preview's splats as attributes for `point_cloud`. Returns None if they cannot be read."""
    import numpy as np

    from ...scene.splat_cloud import cloud_attributes, read_splats

    try:
        splats, _ = read_splats(path)
    except InputError:  # wait for the next preview
        return None
    flat = np.zeros_like(splats["position"])
    return cloud_attributes(splats, flat, flat)


def _replace_points(live: _LiveObject, values: dict) -> None:
    from ...scene.splat_cloud import point_cloud

    item = bpy.data.objects[live.item]
    before, item.data = item.data, point_cloud(item.name, values)
    for material in before.materials:
        item.data.materials.append(material)
    bpy.data.pointclouds.remove(before)


def _remove(live: _LiveObject) -> None:
    _shown.remove(live)
    item = bpy.data.objects.get(live.item)
    if item is not None:
        bpy.data.batch_remove([item, item.data, *item.data.materials])


def unregister() -> None:
    for live in list(_shown):
        _remove(live)
