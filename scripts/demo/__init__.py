"""The capture of `refgs demo`: a jar, photographed by Cycles together with its ground truth.

`jar` is the object, `shapes` builds meshes, `light` reads Blender's HDRIs, `cycles` drives Blender, `capture` places the cameras and
writes the folder, `photograph` is the command line. `benchmarks.scenes` photographs its own objects the same way.
"""
