"""Decide between metal and paint for whole pieces of the surface: evidence about some surfels of a piece spreads to the others.

The model is a random walk with seeds (Grady 2006) on a graph of neighbouring surfels. Steps are likely within a piece: a smooth surface of
one brightness. They are unlikely across a concave crease, where two objects or two parts touch.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import cg
from torch import Tensor

from refgs.model.surfels import Surfels
from refgs.train.material.mirrored import REFLECTANCE, Fit
from refgs.train.material.observe import Kinds, Seen, neighbours

# Limits of a surfel's error as a metal, divided by its error as paint. The surfel is a metal below RATIO.metal, if its radiance changes
# with what it mirrors by at least SLOPE, and its reflectance is at least REFLECTANCE. It is paint above RATIO.paint.
RATIO = Kinds(metal=0.6, paint=2.5)
SLOPE = 0.12
SURE = 1.5  # evidence does not count more beyond this logarithm of that ratio
AGAINST_METAL = 0.5  # weight of evidence for paint: a metal whose shape is wrong looks like paint
SO_FAR = Kinds(metal=0.15, paint=0.045)  # weight of the kind that training has found so far
LIKELY, UNLIKELY = 0.5, 0.2  # probabilities of metal above which paint becomes metal, and below which metal, paint
OPEN = 0.02 * SURE  # weight with which `doubt` draws a surfel towards neither kind
FITTED = 0.01  # weight of a metal's material if it is only fitted, relative to a learned one
# Weight of differences between neighbours: it decides how far evidence spreads. It grows with the number of surfels, so that evidence
# spreads as far over a surface however densely surfels cover it. Few surfels need LEAST_REACH.
REACH, LEAST_REACH = 3.75e-4, 3.0
LINKED = 16
BENT, CREASED = 0.35, 0.12  # largest angles between neighbours' normals, in radians: convex and concave
STEP = 0.5  # largest sine of the angle at which a neighbour lies off the surfel's plane
SHADE = 1.0  # largest difference of the logarithms of the neighbours' mean radiances
FRINGE = 1.0  # surfels with fewer pixels in all photos take no part
CG_TOLERANCE, CG_STEPS = 1e-3, 200  # tolerance and most steps of conjugate gradients


class Found(NamedTuple):
    """Hold the decision for N surfels.

    - `metal` (N,): bool, the surfels that were taken for paint, but are metal
    - `paint` (N,): bool, the surfels that were taken for metal, but are paint
    - `like_metals` (N, 4): base colour and roughness of the metals to which each surfel is connected
    """

    metal: Tensor
    paint: Tensor
    like_metals: Tensor


def decide(surfels: Surfels, seen: Seen, fit: Fit) -> Found:
    """Find surfels that the training has taken for the wrong kind, metal or paint. The evidence is from photos (see `material.mirrored`).

    Evidence for either kind spreads to neighbours over a surface. Where no evidence arrives, surfels keep the kind that the training has
    found so far. This kind is no evidence: it does not spread to neighbours of the other kind.
    """
    graph, part, metal, paint = _evidence(surfels, seen, fit)
    was, none = (surfels.metallic > 0.5).numpy(), 1e-4
    likely = _solve(graph, metal + AGAINST_METAL * paint + SO_FAR.paint * part + none, metal)
    kept = SO_FAR.metal * was * part
    unlikely = _solve(graph, metal + paint + kept + none, metal + kept)
    given = fit.by_object.numpy()
    sure = np.clip(metal, 0, 1) * (likely > LIKELY) * np.where(was | given, 1, FITTED)
    learned, fitted = (
        torch.cat([colour, rough[:, None]], dim=1).double().numpy()
        for colour, rough in ((surfels.albedo, surfels.roughness), (fit.reflectance, fit.roughness))
    )
    # Surfels that were paint so far have learned the colour of what they mirror, so their fitted material is used. Metals have learned a
    # wrong base colour where the light is wrong, but what they show of the object tells the right one.
    material = np.where((was & ~given)[:, None], learned, fitted)
    mean = (material * sure[:, None]).sum(axis=0) / max(sure.sum(), 1e-9)
    like = [_solve(graph, sure + none, sure * of + none * all_of) for of, all_of in zip(material.T, mean, strict=True)]
    turned = torch.from_numpy(~was & (likely > LIKELY)), torch.from_numpy(was & (unlikely < UNLIKELY))
    return Found(*turned, torch.from_numpy(np.stack(like, axis=1)).float())


def doubt(surfels: Surfels, seen: Seen, fit: Fit) -> Tensor:
    """Measure how hard it is to distinguish metal from paint in the photos: (N,), 0..1. Metallic values learned so far do not count.

    Doubt is 0 where photos show the kind clearly. It is 1 where hardly any pixel shows the surfel, or where photos show nothing about the
    smooth piece of surface around it. Elsewhere it rises with the distance from surfels of the same piece whose kind photos show.

    Let p be the probability of metal. Doubt is 1 − |2 p − 1|. The value 2 p − 1 spreads as in `decide`, from evidence for metal (1) and for
    paint (−1). Far from all evidence, it tends to 0, because all surfels are drawn to 0 with the small weight OPEN.
    """
    graph, _, metal, paint = _evidence(surfels, seen, fit)
    return 1 - torch.from_numpy(_solve(graph, metal + paint + OPEN, metal - paint)).float().abs().clamp_max(1)


def _evidence(surfels: Surfels, seen: Seen, fit: Fit) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray, np.ndarray]:
    """Return the Laplacian, which surfels can be judged, and evidence for metal and for paint."""
    graph, part = laplacian(surfels.positions, seen), (seen.pixels > FRINGE).double().numpy()
    ratio = np.asarray((fit.ratio.clamp(1e-3, 1e3).log().double() * fit.seen).numpy())
    mirrors = (fit.slope > SLOPE) & (fit.reflectance.amax(dim=1) > REFLECTANCE)
    metal = np.where(mirrors.numpy() & (ratio < np.log(RATIO.metal)), np.clip(-ratio, 0, SURE), 0) * part
    return graph, part, metal, np.clip(ratio - np.log(RATIO.paint), 0, SURE) * part


def _solve(graph: sparse.csr_matrix, weight: np.ndarray, weighted: np.ndarray) -> np.ndarray:
    """Solve for the values x (N,) that minimise Σ w_i (x_i − v_i)² + reach Σ g_ij (x_i − x_j)².

    `weight` is w. `weighted` is the product w v. `graph` is the Laplacian matrix of the edge weights g. The first sum keeps each x_i near
    its given value v_i. The second sum makes neighbours alike.

    The first sum grows with N. The second sum does not: it approximates the integral of the squared gradient over the surface. So `reach`
    is proportional to N, but at least LEAST_REACH. Then evidence spreads equally far whatever N is.
    """
    reach = max(REACH * len(weight), LEAST_REACH)
    return cg(reach * graph + sparse.diags(weight), weighted, rtol=CG_TOLERANCE, maxiter=CG_STEPS)[0]


def laplacian(positions: Tensor, seen: Seen) -> sparse.csr_matrix:
    """Return the Laplacian (N, N) of neighbouring surfels, with edge weights from 0 to 1."""
    points, near = positions.double().numpy(), neighbours(positions, LINKED + 1)[:, 1:].numpy()
    count = len(points)
    one, other = np.repeat(np.arange(count), near.shape[1]), near.ravel()
    normal = seen.outward.double().numpy()
    apart = points[other] - points[one]
    apart /= np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-12)
    angle = np.arccos((normal[one] * normal[other]).sum(axis=1).clip(-1, 1))
    concave = ((normal[other] - normal[one]) * apart).sum(axis=1) < 0
    off = (apart * normal[one]).sum(axis=1)
    shade = (seen.mean.clamp_min(0) + 0.05 * seen.mean.mean() + 1e-6).log().double().numpy()
    differs = np.linalg.norm(shade[one] - shade[other], axis=1)
    exponent = (angle / np.where(concave, CREASED, BENT)) ** 2 + (off / STEP) ** 2 + (differs / SHADE) ** 2
    part = (seen.pixels > FRINGE).numpy()
    graph = sparse.coo_matrix((np.exp(-exponent) * part[one] * part[other], (one, other)), (count, count)).tocsr()
    graph = (graph + graph.T) / 2
    return sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
