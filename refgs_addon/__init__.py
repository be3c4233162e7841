"""RefGS add-on: all code that runs inside Blender, and the only code that imports bpy.

`scene` holds plain functions that write Blender data, `nodes` the node trees, `ui` the operators and panels that call them. The
package itself imports nothing: `python -m refgs_addon.preview` can then report a missing library where bpy does not load.
"""
