"""A training's surfels in the 3D view, as they are by now. They go when the training ends: importing the run brings what was learned."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import bpy

from .. import compat, jobs
from ..errors import InputError
from ..nodes.splats_tree import NAME


@dataclass
class _Live:
    job: jobs.Job
    scene: str
    item: str  # the object's name, for undo makes another object of it
    iteration: int = -1
    coming: Future | None = None


_shown: list[_Live] = []
_reader = ThreadPoolExecutor(1)


def watch(job: jobs.Job, scene: bpy.types.Scene, on: bool = True) -> None:
    """Show a job's surfels in a scene whenever there is a new preview of them, or no longer. The object is there at once, without points,
    for making its nodes takes longer than a timer should."""
    for live in [live for live in _shown if live.job is job]:
        _take_away(live)
    if on and not job.ended:
        from .splat_cloud import add_splats

        name = f"{job.name} in training"
        item = add_splats(name, bpy.data.pointclouds.new(name), scene.collection)
        compat.set_modifier_input(item.modifiers[NAME], "Display", "Base Color")  # there is no light yet
        _shown.append(_Live(job, scene.name, item.name))


def is_watched(job: jobs.Job) -> bool:
    return any(live.job is job for live in _shown)


def update() -> None:
    """Put what has been read into the scene, and have what is new read, in a thread."""
    for live in list(_shown):
        deleted = live.item not in bpy.data.objects
        if live.job.ended or deleted or live.scene not in bpy.data.scenes:
            _take_away(live)
        elif live.coming is not None and live.coming.done():
            values, live.coming = live.coming.result(), None
            if values is not None:
                _put(live, values)
        elif live.coming is None and live.job.preview and live.job.preview["iteration"] != live.iteration:
            live.iteration = live.job.preview["iteration"]
            live.coming = _reader.submit(_read, Path(live.job.preview["splats"]))


def _read(path: Path) -> dict | None:
    """Flat splats: how they bend takes longer than all the rest."""
    import numpy as np

    from .splat_cloud import read_splats, with_slopes

    try:
        splats, _ = read_splats(path)
    except InputError:  # the next preview will do
        return None
    flat = np.zeros_like(splats["position"])
    return with_slopes(splats, flat, flat)


def _put(live: _Live, values: dict) -> None:
    from .splat_cloud import point_cloud

    item = bpy.data.objects[live.item]
    before, item.data = item.data, point_cloud(item.name, values)
    for material in before.materials:
        item.data.materials.append(material)
    bpy.data.pointclouds.remove(before)


def _take_away(live: _Live) -> None:
    _shown.remove(live)
    item = bpy.data.objects.get(live.item)
    if item is not None:
        bpy.data.batch_remove([item, item.data, *item.data.materials])
