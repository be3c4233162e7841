"""Carve visual hulls, fuse depth maps to meshes, clean meshes, and trace which light a mesh blocks."""
