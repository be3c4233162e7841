"""Build a dancer of polished bronze in a silver skirt on a plinth. Her limbs and folds reflect each other."""

from benchmarks.scenes.solids import blend, disc, ellipsoid, mirrored, ring, sculpt, sweep
from scripts.demo.shapes import Material, Scene, join

BRONZE, SILVER, DARK = range(3)
MATERIALS = (
    Material((0.85, 0.53, 0.28), metallic=1.0, roughness=0.12),
    Material((0.93, 0.92, 0.90), metallic=1.0, roughness=0.08),
    Material((0.25, 0.24, 0.26), metallic=1.0, roughness=0.20),
)


def build() -> Scene:
    """Build the dancer, two units high, on one leg; the other foot rests at the knee and the arms make a ring."""
    standing = sweep(
        [(0.10, 0.02, -0.82), (0.0, 0.02, -0.76), (0.03, 0.04, -0.42), (0.0, 0.07, -0.05)], [0.035, 0.05, 0.075, 0.115]
    )
    bent = sweep(
        [(0.0, -0.08, -0.05), (0.24, -0.26, -0.24), (0.10, -0.12, -0.44), (0.06, 0.0, -0.58)],
        [0.115, 0.08, 0.055, 0.03],
    )
    torso = sweep([(0, 0, -0.06), (0.01, 0, 0.16), (-0.01, 0, 0.40)], [0.135, 0.105, 0.13])
    arms = mirrored(
        sweep(
            [(0, 0.10, 0.44), (0.02, 0.36, 0.50), (0.08, 0.44, 0.76), (0.10, 0.22, 0.96), (0.10, 0.03, 0.98)],
            [0.075, 0.055, 0.045, 0.04, 0.03],
        )
    )
    head = ellipsoid((0.01, 0, 0.74), (0.105, 0.09, 0.125))
    neck = sweep([(-0.01, 0, 0.42), (0, 0, 0.56), (0.01, 0, 0.70)], [0.06, 0.045, 0.05])
    knot = ellipsoid((-0.10, 0, 0.82), (0.06, 0.06, 0.06))
    body = blend(0.07, torso, standing, bent, arms, neck, head, knot)
    skirt = blend(
        0.05, ellipsoid((0, 0, -0.02), (0.50, 0.50, 0.045)), ellipsoid((0, 0, 0.07), (0.30, 0.30, 0.04)),
        ring((0, 0, 0.13), (0, 0, 1), 0.10, 0.04),
    )  # fmt: skip
    plinth = blend(
        0.04, disc((0, 0, -0.95), (0, 0, 1), 0.46, 0.05, 0.03), disc((0, 0, -0.87), (0, 0, 1), 0.36, 0.04, 0.02)
    )
    mesh = join(
        sculpt(body, (-0.3, -0.6, -1), (0.5, 0.6, 1.1), 0.009, BRONZE),
        sculpt(skirt, (-0.55, -0.55, -0.15), (0.55, 0.55, 0.25), 0.009, SILVER),
        sculpt(plinth, (-0.5, -0.5, -1.05), (0.5, 0.5, -0.8), 0.011, DARK),
    )
    return Scene(mesh, MATERIALS, light="forest", lowest=-0.2)
