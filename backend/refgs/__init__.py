"""RefGS: turn photos of shiny objects into relightable surfels, textured meshes and light."""

__version__ = "0.2.0"

import os

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

# Spins of OpenMP's idle workers before they sleep. With none or few, most parallel parts of an iteration begin with a wake-up, and it
# takes a tenth longer. With more, other programs share their cores with spinning workers; with every core taken an iteration
# takes a tenth longer at 30000 than at 3000. OpenMP reads this once, when torch loads it.
os.environ.setdefault("GOMP_SPINCOUNT", "30000")
# More threads than cores wait for each other. This is read once, too.
if os.environ.get("OMP_NUM_THREADS", "").isdigit():
    os.environ["OMP_NUM_THREADS"] = str(min(int(os.environ["OMP_NUM_THREADS"]), CORES))
