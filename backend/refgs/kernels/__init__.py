"""C++ kernels: their sources, and how they are built and loaded."""
