"""Measure the errors of renderings, lights and meshes. Convert renderings to pictures."""
