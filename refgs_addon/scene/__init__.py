"""Read and write Blender data with plain functions. Operators and scripts call them."""
