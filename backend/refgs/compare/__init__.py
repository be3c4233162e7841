"""Metrics, pictures and ground truth: errors of renderings, light and meshes."""
