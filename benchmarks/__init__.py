"""Measurements of RefGS: scenes with ground truth, kernels, peers, stability. Run from the repository root."""
