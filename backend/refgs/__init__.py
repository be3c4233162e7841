"""RefGS: photographs of shiny objects into relightable surfels, textured meshes and light."""

__version__ = "0.2.0"

import os

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

# How long OpenMP's idle workers spin before they sleep. Not at all or briefly, and most of an iteration's parallel parts begin with
# a wake-up: it takes a tenth longer. For longer, and anything else that runs on the machine has to share its cores with them: with
# every core taken an iteration takes a tenth longer at this many than at a tenth of them. The runtime reads this once, when
# torch loads it.
os.environ.setdefault("GOMP_SPINCOUNT", "30000")
# More threads than cores wait for each other. This too is read once.
if os.environ.get("OMP_NUM_THREADS", "").isdigit():
    os.environ["OMP_NUM_THREADS"] = str(min(int(os.environ["OMP_NUM_THREADS"]), CORES))
