"""Captures with ground truth, rendered by Cycles: `python -m benchmarks.scenes NAME --out DIR`.

One module a scene (each has `build()`); `shapes` makes meshes, `light` finds and reads HDRIs, `cycles` is all that
touches Blender, `capture` places the cameras and writes the folder.
"""
