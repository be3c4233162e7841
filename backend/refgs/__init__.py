"""RefGS: photographs of shiny objects into relightable surfels, textured meshes and light."""

__version__ = "0.1.0"

import os

# OpenMP's idle workers must sleep, not spin: spinning ones steal the cores from everything else. The runtime reads this
# once, when torch loads it.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
