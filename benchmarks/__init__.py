"""Measure the speed, the quality and the numerical stability of RefGS: `refgs bench` and `refgs stability`.

Both commands need a clone of the repository. `benchmarks.scenes` renders test scenes whose true shape, materials and light are known.
"""

BENCHMARKS = (
    "kernels",
    "truth",
    "real",
    "cameras",
    "paper",
    "needs",
    "poses",
    "masks",
    "minutes",
    "look",
    "gpu",
    "many",
    "farm",
    "page",
)
