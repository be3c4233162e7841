"""Plain functions that write Blender data: a script can do all that a button does."""
