"""Read captures of Stanford-ORB in its NeRF-Blender form: `blender_HDR/SCENE` or `blender_LDR/SCENE`.

The layout is described in the README of Stanford-ORB's repository and in its `orb/datasets/mymethod.py` (Kuang et al., NeurIPS 2023). It is
NeRF-Blender's layout with these additional files:

    {train,test}_mask/NAME.png      masks of the photos {train,test}/NAME.exr, or .png
    transforms_novel.json           cameras of the test photos of the same object in other scenes, in this scene's coordinates. A
                                    frame has `scene_name` and its own `camera_angle_x`; the photo is in ../SCENE_NAME
    ../../ground_truth/SCENE/       true maps and lights of a scene's test photos, see `refgs.compare.published`
"""

import os
from dataclasses import replace
from pathlib import Path, PurePosixPath

from refgs.capture.files import without_suffix
from refgs.capture.transforms import read_views
from refgs.capture.types import Split, View
from refgs.formats.transforms import Frame, read_novel_transforms, read_transforms

NOVEL = "transforms_novel.json"


def read_stanford_orb(folder: Path) -> tuple[list[View], list[str]]:
    """Read a Stanford-ORB capture's views in its own coordinates, and warnings. Raises InputError."""
    (trained, lost), (tested, more) = (_read(folder / f"transforms_{split}.json", split) for split in ("train", "test"))
    return trained + tested, lost + more


def novel_views(folder: Path) -> list[tuple[str, View]]:
    """Read the photos of the same object in other scenes. Return pairs of a scene's name and a view. Scenes not on disk are left out.

    The cameras are in the coordinates of the capture in `folder`. Raises InputError.
    """
    file = folder / NOVEL
    scenes: dict[str, list[tuple[Frame, Split]]] = {}
    for frame in read_novel_transforms(file).frames:
        scene = frame.scene_name
        if os.path.isdir(folder.parent / scene):
            path = f"../{scene}/{PurePosixPath(frame.path)}"
            scenes.setdefault(scene, []).append((_masked(frame.model_copy(update={"file_path": path})), "test"))
    return [
        (scene, replace(view, camera=replace(view.camera, name=f"{scene}_{view.camera.name}")))
        for scene, frames in scenes.items()
        for view in read_views(file, frames)[0]
    ]


def _read(file: Path, split: Split) -> tuple[list[View], list[str]]:
    return read_views(file, [(_masked(frame), split) for frame in read_transforms(file).frames])


def _masked(frame: Frame) -> Frame:
    """Add the path of the frame's mask."""
    path = PurePosixPath(without_suffix(frame.path))
    return frame.model_copy(update={"mask_path": f"{path.parent}_mask/{path.name}.png"})
