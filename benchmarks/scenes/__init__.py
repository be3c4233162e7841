"""Captures with ground truth, rendered by Cycles: `python -m benchmarks.scenes NAME --out DIR`.

One module a scene (each has `build()`); `shapes` makes meshes and `solids` sculpts them, `light` finds and reads HDRIs,
`cycles` is all that touches Blender, `capture` places the cameras and writes the folder.
"""

import importlib

from benchmarks.scenes.shapes import Scene

REFLECTIVE = ("ball", "car", "figure", "helmet", "jar", "plate", "rings", "teapot", "toaster")
MATTE = ("matte",)
NAMES = REFLECTIVE + MATTE


def build(name: str) -> Scene:
    """A scene by its name."""
    return importlib.import_module(f"benchmarks.scenes.{name}").build()
