"""RefGS: photographs of shiny objects into relightable surfels, textured meshes and light."""

__version__ = "0.1.0"

import os

# How long OpenMP's idle workers spin before they sleep: GNU's default, milliseconds, starves them of each other's cores as soon
# as anything else runs (an iteration took twenty times as long); none at all makes each of an iteration's thousand small
# steps wait for a wake-up (half as long again). The runtime reads this once, when torch loads it.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")
