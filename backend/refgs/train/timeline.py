"""Tell when things are done in a training."""

import math

from refgs.settings import DensifySettings, RateSettings
from refgs.train.state import State

RESET = 0.01  # opacity
SEEN = 0.2  # opacity from which on surfels explain a picture: nothing is decided, and no mesh is made, of fainter ones
SOONEST = 100  # iterations: a mirror that has learned for fewer looks dull


def decidable(state: State) -> bool:
    """Tell whether surfels, materials and light can be judged now.

    They cannot in the initial stage, while surfels are faint after an opacity reset, and in a method without materials of pixels.
    """
    by_pixels = state.method.deferred and state.settings.render.diffuse == "irradiance"
    return by_pixels and not state.initial and not faint_now(state)


def since_propagation(state: State) -> int | None:
    """Count the iterations since normals were last propagated (see `propagate_normals`).

    Returns None before the first propagation, and once the training no longer propagates normals.
    """
    settings, iteration = state.settings.propagation, state.iteration
    if not settings.every or iteration < settings.every or not state.method.lit:
        return None
    last = iteration // settings.every * settings.every
    return iteration - last if last / state.total < settings.stop else None


def faint_now(state: State, opacity: float = SEEN) -> bool:
    """Tell whether the last opacity reset was so recent that useful surfels may still be too transparent.

    An opacity reset makes all surfels nearly transparent. Useful surfels become opaque again as they learn, and this function estimates
    whether they have had enough iterations to reach `opacity`.
    """
    return faint(state.settings.densify, state.settings.rates, state.iteration, state.total, opacity)


def faint(settings: DensifySettings, rates: RateSettings, iteration: int, total: int, opacity: float) -> bool:
    """Tell whether the last opacity reset before `iteration` was so recent that useful surfels may still be too transparent.

    An opacity reset makes all surfels nearly transparent. Useful surfels become opaque again as they learn. The time until they reach
    `opacity` is estimated: in each iteration, Adam moves an opacity's logit by about the learning rate, which decays. The function returns
    true until four times this estimate has passed. `total` is the number of iterations of the training.
    """
    every = settings.reset_every
    last = min(iteration, math.ceil(settings.stop * total)) - 1  # a reset at the end of this iteration does not count
    if not every or last < every:
        return False
    since, decay = last // every * every, rates.decay
    iterations = (
        iteration - since
        if decay == 1
        else total * (decay ** (since / total) - decay ** (iteration / total)) / -math.log(decay)
    )
    opacity = max(opacity, RESET)
    return iterations * rates.opacity < 4 * math.log(opacity / (1 - opacity) * (1 - RESET) / RESET)
