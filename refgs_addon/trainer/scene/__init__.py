"""Train with plain functions, which read and write Blender data. Operators and scripts call them."""
