"""Carve visual hulls, fuse depth maps, clean meshes, trace visibility."""
