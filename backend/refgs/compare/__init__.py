"""Measure the errors of renderings, light and meshes, and draw them as pictures."""
