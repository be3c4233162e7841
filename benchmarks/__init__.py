"""Measurements of RefGS, from a clone: `refgs bench` and `refgs stability`; scenes with ground truth."""

BENCHMARKS = ("kernels", "truth", "paper", "needs", "minutes", "gpu", "page")
