"""Test how evidence spreads over a smooth piece of surface, and not beyond its creases and edges."""

import numpy as np
import pytest
import torch

from refgs.train.material.observe import NEIGHBOURS, neighbours
from refgs.train.material.same_material import laplacian, spread
from tests.makers.pieces import ball_on_board, rounded, seen_as


def spread_over(points, normals, value, weight, mean=None):
    return spread(laplacian(points, seen_as(points, normals, mean), neighbours(points, NEIGHBOURS)), value, weight)


def test_a_balls_lower_half_is_of_its_upper_halfs_metal():
    """Check that evidence for metal crosses the ball's equator, but not the crease to the board."""
    points, normals, ball = ball_on_board()
    told = (ball & (points[:, 2] > 1)).float()
    found = spread_over(points, normals, 3 * told, told)
    assert float((found > 1)[ball].float().mean()) > 0.98 and float((found > 1)[~ball].float().mean()) < 0.02


def test_a_rounded_crease_parts_as_a_sharp_one():
    """Check that evidence for metal hardly crosses a fillet, over which the normals of neighbours differ little."""
    points, normals, ball = rounded(*ball_on_board(8000))
    told = ball & (points[:, 2] > 0.5)
    found = spread_over(points, normals, 3 * told.float(), told.float())
    board = ~ball & (points[:, :2].norm(dim=1) > 0.8)
    assert float((found > 1)[ball].float().mean()) > 0.9 and float((found > 1)[board].float().mean()) < 0.02


def test_evidence_spreads_as_far_however_dense_surfels_are():
    """Check how far down the top of a ball that tells one thing still outweighs the rest that tells the other."""
    lowest = []
    for count in (8000, 32000):
        points, normals, ball = ball_on_board(count)
        top = ball & (points[:, 2] > 1.8)
        found = spread_over(points, normals, torch.where(top, 5.0, -1.0), torch.ones(len(points)))
        lowest.append(float(points[ball & (found > 0), 2].quantile(0.02)))
    assert lowest == pytest.approx([lowest[0]] * 2, abs=0.04) and 1.2 < lowest[0] < 1.8


def test_paint_of_another_brightness_is_another_piece():
    """Check a ball whose lower half is painted black: no crease, but an edge of its brightness."""
    points, normals, ball = ball_on_board()
    upper = points[:, 2] > 1
    mean = torch.where(upper, 0.6, 0.01)[:, None].expand(-1, 3)
    found = spread_over(points, normals, torch.where(upper, 3.0, -1.0), torch.ones(len(points)), mean)
    assert float((found > 0)[ball & (points[:, 2] < 0.95)].float().mean()) < 0.02


def test_where_nothing_is_known_nothing_is_told():
    """Check that a board of which nothing is known gets no evidence from the ball, which has some."""
    points, normals, ball = ball_on_board()
    found = spread_over(points, normals, torch.full((len(points),), 3.0), ball.float())
    assert float(found[~ball].abs().quantile(0.95)) < 0.3
    assert np.allclose(found[ball], 3.0, atol=0.1)
