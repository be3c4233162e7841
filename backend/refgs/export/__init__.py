"""Meshes, textures and splats, made from a run for other programs."""
