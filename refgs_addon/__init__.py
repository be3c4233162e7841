"""The RefGS add-on: everything that runs inside Blender, and the only code here that imports bpy.

`scene` holds plain functions that write Blender data, `nodes` the node trees, `ui` the buttons that call them. The
package itself imports nothing, so that `python -m refgs_addon.preview` can say what is missing where bpy does not load.
"""
