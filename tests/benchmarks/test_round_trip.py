"""Where a mesh's pictures err: parts of a picture that leave nothing out and count nothing twice."""

import numpy as np
import pytest

pytest.importorskip("bpy")

from benchmarks.bake import REGIONS, regions


def test_the_regions_part_the_picture():
    y, x = np.mgrid[:100, :100]
    alpha = ((x - 50) ** 2 + (y - 50) ** 2 < 30**2).astype(float)
    alpha[48:52, 80:98] = 1  # a thin handle
    alpha[20, 50] = 0.5
    visibility = (x < 60).astype(float)
    parts = regions(alpha, visibility)
    assert tuple(parts) == REGIONS
    np.testing.assert_array_equal(sum(mask.astype(int) for mask in parts.values()), 1)
    assert parts["thin"][50, 90] and parts["outline"][21, 50] and parts["in itself"][50, 70] and parts["rest"][50, 40]
    assert parts["outside"][5, 5] and not parts["outside"][alpha > 0.5].any()
