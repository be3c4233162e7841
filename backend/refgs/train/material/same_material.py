"""Spread evidence over pieces of the surface: what photos tell of some surfels of a piece counts for the others, too.

The model is a random walk (Grady 2006) on a graph of neighbouring surfels. Steps are likely within a piece: a smooth surface of one
brightness. They are unlikely across a concave crease, sharp or rounded, where two objects or two parts touch.
"""

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import cg
from torch import Tensor

from refgs.train.material.observe import Seen

# Weight of differences between neighbours: it decides how far evidence spreads. It grows with the number of surfels, so that evidence
# spreads as far over a surface however densely surfels cover it. Few surfels need LEAST_REACH.
REACH, LEAST_REACH = 3.75e-3, 30.0
LINKED = 16
BENT, CREASED = 0.35, 0.12  # largest angles between neighbours' normals, in radians: convex and concave
HOLLOW = 1.7  # largest concave curvature, times the object's size: the visual hull and surfels round a crease where two things touch
STEP = 0.5  # largest sine of the angle at which a neighbour lies off the surfel's plane
SHADE = 1.0  # largest difference of the logarithms of the neighbours' mean radiances
FRINGE = 1.0  # surfels with fewer pixels in all photos take no part
NONE = 1e-5  # weight with which each value is drawn to 0, so that it is known where no other arrives
CG_TOLERANCE, CG_STEPS = 1e-3, 200  # tolerance and most steps of conjugate gradients


def spread(graph: sparse.csr_matrix, values: Tensor, weight: Tensor) -> Tensor:
    """Return the values x (N,) that minimise Σ w_i (x_i − v_i)² + reach Σ g_ij (x_i − x_j)².

    `values` (N,) is v and `weight` (N,) is w. `graph` is the Laplacian matrix of the edge weights g. The first sum keeps each x_i near its
    given value v_i. The second sum makes neighbours alike. Where no value arrives, x is 0.

    The first sum grows with N. The second sum does not: it approximates the integral of the squared gradient over the surface. So `reach`
    is proportional to N, but at least LEAST_REACH. Then evidence spreads equally far whatever N is.
    """
    given = weight.double().numpy()
    matrix = max(REACH * len(given), LEAST_REACH) * graph + sparse.diags(given + NONE)
    scale = sparse.diags(1 / matrix.diagonal())
    found = cg(matrix, given * values.double().numpy(), rtol=CG_TOLERANCE, maxiter=CG_STEPS, M=scale)[0]
    return torch.from_numpy(found).float()


def laplacian(positions: Tensor, seen: Seen, near: Tensor) -> sparse.csr_matrix:
    """Return the Laplacian (N, N) of neighbouring surfels, with edge weights from 0 to 1.

    `near` (N, K) are the nearest surfels, themselves first. At most LINKED of the others are linked.
    """
    points, linked = positions.double().numpy(), near[:, 1 : LINKED + 1].numpy()
    count = len(points)
    one, other = np.repeat(np.arange(count), linked.shape[1]), linked.ravel()
    normal = seen.outward.double().numpy()
    apart = points[other] - points[one]
    apart /= np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-12)
    angle = np.arccos((normal[one] * normal[other]).sum(axis=1).clip(-1, 1))
    concave = ((normal[other] - normal[one]) * apart).sum(axis=1) < 0
    off = (apart * normal[one]).sum(axis=1)
    curvature = _concave(points, normal, near.numpy())
    hollow = (curvature[one] + curvature[other]) / 2
    shade = (seen.mean.clamp_min(0) + 0.05 * seen.mean.mean() + 1e-6).log().double().numpy()
    differs = np.linalg.norm(shade[one] - shade[other], axis=1)
    bent = (angle / np.where(concave, CREASED, BENT)) ** 2 + (hollow / HOLLOW) ** 2
    exponent = bent + (off / STEP) ** 2 + (differs / SHADE) ** 2
    part = (seen.pixels > FRINGE).numpy()
    graph = sparse.coo_matrix((np.exp(-exponent) * part[one] * part[other], (one, other)), (count, count)).tocsr()
    graph = (graph + graph.T) / 2
    return sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph


def _concave(points: np.ndarray, normals: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return how concave the surface is at each point, (N,): a normal curvature, times the size of all; 0 where it is convex.

    It is the mean over neighbours `near` (N, K) whose `normals` (N, 3) are within a right angle, by least squares: on a sphere, normals
    differ as points do, divided by the radius. Size is the points' root mean square distance from their mean.
    """
    apart, turned = points[near] - points[:, None], normals[near] - normals[:, None]
    same = np.einsum("nka,na->nk", normals[near], normals) > 0
    bends, squares = ((same * (each * apart).sum(axis=2)).sum(axis=1) for each in (turned, apart))
    size = np.sqrt(points.var(axis=0).sum())
    return np.maximum(-size * bends / np.maximum(squares, 1e-12), 0)
