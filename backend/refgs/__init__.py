"""RefGS: photographs of shiny objects into relightable surfels, textured meshes and light."""

__version__ = "0.2.0"

import os

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

# How long OpenMP's idle workers spin before they sleep: GNU's default, milliseconds, starves them of each other's cores as soon
# as anything else runs (an iteration took twenty times as long); none at all makes each of an iteration's thousand small
# steps wait for a wake-up (half as long again). The runtime reads this once, when torch loads it.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")
# More threads than cores wait for each other. This too is read once.
if os.environ.get("OMP_NUM_THREADS", "").isdigit():
    os.environ["OMP_NUM_THREADS"] = str(min(int(os.environ["OMP_NUM_THREADS"]), CORES))
