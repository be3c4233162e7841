"""Render captures with ground truth by Cycles: `python -m benchmarks.scenes NAME --out DIR`.

Each scene is a module with a function `build()`. `solids` sculpts the meshes. `scripts.demo` photographs the scenes, and builds one more
scene, the jar. `analytic` makes captures without Blender.
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
