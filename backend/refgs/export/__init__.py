"""Export a run as meshes, textures and splats for other programs."""
