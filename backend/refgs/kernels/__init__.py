"""C++ kernels: their sources, how they are built and loaded, and the reference that they are tested against."""
