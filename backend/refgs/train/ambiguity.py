"""Measure ambiguities: changes of light and materials that cancel in all pictures, so that photos cannot tell them apart."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.compare.pictures import composite
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.train.state import RenderInputs, State

VIEWS = 6  # at the most
SMALL = 0.02  # part of a change over which its derivative is taken
UNSEEN = 0.25  # of the pictures' own error: a smaller change adds at most 6 % to its square

Explanation = tuple[Surfels, Tensor]
"""Surfels, and radiance (6·R², 3)."""
Change = Callable[[Explanation, float], Explanation]


def _brighter(of: Explanation, size: float) -> Explanation:
    return of[0], of[1] * (1 + size)


def _redder(of: Explanation, size: float) -> Explanation:
    return of[0], of[1] * (1 + size * torch.tensor([1.0, 0.0, -1.0]).to(of[1]))


def _blurred(of: Explanation, size: float) -> Explanation:
    """Blur the light of `of`: blend the mean of each texel's neighbours into the texel. `size` is the mean's weight.

    Neighbours lie on the same face, up to a sixteenth of the face's side away.
    """
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
    return of[0]._replace(metallic=of[0].metallic + size * (1 - 2 * of[0].metallic)), of[1]  # towards the other kind


class Trade(NamedTuple):
    """Pair a change of a given size with another change that may cancel it in the pictures.

    `change` is made by `size`, and `made_up` is the other change. `words` and `answer` name them for the artist.
    """

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
    """Measure at the end of the training how far the two changes of each trade (see `Trade`) cancel.

    Returns these figures for each of `TRADES`; without light, an empty dictionary. `alone`, `left` and `error` are root mean squares of
    encoded colours.

    `alone` is how far the first change alters the pictures. `answer` is the size of the other change that cancels it best. `left` is how
    far both changes together alter the pictures. `error` is the pictures' error against the photos. `what` is a line for the artist,
    present only if `left` is less than UNSEEN of `error`. Derivatives are finite differences.
    """
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
    """Render the training views `chosen` from surfels and radiance, flattened into one vector."""
    light = Environment(of[1].contiguous(), state.environment().reference)
    inputs = RenderInputs(of[0], light, state.settings.render, state.occluder)
    pictures = (state.picture(inputs, state.views[i].camera, state.exposure(i)) for i in chosen)
    return torch.cat([picture.color.clamp(0, 1).flatten() for picture in pictures])
