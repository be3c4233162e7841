"""Ask the artist what photos leave open: the largest pieces of the surface that may be metal or paint.

A piece is a smooth part of the surface of about one brightness (see `same_material.laplacian`) in which photos do not tell. An artist sees
at a glance what it is made of. One answer is a hint for a training (`train.hints`).
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs
from torch import Tensor

from refgs.compare.pictures import as_bytes
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.rasterize import rasterize
from refgs.render.volume import discs
from refgs.train import probe
from refgs.train.material.reckoning import Reckoned
from refgs.train.state import State

DOUBTFUL = 0.5  # photos do not tell metal from paint if doubt is at least this
MOST = 5  # questions: an artist answers a handful
LEAST = 0.01  # of the surface; smaller pieces are not worth a training
LINK = 0.1  # least edge weight between neighbours of one piece
MARGIN = 0.4  # of a piece's size in its picture, on each side
OUTLINE = np.array([255, 140, 0], np.uint8)  # sRGB


class Question(NamedTuple):
    """Hold a piece of the surface of which photos do not tell whether it is metal or paint.

    - `part`: its fraction of the surface, by the pixels that show it
    - `now`: what the training took it for, "metal" or "paint"
    - `members` (N,): bool, its surfels
    - `picture` (H, W, 3): sRGB bytes. Below a photo that outlines the piece are the piece as metal and, beside it, as paint, at half the
      size, in the recovered light.
    """

    part: float
    now: str
    members: Tensor
    picture: np.ndarray


@torch.no_grad()
def ask(state: State, found: Reckoned, doubt: Tensor) -> list[Question]:
    """Find the largest pieces of which photos do not tell what they are, the largest first. All arguments are on the CPU."""
    weight = found.pixels.double().numpy()
    whole = max(weight.sum(), 1e-6)
    questions = []
    for members in pieces(found, doubt, weight):
        size = weight * members
        share = size.sum() / whole
        if share < LEAST or len(questions) == MOST:
            break
        metal = (found.surfels.metallic.double().numpy() * size).sum() / size.sum() > 0.5
        mask = torch.from_numpy(members)
        picture = _picture(state, found, mask)
        questions.append(Question(float(share), "metal" if metal else "paint", mask, picture))
    return questions


def pieces(found: Reckoned, doubt: Tensor, weight: np.ndarray) -> list[np.ndarray]:
    """Divide the surfels whose doubt is at least DOUBTFUL into pieces. Return their masks (N,), those with the largest `weight` first.

    Surfels that hardly any pixel shows belong where the nearest of the others does.
    """
    shown, points = found.shown.numpy(), found.surfels.positions.numpy()
    open_ = (doubt >= DOUBTFUL).numpy() & shown
    links = (-found.graph).tocoo()
    kept = (links.data > LINK) & open_[links.row] & open_[links.col] & (links.row != links.col)
    links.data, links.row, links.col = links.data[kept], links.row[kept], links.col[kept]
    _, number = connected_components(links, directed=False)
    total = np.bincount(number[open_], weight[open_], minlength=1)
    nearest = np.flatnonzero(shown)[cKDTree(points[shown]).query(points)[1]] if shown.any() else np.arange(len(points))
    return [(open_ & (number == piece))[nearest] for piece in np.argsort(-total) if total[piece] > 0]


def _picture(state: State, found: Reckoned, members: Tensor) -> np.ndarray:
    """Draw a photo, and the piece as metal and as paint. The view is the one in which the piece has the most pixels."""
    inputs = state.inputs()
    either = _either(found, inputs.light, members)

    def shown(view: int) -> Tensor:
        camera = state.photo(view, whole=True).camera
        feature = members.to(state.device).float()[:, None]
        return rasterize(*discs(inputs.surfels, camera), feature, camera, near=state.near).features[..., 0]

    shares = {view: shown(view) for view in probe.spread_views(state)}
    view = max(shares, key=lambda view: float(shares[view].sum()))
    piece = shares[view] > 0.5
    rows, columns = (_around(piece.any(dim=1 - axis).numpy(force=True), size) for axis, size in enumerate(piece.shape))
    photo = state.photo(view, whole=True).over(state.background).numpy(force=True)
    panels = [as_bytes(photo[rows, columns])]
    inside = piece[rows, columns].numpy(force=True)
    edge = inside & ~(np.roll(inside, 1, 0) & np.roll(inside, -1, 0) & np.roll(inside, 1, 1) & np.roll(inside, -1, 1))
    panels[0][edge] = OUTLINE
    for kind in either:
        changed = inputs._replace(surfels=Surfels(*(value.to(state.device) for value in kind)))
        color = probe.picture(state, view, changed, whole=True).color.numpy(force=True)
        panels.append(as_bytes(color[rows, columns]))
    return np.concatenate([panels[0].repeat(2, axis=0).repeat(2, axis=1), np.concatenate(panels[1:], axis=1)])


def _around(shown: np.ndarray, size: int) -> slice:
    at = np.flatnonzero(shown)
    if not len(at):
        return slice(0, size)
    margin = round(MARGIN * (at[-1] - at[0] + 1)) + 1
    return slice(max(0, at[0] - margin), min(size, at[-1] + margin + 1))


def _either(found: Reckoned, light: Environment, members: Tensor) -> tuple[Surfels, Surfels]:
    """Return the surfels with the piece as the metal that fits photos best, and as paint of the radiance that photos show."""
    surfels, seen = found.surfels, found.seen
    received = surfels.received * light.diffuse(seen.outward.to(light.radiance)).cpu()
    paint = (seen.mean / received.clamp_min(1e-4)).clamp(0.02, 0.95)
    was_paint = (surfels.metallic < 0.5)[:, None]
    paint = torch.where(was_paint, surfels.albedo, paint)
    metal = torch.where(was_paint, found.reflectance, surfels.albedo)
    rough = torch.where(was_paint[:, 0], found.roughness, surfels.roughness)

    def with_piece(albedo: Tensor, metallic: float, roughness: Tensor) -> Surfels:
        value = torch.full_like(surfels.metallic, metallic)
        return surfels._replace(
            albedo=torch.where(members[:, None], albedo, surfels.albedo),
            metallic=torch.where(members, value, surfels.metallic),
            roughness=torch.where(members, roughness, surfels.roughness),
        )

    return with_piece(metal, 1.0, rough), with_piece(paint, 0.0, surfels.roughness)
