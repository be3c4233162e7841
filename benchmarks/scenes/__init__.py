"""Captures with ground truth, rendered by Cycles: `python -m benchmarks.scenes NAME --out DIR`.

One module a scene, each with `build()`; `solids` sculpts their meshes. `scripts.demo` has the jar and what photographs them all;
`analytic` makes captures without Blender.
"""

import importlib

from scripts.demo import jar
from scripts.demo.shapes import Scene

REFLECTIVE = ("ball", "car", "figure", "helmet", "jar", "plate", "rings", "teapot", "toaster")
MATTE = ("matte",)
NAMES = REFLECTIVE + MATTE


def build(name: str) -> Scene:
    """Build a scene by its name."""
    return jar.build() if name == "jar" else importlib.import_module(f"benchmarks.scenes.{name}").build()
