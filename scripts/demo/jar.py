"""Build the object of `refgs demo`: a lidded urn of gold, copper and glazed ceramic with a dark band, lit by the HDRI of a room.

The urn is shiny and partly concave.
"""

import numpy as np

from scripts.demo.shapes import Material, Scene, join, lathe, tube

GOLD, COPPER, IRON, CERAMIC = range(4)
MATERIALS = (
    Material((0.944, 0.720, 0.330), metallic=1.0, roughness=0.25),
    Material((0.920, 0.480, 0.330), metallic=1.0, roughness=0.25),
    Material((0.130, 0.125, 0.130), metallic=1.0, roughness=0.45),
    Material((0.020, 0.180, 0.220), metallic=0.0, roughness=0.25),
)
PROFILE = [
    (
        CERAMIC,
        [(0.0, -1.0), (0.36, -1.0), (0.42, -0.985), (0.435, -0.95), (0.39, -0.90), (0.27, -0.83), (0.21, -0.765)],
    ),
    (COPPER, [(0.238, -0.75), (0.249, -0.73), (0.238, -0.71)]),
    (GOLD, [(0.267, -0.69), (0.464, -0.57), (0.615, -0.40), (0.708, -0.18), (0.725, -0.02), (0.696, 0.12)]),
    (IRON, [(0.702, 0.135), (0.696, 0.155), (0.661, 0.225), (0.615, 0.285), (0.597, 0.295)]),
    (CERAMIC, [(0.568, 0.30), (0.418, 0.385), (0.313, 0.47), (0.273, 0.555), (0.29, 0.64), (0.348, 0.70)]),
    (COPPER, [(0.406, 0.725), (0.423, 0.745), (0.412, 0.765), (0.365, 0.77)]),
    (GOLD, [(0.342, 0.778), (0.307, 0.82), (0.209, 0.868), (0.104, 0.89)]),
    (COPPER, [(0.064, 0.90), (0.058, 0.915), (0.099, 0.945), (0.102, 0.97), (0.064, 0.995), (0.0, 1.0)]),
]
HANDLE = [(0.232, 0.62), (0.464, 0.68), (0.673, 0.62), (0.76, 0.46), (0.719, 0.28), (0.615, 0.17)]


def build() -> Scene:
    """Build the urn as a scene. It is two units high. The handles reach 0.8 from the axis."""
    side = np.array([(x, 0.0, z) for x, z in HANDLE])
    handles = [tube(side * (sign, 1, 1), 0.045, COPPER, closed=False) for sign in (1, -1)]
    return Scene(join(lathe(PROFILE, rows=320, columns=288, flutes=_flutes), *handles), MATERIALS, light="interior")


def _flutes(angle: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Make sixteen shallow vertical grooves: return factors, up to 1, that scale the urn's radius at each angle and height.

    The grooves fade out towards both ends of the urn's body.
    """
    fade = np.clip((z + 0.66) / 0.25, 0, 1) * np.clip((0.09 - z) / 0.2, 0, 1)
    fade = fade * fade * (3 - 2 * fade)
    return 1 + 0.022 * fade * (np.cos(16 * angle) - 1)
