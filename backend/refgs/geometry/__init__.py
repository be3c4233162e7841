"""Shape: visual hulls, TSDF fusion of depth, and the clean-up of meshes."""
