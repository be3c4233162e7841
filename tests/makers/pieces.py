"""Make points of a ball that stands on a board, and what photos show of them."""

import torch

from refgs.train.material.observe import Seen


def ball_on_board(count=4000):
    """Return points and normals of a ball that stands on a board, and which of them are the ball's."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    normal = normal[normal[:, 2] > -0.95]
    board = 4 * torch.rand(count, 3, generator=generator) - 2
    board[:, 2] = 0
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(board), 3)
    points = torch.cat([normal + torch.tensor([0.0, 0.0, 1.0]), board])
    ball = torch.arange(len(points)) < len(normal)
    return points, torch.cat([normal, up]), ball


def seen_as(points, normals, mean=None, shown=None):
    """Make what one photo shows of surfels (N,) that face its camera: the radiance `mean` (N, 3), 0.5 by default.

    `shown` (N,) are the surfels that it shows; all by default.
    """
    count = len(points)
    mean = torch.full((count, 3), 0.5) if mean is None else mean
    one = torch.ones(count, 1)
    pixels = 9 * (torch.ones(count) if shown is None else shown.float())
    return Seen(mean[:, None], 9 * one, pixels, mean, normals[:, None], normals[:, None])
