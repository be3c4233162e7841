"""Build, load and run the C++ kernels. Their sources lie in this folder."""
