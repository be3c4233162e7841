"""Measure ambiguities: pairs of changes to light or materials. Together, the two changes of a pair may leave all pictures as they are."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.compare.pictures import composite
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.train.learn.exposures import exposure
from refgs.train.state import RenderInputs, State

TRADE_VIEWS = 6  # training views that are compared, at most
SMALL = 0.02  # fraction of a change that is made to estimate its derivative
UNSEEN = 0.25  # fraction of the pictures' own error: a smaller change adds at most 6 % to its square

Explanation = tuple[Surfels, Tensor]
"""Surfels, and radiance (6·R², 3)."""
Change = Callable[[Explanation, float], Explanation]


def _brighter(old: Explanation, size: float) -> Explanation:
    return old[0], old[1] * (1 + size)


def _redder(old: Explanation, size: float) -> Explanation:
    return old[0], old[1] * (1 + size * torch.tensor([1.0, 0.0, -1.0]).to(old[1]))


def _blurred(old: Explanation, size: float) -> Explanation:
    """Blend each texel of the environment with the mean around it, weighted by `size`."""
    # The mean is over texels of the same face, up to a sixteenth of its side away.
    side = round((len(old[1]) // 6) ** 0.5)
    faces = old[1].view(6, side, side, 3).permute(0, 3, 1, 2)
    reach = max(1, side // 16)
    padded = torch.nn.functional.pad(faces, (reach,) * 4, mode="replicate")
    mean = torch.nn.functional.avg_pool2d(padded, 2 * reach + 1, stride=1).permute(0, 2, 3, 1).reshape(-1, 3)
    return old[0], (old[1] + size * (mean - old[1])).clamp_min(0)


def _lighter(old: Explanation, size: float) -> Explanation:
    return old[0]._replace(albedo=old[0].albedo * (1 + size)), old[1]


def _warmer(old: Explanation, size: float) -> Explanation:
    return old[0]._replace(albedo=old[0].albedo * (1 + size * torch.tensor([1.0, 0.0, -1.0]).to(old[1]))), old[1]


def _rougher(old: Explanation, size: float) -> Explanation:
    return old[0]._replace(roughness=(old[0].roughness + size).clamp(0, 1)), old[1]


def _more_metal(old: Explanation, size: float) -> Explanation:
    # Move metal towards paint, and paint towards metal.
    return old[0]._replace(metallic=old[0].metallic + size * (1 - 2 * old[0].metallic)), old[1]


class Trade(NamedTuple):
    """Hold two changes of the scene that may cancel in the pictures, such as a brighter light and a darker base colour.

    The function `change` makes the first change, with the strength `size`. The function `made_up` makes the second change, with any
    strength. Two texts are for the user: `words` describes the first change, and `answer` names what the second change alters.
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
    """Measure how well the two changes of each pair in `TRADES` cancel in the pictures of a finished training.

    Returns a dictionary of values for each pair, by the pair's name; {} if the scene has no light. The values are:

    - `alone`: how much the first change alters the pictures.
    - `answer`: the strength of the second change that cancels the first one best.
    - `left`: how much both changes together still alter the pictures.
    - `error`: how much the pictures differ from the photos.
    - `what`: a message for the user. It is present only if `left` is less than UNSEEN times `error`.

    `alone`, `left` and `error` are root mean squares of differences of sRGB-encoded colours. To measure how a change alters the pictures,
    only the fraction SMALL of it is made, and the difference is divided by SMALL.
    """
    light = state.environment()
    if light is None:
        return {}
    chosen = range(0, len(state.views), max(1, -(-len(state.views) // TRADE_VIEWS)))
    with torch.no_grad():
        now = state.surfels(), light.radiance
        before = [*_pictures(state, now, chosen)]
        photos = (composite(state.views[i], state.background) for i in chosen)
        count = sum(picture.numel() for picture in before)
        error = (sum(float((a - b).square().sum()) for a, b in zip(before, photos, strict=True)) / count) ** 0.5
        found = {}
        for name, trade in TRADES.items():
            scenes = trade.change(now, SMALL * trade.size), trade.made_up(now, SMALL)
            # Dot products of both changes, summed view by view, because photos may be large.
            dots = torch.zeros(2, 2, dtype=torch.double)
            for old, *pair in zip(before, *(_pictures(state, scene, chosen) for scene in scenes), strict=True):
                changes = [((picture - old) / SMALL).double().flatten() for picture in pair]
                dots += torch.tensor([[float(a @ b) for b in changes] for a in changes])
            alone, both, other = (float(dots[i, j]) / count for i, j in ((0, 0), (0, 1), (1, 1)))
            answer = -both / max(other, 1e-20 / count)
            left = max(alone + answer * both, 0.0) ** 0.5
            facts = {"alone": alone**0.5, "left": left, "answer": answer, "error": error}
            if left < UNSEEN * error:
                facts["what"] = f"{trade.words}: {trade.answer} can make up for it, the photos do not tell"
            found[name] = facts
    return found


def _pictures(state: State, scene: Explanation, chosen: range) -> Iterator[Tensor]:
    """Render `scene` in the training views `chosen`, sRGB-encoded (H, W, 3) in 0..1."""
    light = Environment(scene[1].contiguous(), state.inputs().light.reference)
    inputs = RenderInputs(scene[0], light, state.settings.render, state.occluder)
    for view in chosen:
        yield state.picture(inputs, state.views[view].camera, exposure(state, view)).color.clamp(0, 1)
