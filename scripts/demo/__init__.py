"""Make the capture of `refgs demo`: photograph a jar by Cycles, with ground truth.

`jar` is the object, `shapes` builds meshes, `light` reads Blender's HDRIs, `cycles` drives Blender, `capture` places the cameras and
writes the folder, `photograph` is the command line. `benchmarks.scenes` photographs its own objects the same way.
"""
