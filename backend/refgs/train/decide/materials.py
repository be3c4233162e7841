"""Decide whether a scene needs specular shading, and whether splats.ply needs columns for metallic and roughness."""

import torch
from torch import Tensor

from refgs.formats.needs import Found
from refgs.model.surfels import Surfels
from refgs.render.sums import blended_shares
from refgs.train import probe
from refgs.train.decide.need import ASKED, MEGA, Decision, Given, Moment, Need, megabytes
from refgs.train.material import metals
from refgs.train.material.changes import change_seen
from refgs.train.material.observe import observe_changes
from refgs.train.start import start_appearance
from refgs.train.state import RenderInputs, State, why_not_traced

# Change of encoded colour with the view, of 1; matte clay has 0.037, an embossed gold cape in flat light 0.056, a mirror 0.2.
SHINES = 0.042
SMALL_PART = 1.0  # dB over a small part (`probe.PART`); matte clay has -1.2, a clay pig with a chrome bell 1.7
RARE = 1e-3  # part of the pictures, at either end of the values, that is ignored in the search for a common value
INDIRECT = "indirect_dc", "indirect_rest", "received"


class Specular(Need):
    """Decide whether the scene needs specular shading, with metallic, roughness and inter-reflection."""

    name, what, shown = "specular", "specular shading", True
    threshold = 0.3  # dB
    reason = (
        "at a twentieth of a training matte clay has none; a polished plate has 0.8 dB, glossy paint 2.6, a mirror 5.6"
    )
    moments = ("start", "specular")

    def due(self, state: State, moment: Moment) -> bool:
        mirrors = state.settings.render.reflection == "microfacet"
        return mirrors and (moment == "specular" or self.asked(state) == "off")

    def measure(self, state: State, given: Given) -> Decision:
        if self.asked(state) == "off":
            return Decision(False, ASKED)
        explained = probe.specular_explains(state)
        why = f"what is mirrored explains {explained.whole:.2f} dB of the photos beyond one colour a surfel"
        if explained.whole >= self.threshold:
            return Decision(True, why, statistic=explained.whole)
        # A chrome bell on a clay pig needs this: clay is most of the object, and hides the bell in the mean.
        why += f", {explained.part:.2f} where it shows most"
        if explained.part >= SMALL_PART:
            return Decision(True, why, statistic=explained.part, threshold=SMALL_PART)
        # Normals are still wrong, and an embossed metal has no sharp reflections. So specular shading explains nothing, though the metal
        # shines.
        change = change_seen(observe_changes(state), state.wanted())
        why += f"; colours change with the view by {change:.3f} of 1"
        if change >= SHINES:
            return Decision(True, why, statistic=change, threshold=SHINES)
        saved = probe.seconds_saved(state, probe.without_specular)
        size = megabytes(state, ("metallic", "roughness", *INDIRECT))
        figures = {"seconds": saved, "megabytes": size, "decibels": explained.whole}
        return Decision(False, why, figures, explained.whole)

    def apply(self, state: State, found: Found) -> None:
        state.change("render.reflection", "none", "needs", found.why)
        state.occluder = state.told_light = None
        state.learned.drop("metallic", "roughness", "held", "told", "shown_color", "roughest", *INDIRECT)

    def undo(self, state: State, why: str) -> None:
        state.change("render.reflection", state.effective.asked.render.reflection, "needs", why)
        _learn_again(state, ["metallic", "roughness", *(() if why_not_traced(state) else INDIRECT)])
        state.part(metals.Metals).start(state)

    def look_again(self, state: State) -> Decision | None:
        """Look at a matte scene once more, halfway through the training: by then the surfels lie on the surface.

        If colours change with the view after all, returns the decision to bring specular shading back. Otherwise returns None.
        """
        if state.needed(self.name) or (found := state.needs[self.name]).statistic is None or found.again is not None:
            return None
        change = change_seen(observe_changes(state), state.wanted())
        state.needs[self.name] = found.model_copy(update={"again": change})
        why = f"halfway, colours change with the view by {change:.3f} of 1: it was taken for matte before"
        return Decision(True, why, statistic=change, threshold=SHINES) if change >= SHINES else None


def _learn_again(state: State, names: list[str]) -> None:
    """Begin to learn parameters that were left out, from the values in the settings."""
    start, count = start_appearance(state.effective.asked), state.learned.count
    for name in names:
        row = start[name].to(state.device)
        state.learned.learn(name, row.expand(count, *row.shape[1:]).clone())


class Constants(Need):
    """Decide whether splats.ply needs columns for metallic and roughness, which may be constant."""

    name, what = "constants", "columns for metallic and roughness"
    threshold, reason = 1 / 255, "no 8-bit texture shows a smaller spread"
    moments = ("asset",)

    def measure(self, state: State, given: Given) -> Decision | None:
        if not (common := given.common):
            return None

        def same(inputs: RenderInputs) -> RenderInputs:
            surfels = inputs.surfels
            values = {name: torch.full_like(getattr(surfels, name), value) for name, (value, _) in common.items()}
            return inputs._replace(surfels=surfels._replace(**values))

        why = "; ".join(f"{name} is {value:.3f}, within {spread:.4f}" for name, (value, spread) in common.items())
        figures = {"megabytes": 4 * len(common) * given.kept / MEGA, "decibels": probe.psnr_loss(state, same).whole}
        return Decision(False, why, figures, len(common))

    @torch.no_grad()
    def common(self, state: State, surfels: Surfels, kept: Tensor) -> dict[str, tuple[float, float]]:
        """Find out which of metallic and roughness have about the same value for all surfels that the mask `kept` (N,) selects.

        Returns a dict: the name gives (common value, width of the range of values). If the user's setting is "off", the dict has both
        names, however wide the ranges are. If the setting is "on", the dict is empty.
        """
        if self.asked(state) == "on" or not state.method.lit:
            return {}
        cameras = [state.photo(view).camera for view in probe.spread_views(state)]
        weight = blended_shares(surfels, cameras, state.near).sum(dim=0) * kept
        found = {}
        for name in ("metallic", "roughness"):
            values = getattr(surfels, name)
            low, middle, high = (probe.quantile(values, weight, part) for part in (RARE, 0.5, 1 - RARE))
            if self.asked(state) == "off" or high - low <= self.threshold:
                found[name] = middle, high - low
        return found
