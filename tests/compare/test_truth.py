"""Test errors against true maps."""

import numpy as np
import pytest

from refgs.compare.truth import errors


def test_metal_taken_for_paint_counts_as_wrong():
    """Check the part of the object's pixels whose metallic is off by more than 0.5. Pixels beyond the object do not count."""
    covered, true = np.zeros((10, 10), np.float32), np.zeros((10, 10), np.float32)
    covered[:8], true[:4] = 1, 1
    learned = true.copy()
    learned[0], learned[1], learned[9] = 0.3, 0.6, 1  # wrong, unsure, outside
    found = errors({"metallic": learned, "alpha": covered}, {"metallic": true}, covered)
    assert found["metallic_wrong"] == pytest.approx(1 / 8)
