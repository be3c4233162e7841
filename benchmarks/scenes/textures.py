"""Compute irregular textures."""

import numpy as np

WAVES, OCTAVES = 12, 4


def clouds(points: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Compute smooth noise at points (n, 3), as in clouds. Returns (n,) values about 0, most of them within −1..1.

    The largest features are about `size` wide. Each of the octaves is half as large and half as strong as the one before it. An octave
    is a sum of plane waves of random directions and phases.
    """
    generator = np.random.default_rng(seed)
    total = np.zeros(len(points))
    for octave in range(OCTAVES):
        wave = generator.normal(size=(WAVES, 3))
        wave *= np.pi / size * 2**octave / np.linalg.norm(wave, axis=1, keepdims=True)
        phase = generator.uniform(0, 2 * np.pi, WAVES)
        total += np.sin(points @ wave.T + phase).sum(axis=1) / 2**octave
    return total / np.sqrt(WAVES)
