"""Colour a part of a run's splats orange in the 3D views, while the artist decides about it."""

from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    import numpy as np

COLOR = 1.0, 0.45, 0.0, 0.5

_handler = None  # of the part that is shown, as SpaceView3D returns it; at most one


def show(corners: "np.ndarray") -> None:
    """Colour quads with the corners (P, 4, 3) in world space, in place of those that were coloured before."""
    import gpu
    import numpy as np
    from gpu_extras.batch import batch_for_shader

    clear()
    first = 4 * np.arange(len(corners), dtype=np.int32)[:, None]
    triangles = np.concatenate([np.add(first, (0, 1, 2)), np.add(first, (0, 2, 3))]).astype(np.int32)
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "TRIS", {"pos": corners.reshape(-1, 3).astype(np.float32)}, indices=triangles)

    def draw() -> None:
        gpu.state.blend_set("ALPHA")
        gpu.state.depth_test_set("LESS_EQUAL")
        shader.uniform_float("color", COLOR)
        batch.draw(shader)
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("NONE")

    global _handler
    _handler = bpy.types.SpaceView3D.draw_handler_add(draw, (), "WINDOW", "POST_VIEW")
    _redraw()


def clear() -> None:
    """Colour nothing any more."""
    global _handler
    if _handler is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handler, "WINDOW")
        _handler = None
        _redraw()


def _redraw() -> None:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def unregister() -> None:
    clear()
