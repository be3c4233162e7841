"""Geometry: visual hulls, TSDF fusion of depth maps, clean-up of meshes, visibility by ray tracing."""
