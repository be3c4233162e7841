"""Render the photos for `refgs demo`: a jar, by Blender's Cycles, with ground truth of shape and materials.

`jar` builds the object from the meshes of `shapes`. `light` reads the HDRIs that come with Blender. `cycles` renders. `capture` places the
cameras and writes the folder. `photograph` is the command line. `benchmarks.scenes` renders its own objects with these modules.
"""
