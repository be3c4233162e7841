from dataclasses import replace

import numpy as np

from refgs.formats.splats import Splats


def arrays(splats):
    """Return all arrays of a Splats or Textures object, by name."""
    return {name: value for name, value in vars(splats).items() if isinstance(value, np.ndarray)}


def chosen(splats, which):
    """Copy a subset of splats. It is selected by indices, a mask or a slice."""
    return replace(splats, **{name: np.array(value[which]) for name, value in arrays(splats).items()})


def make(count=7, coefficients=16, indirect=0):
    """Make random splats.

    Their colour has `coefficients` spherical harmonics, and their indirect light has `indirect`. If `indirect` is 0, `received` is 1.
    """
    rng = np.random.default_rng(1)

    def f(*shape):
        return rng.random(shape).astype(np.float32)

    def unit(width):
        vectors = f(count, width)
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    return Splats(
        positions=f(count, 3) - 0.5,
        normals=unit(3),
        sh=f(count, coefficients, 3) - 0.5,
        opacities=0.02 + 0.96 * f(count),
        scales=1e-3 + f(count, 2),
        rotations=unit(4),
        albedo=f(count, 3),
        metallic=f(count),
        roughness=f(count),
        received=f(count, 3) if indirect else np.ones((count, 3), np.float32),
        indirect=f(count, indirect, 3),
    )
