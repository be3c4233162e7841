"""Measure RefGS in a copy of its repository: `refgs bench`, `refgs stability`, and scenes with ground truth."""

BENCHMARKS = ("kernels", "truth", "paper", "needs", "minutes", "gpu", "page")
