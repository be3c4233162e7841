"""Metrics, pictures and ground truth: how far renderings, light and meshes are from what is known."""
