"""Plain functions that read and write Blender data. Operators call them, and scripts can."""
