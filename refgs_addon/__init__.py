"""Run RefGS inside Blender: this package is the add-on, and the only code that imports bpy.

`scene` holds plain functions that write Blender data. `nodes` builds node trees. `ui` holds the operators and panels that call them.

This file imports nothing. So `python -m refgs_addon.preview` can check for missing libraries before it loads bpy.
"""
