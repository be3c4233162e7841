"""Make points of a ball that stands on a board, what photos show of them, and what is reckoned from that."""

import math

import torch

from refgs.model.surfels import activate
from refgs.train.material import reckoning, same_material
from refgs.train.material.observe import NEIGHBOURS, Seen, neighbours


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


def rounded(points, normals, ball, radius=0.1):
    """Round the crease between ball and board by a fillet of that `radius`, as a visual hull does. It belongs to neither."""
    middle = torch.tensor([2 * radius**0.5, radius])  # of the circle that touches both: across and up
    tangent = 1 - (1 - radius) / (1 + radius)  # height at which it touches the ball
    across = points[:, :2].norm(dim=1)
    kept = torch.where(ball, points[:, 2] > tangent, across > middle[0])
    generator = torch.Generator().manual_seed(1)
    turn, arc = torch.rand(2, 2000, generator=generator)
    angle = -torch.pi / 2 - arc * math.acos(1 - tangent / radius)
    ring = torch.stack([angle.cos(), angle.sin()])  # from the circle's middle to the fillet
    out, up = middle[:, None] + radius * ring
    around = torch.stack([(2 * torch.pi * turn).cos(), (2 * torch.pi * turn).sin()])
    fillet = torch.cat([out * around, up[None]]).T
    facing = -torch.cat([ring[0] * around, ring[1:]]).T
    joined = (torch.cat([old[kept], new]) for old, new in ((points, fillet), (normals, facing)))
    return *joined, torch.cat([ball[kept], torch.zeros(len(fillet), dtype=torch.bool)])


def seen_as(points, normals, mean=None, shown=None):
    """Make what one photo shows of surfels (N,) that face its camera: the radiance `mean` (N, 3), 0.5 by default.

    `shown` (N,) are the surfels that it shows; all by default.
    """
    count = len(points)
    mean = torch.full((count, 3), 0.5) if mean is None else mean
    one = torch.ones(count, 1)
    pixels = 9 * (torch.ones(count) if shown is None else shown.float())
    clipped = torch.zeros(count, 1, 3, dtype=torch.bool)
    return Seen(mean[:, None], clipped, 9 * one, pixels, mean, normals[:, None], normals[:, None])


def reckoned(points, normals, metal, metallic, by_object=False):
    """Make what `reckoning.reckon` returns, for probabilities `metal` (N,) and what the training has learned so far."""
    count = len(points)
    start = {"position": points, "albedo": torch.zeros(count, 3), "metallic": metallic, "roughness": torch.zeros(count)}
    start |= {"rotation": torch.tensor([1.0, 0, 0, 0]).expand(count, 4), "scale": torch.zeros(count, 2)}
    start |= {"opacity": torch.zeros(count), "received": torch.ones(count, 3), "sh_dc": torch.zeros(count, 1, 3)}
    start |= {name: torch.zeros(count, 15, 3) for name in ("sh_rest", "indirect_rest")}
    start["indirect_dc"] = torch.zeros(count, 1, 3)
    start["albedo"][:, 0] = torch.where(points[:, 2] > 1, 2.0, -2.0)
    start["roughness"] = torch.where(points[:, 2] > 1, -3.0, 0.0)
    seen = seen_as(points, normals)
    fitted = torch.full((count, 3), 0.8), torch.full((count,), 0.2), torch.full((count,), by_object)
    near = neighbours(points, NEIGHBOURS)
    graph = same_material.laplacian(points, seen, near)
    known = torch.ones(count, dtype=torch.bool)
    sums = torch.full((count, 3), 0.8), torch.ones(count, 3), torch.zeros(count, 1, dtype=torch.bool)
    changes = reckoning.mean_and_changes(seen, near)[1]
    return reckoning.Reckoned(metal, activate(start), seen, seen.pixels, *fitted, *sums, changes, graph, {}, known)
