"""What photos do not tell: changes of light and materials that make up for one another in all of the pictures."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.compare.pictures import composite
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.renderer import render
from refgs.train.state import State

VIEWS = 6  # at the most
SMALL = 0.02  # the part of a change that its derivative is taken over
UNSEEN = 0.25  # of the error that the pictures have: a change that leaves less adds 6 % to its square

Explanation = tuple[Surfels, Tensor]
"""Surfels, and radiance (6·R², 3)."""
Change = Callable[[Explanation, float], Explanation]


def _brighter(of: Explanation, size: float) -> Explanation:
    return of[0], of[1] * (1 + size)


def _redder(of: Explanation, size: float) -> Explanation:
    return of[0], of[1] * (1 + size * torch.tensor([1.0, 0.0, -1.0]).to(of[1]))


def _blurred(of: Explanation, size: float) -> Explanation:
    """By so much of the way to a mean over neighbours on the face, a tenth of it or so about."""
    side = round((len(of[1]) // 6) ** 0.5)
    faces = of[1].view(6, side, side, 3).permute(0, 3, 1, 2)
    reach = max(1, side // 16)
    padded = torch.nn.functional.pad(faces, (reach,) * 4, mode="replicate")
    mean = torch.nn.functional.avg_pool2d(padded, 2 * reach + 1, stride=1).permute(0, 2, 3, 1).reshape(-1, 3)
    return of[0], (of[1] + size * (mean - of[1])).clamp_min(0)


def _lighter(of: Explanation, size: float) -> Explanation:
    return of[0]._replace(albedo=of[0].albedo * (1 + size)), of[1]


def _warmer(of: Explanation, size: float) -> Explanation:
    return of[0]._replace(albedo=of[0].albedo * (1 + size * torch.tensor([1.0, 0.0, -1.0]).to(of[1]))), of[1]


def _rougher(of: Explanation, size: float) -> Explanation:
    return of[0]._replace(roughness=(of[0].roughness + size).clamp(0, 1)), of[1]


def _more_metal(of: Explanation, size: float) -> Explanation:
    return of[0]._replace(metallic=of[0].metallic + size * (1 - 2 * of[0].metallic)), of[1]  # away from what it is


class Trade(NamedTuple):
    """A change of such a size, in words, and another change that may make up for it."""

    words: str
    change: Change
    size: float
    answer: str
    made_up: Change


TRADES = {
    "light_scale": Trade("light brighter by a quarter", _brighter, 0.25, "base colour", _lighter),
    "white_balance": Trade("light redder by a tenth", _redder, 0.1, "the base colour's tint", _warmer),
    "blur": Trade("all rougher by 0.1", _rougher, 0.1, "the light's sharpness", _blurred),
    "metal": Trade("metals a fifth less metallic, dielectrics a fifth more", _more_metal, 0.2, "base colour", _lighter),
}


def ambiguities(state: State) -> dict[str, dict]:
    """Of each trade: by how much the pictures change, `alone`, and what is `left` of that where the other change makes up for it, as well
    as that goes (root mean squares of encoded colours); `answer` is by how much that is; the pictures' own `error`; and `what` there
    is to say, where less is left than a quarter of that, else none. Derivatives are taken by differences at the end of the training."""
    light = state.environment()
    if light is None:
        return {}
    chosen = range(0, len(state.views), max(1, -(-len(state.views) // VIEWS)))
    with torch.no_grad():
        now = state.surfels(), light.radiance
        before = _pictures(state, now, chosen)
        photos = torch.cat([composite(state.views[i], state.background).flatten() for i in chosen])
        error = float((before - photos).square().mean().sqrt())
        found = {}
        for name, trade in TRADES.items():
            alone = (_pictures(state, trade.change(now, SMALL * trade.size), chosen) - before) / SMALL
            other = (_pictures(state, trade.made_up(now, SMALL), chosen) - before) / SMALL
            answer = -float((alone * other).sum() / other.square().sum().clamp_min(1e-20))
            left = float((alone + answer * other).square().mean().sqrt())
            facts = {"alone": float(alone.square().mean().sqrt()), "left": left, "answer": answer, "error": error}
            if left < UNSEEN * error:
                facts["what"] = f"{trade.words}: {trade.answer} can make up for it, the photos do not tell"
            found[name] = facts
    return found


def _pictures(state: State, of: Explanation, chosen: range) -> Tensor:
    """What photos would be, all of their numbers side by side."""
    reference, exposures = state.environment().reference, state.exposures
    light, found = Environment(of[1].contiguous(), reference), []
    for i in chosen:
        exposure = None if exposures is None else exposures[i].exp()
        settings = state.settings.render, state.near, state.occluder, exposure
        picture = render(of[0], light, state.views[i].camera, state.background, *settings)
        found.append(picture.color.clamp(0, 1).flatten())
    return torch.cat(found)
