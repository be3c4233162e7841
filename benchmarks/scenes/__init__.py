"""Render test scenes whose true shape, materials and light are known: `python -m benchmarks.scenes NAME --out DIR`.

Each scene is a module with a function `build()`, and is rendered by Blender's Cycles. `solids` helps to model the meshes. `scripts.demo`
places cameras and renders the photos. `lights` makes soft lights. `analytic` makes simpler captures without Blender.

`can` and `tabletop` are commands of their own. They photograph objects where they stand, by `by_hand`, for `refgs bench masks`.
"""

import importlib

from benchmarks.scenes import still
from scripts.demo import jar
from scripts.demo.shapes import Scene

REFLECTIVE = ("ball", "car", "figure", "helmet", "jar", "plate", "rings", "teapot", "toaster")
DULL = ("brushed", "embossed", "part", "tarnished")
"""Metals that look matte, or are a small part of something matte."""
AMBIGUOUS = ("bowl", "brass", "bricks", "dark", "gloss", "lamps", "night", "silver", "twins")
"""Photos of these can be explained twice: mirrors in the dark, silver among white, paint like metal, a hollow with content."""
MATTE = ("matte",)
STILLS = tuple(f"still-{number}" for number in range(20))
"""Still lifes by chance, see `still`."""
NAMES = REFLECTIVE + AMBIGUOUS + DULL + MATTE + STILLS


def build(name: str) -> Scene:
    """Build the mesh and the materials of the scene with this name."""
    if name == "jar":
        return jar.build()
    if name in STILLS:
        return still.build(STILLS.index(name))
    return importlib.import_module(f"benchmarks.scenes.{name}").build()
