"""Mark an imported run as an asset, with a preview picture for Blender's asset browser."""

import tempfile
from pathlib import Path

import bpy

from .render_eevee import render_preview
from .run_parts import cameras

SIDE = 256  # pixels of the picture


def mark_asset(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Mark a run's collection as an asset. Its picture shows the run alone, under the scene's light.

    The picture is rendered with the scene's camera, or with the run's first camera if the scene has none. Raises InputError if there is no
    camera.
    """
    own = cameras(collection)
    camera = scene.camera or next((item for item in (own.objects if own else ()) if item.type == "CAMERA"), None)
    alone = scene.copy()  # with its world and how it traces rays
    try:
        for item in alone.collection.objects:
            alone.collection.objects.unlink(item)
        for child in alone.collection.children:
            if child != collection:
                alone.collection.children.unlink(child)
        with tempfile.TemporaryDirectory() as folder:
            picture = Path(folder) / "asset.png"
            render_preview(alone, picture, camera, SIDE)
            collection.asset_mark()
            with bpy.context.temp_override(id=collection):
                bpy.ops.ed.lib_id_load_custom_preview(filepath=str(picture))
    finally:
        bpy.data.scenes.remove(alone)
