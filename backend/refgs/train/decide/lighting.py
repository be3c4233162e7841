"""Decide whether a scene needs inter-reflection, the light's full resolution, and all degrees of spherical harmonics."""

import math

import torch

from refgs.formats.needs import Found
from refgs.model.prefilter import IRRADIANCE_SIDE
from refgs.render.sums import blended_shares
from refgs.train import probe
from refgs.train.decide.materials import INDIRECT
from refgs.train.decide.need import ASKED, MEGA, NUMBER, Decision, Given, Moment, Need, megabytes
from refgs.train.decide.object_size import object_size, texels_of_light
from refgs.train.learn import light
from refgs.train.state import RenderInputs, State

VISIBLE = 0.1  # dB over a small part of the object (`probe.PART`): in the mean, the rest of the object hides it


class Reflections(Need):
    """Decide whether the scene needs inter-reflection: whether the object visibly mirrors itself."""

    name, what, shown = "reflections", "inter-reflection", True
    threshold = 0.1  # dB
    reason = "it is between mirroring black and mirroring the light: more than the object's own light can be worth"
    moments = ("start", "mesh")
    # A small part of the object counts from this fraction of `indirect.least` on. As a mesh of 32 voxels, a ball hides 0.15 % of itself; as
    # one of 96, nothing.
    HOLLOW = 0.3
    # PSNR in dB over a small part (`probe.PART`); a black dielectric of roughness 0.5 has 2.4, a chrome bell 6, a mirror 20.
    SMALL_PART = 3.0

    def due(self, state: State, moment: Moment) -> bool:
        return moment == "mesh" or self.asked(state) == "off"

    @torch.no_grad()
    def measure(self, state: State, given: Given) -> Decision:
        """Decide by two measurements whether inter-reflection is needed.

        The first is `given.hidden`, the fraction of the object's pixels that mirror the object itself. The second is how many dB of PSNR
        inter-reflection can gain at most. Inter-reflection is needed if both values reach their thresholds. If it gains much in a small
        part of the object, the threshold of the first value is lower. Nothing is measured if the user's setting is "off".
        """
        if self.asked(state) == "off":
            return Decision(False, ASKED)
        hidden = given.hidden
        why, least = share_hidden(hidden), state.settings.indirect.least
        if hidden < self.HOLLOW * least:
            return Decision(False, why, self._saved(state), hidden, self.HOLLOW * least)
        explained = probe.reflections_explain(state)
        why += f", where mirroring black would change the pictures by {explained.whole:.2f} dB"
        if hidden >= least and explained.whole >= self.threshold:
            return Decision(True, why, {}, explained.whole)
        # A hollow chrome knob on a clay jar needs this: clay is most of the object, and hides the knob in both means.
        why += f", {explained.part:.2f} where it shows most"
        needed = explained.part >= self.SMALL_PART
        return Decision(needed, why, {} if needed else self._saved(state), explained.part, self.SMALL_PART)

    def _saved(self, state: State) -> dict[str, float]:
        def without(inputs: RenderInputs) -> RenderInputs:
            return inputs._replace(occluder=None)

        seconds, size = probe.seconds_saved(state, without), megabytes(state, INDIRECT)
        return {"seconds": seconds, "decibels": probe.psnr_loss(state, without).whole, "megabytes": size}

    def apply(self, state: State, found: Found) -> None:
        state.occluder = None
        state.learned.drop(*INDIRECT)


def share_hidden(hidden: float) -> str:
    """Return a phrase that says how much (`hidden`, 0..1) of the object mirrors itself."""
    return f"the object mirrors itself on {hidden:.1%} of it"


class Light(Need):
    """Decide whether the scene needs the full-resolution light; if not, the cubemap is reduced."""

    name, what = "light", "all of the light's texels"
    threshold, reason = 0.01, "dB; a coarser light that costs more is not taken, whatever the roughness"
    moments, follows = ("light",), "specular"
    GLOSSIEST = probe.PART / 2  # part of the picture that may be glossier than the roughness that chooses texels
    LOBE = 0.5  # fraction of a lobe's width that a texel may take

    def due(self, state: State, moment: Moment) -> bool:
        return moment == "light"

    @torch.no_grad()
    def measure(self, state: State, given: Given) -> Decision:
        inputs, finest = state.inputs(), state.settings.environment.resolution
        coarsest, least = min(IRRADIANCE_SIDE, finest), None
        if inputs.settings.reflection == "none":
            side, roughness = coarsest, None
            why = f"nothing is mirrored: irradiance has {coarsest} texels along a side"
        else:
            cameras = [state.photo(view).camera for view in probe.spread_views(state)]
            weight = blended_shares(inputs.surfels, cameras, state.near).sum(dim=0)
            roughness = probe.quantile(inputs.surfels.roughness, weight, self.GLOSSIEST)
            side = resolvable(roughness, self.LOBE, finest, coarsest)
            rougher = f"{1 - self.GLOSSIEST:.1%} of the pictures are rougher than {roughness:.2f}"
            why = f"{rougher}, whose lobe {side} texels along a side show"
            least = math.sqrt(math.pi / 2 / (finest // 2) / self.LOBE)
        if side >= finest:
            return Decision(True, why, {}, roughness, least)
        side = min(side, inputs.light.resolution)

        def coarse(inputs: RenderInputs) -> RenderInputs:
            return inputs._replace(environment=inputs.light.reduced(side))

        loss = probe.psnr_loss(state, coarse)
        if (loss.whole > self.threshold or loss.part > VISIBLE) and self.asked(state) == "auto":
            why = f"{why}, and yet the photos know {loss.whole:.2f} dB of the finer ones, {loss.part:.2f} where they show most"
            return Decision(True, why, {}, roughness, least)
        figures = {"side": side, "seconds": probe.seconds_saved(state, coarse)}
        figures |= {"megabytes": 6 * (finest**2 - side**2) * 3 * NUMBER / MEGA, "decibels": loss.whole}
        return Decision(False, why, figures, roughness, least, lambda: light.coarsen(state, side))

    def apply(self, state: State, found: Found) -> None:
        state.change("environment.resolution", int(found.side or 0), "needs", found.why)

    def undo(self, state: State, why: str) -> None:
        state.change("environment.resolution", texels_of_light(state, object_size(state).span), "needs", why)


def resolvable(roughness: float, part: float, finest: int, coarsest: int) -> int:
    """Return the lowest cubemap resolution, in texels along a side, that still shows reflections of a surface with this roughness.

    The result lies between `coarsest` and `finest`. A texel may be at most `part` times as wide as the reflection's lobe, which is
    roughness² radians wide.
    """
    side = coarsest
    while side < finest and math.pi / 2 / side > part * roughness**2:
        side *= 2
    return side


class Degrees(Need):
    """Decide whether the scene needs all degrees of spherical harmonics.

    Harmonics are learned for two colours that change with the direction: the residual, which is what material and light do not explain, and
    the reflection of the object in itself.
    """

    name, what = "degrees", "all degrees of harmonics"
    threshold, reason = 0.01, "dB of the training views: nobody sees it"
    moments = ("degrees",)

    @torch.no_grad()
    def measure(self, state: State, given: Given) -> Decision:
        figures, why, counts = {"seconds": 0.0, "megabytes": 0.0, "decibels": 0.0}, [], {}
        inputs = state.inputs()
        for field, name in (("sh_rest", "what is left over"), ("indirect_rest", "inter-reflection")):
            if field not in state.learned:
                continue
            whole = state.learned[field].shape[1]
            count, loss, shorter, last = whole, 0.0, inputs, 0
            for degree in reversed(range(math.isqrt(whole + 1) - 1)):
                fewer = _shortened(inputs, field, (degree + 1) ** 2 - 1)
                worse = probe.psnr_loss(state, lambda _, fewer=fewer: fewer, inputs)
                if worse.whole > self.threshold or worse.part > VISIBLE:
                    break
                count, loss, shorter, last = (degree + 1) ** 2 - 1, worse.whole, fewer, degree
            if count == whole:
                continue
            inputs, counts[field] = shorter, count
            figures["seconds"] += probe.seconds_saved(state, lambda i, f=field, c=count: _shortened(i, f, c))
            numbers = state.learned.count * 3 * (whole - count)
            figures["megabytes"] += numbers * NUMBER / MEGA
            figures["decibels"] += loss
            why.append(f"of {name} degree {last} is the last that is worth {self.threshold} dB")

        def shorten() -> None:
            for field, count in counts.items():
                state.learned.columns(field, count)

        why = "; ".join(why) or "the last degree is worth more"
        return Decision(not counts, why, {"threshold": self.threshold, **figures}, once=shorten)


def _shortened(inputs: RenderInputs, field: str, count: int) -> RenderInputs:
    """Copy `inputs`, keeping only the first `count` harmonic coefficients of one field of the surfels."""
    values = {field: getattr(inputs.surfels, field)[:, :count]}
    return inputs._replace(surfels=inputs.surfels._replace(**values))
