"""Train on reduced photos first: an iteration takes about as long as it has pixels, and the first ones need no fine ones.

Small objects are trained on full photos from the start: of an object of 64 pixels, half the size loses 0.3 dB.
"""

from refgs.capture import LoadedView, reduced_views
from refgs.run_folder import PHOTOS
from refgs.train.learn import poses
from refgs.train.photo import MARGIN, Photo, bounds
from refgs.train.plan import FULL, Stage
from refgs.train.state import Reduced, State

STAGES = (0.35, 4), (0.7, 2)  # part of the training until which photos are reduced, and by what factor
LEAST = 200  # pixels of the object in reduced photos


def stages(pixels: float) -> tuple[Stage, ...]:
    """Plan the stages of a training of an object that spans so many `pixels` in the full photos."""
    return *(Stage(*stage) for stage in STAGES if pixels / stage[1] >= LEAST), *FULL


def begin(state: State, pixels: float) -> None:
    """Choose the stages of a training of an object that spans so many `pixels` in the full photos, and start with the first one."""
    if state.settings.image.coarse == "off":
        return
    found = stages(pixels)
    if state.poses is not None:  # that they are refined takes full photos
        found = *(stage for stage in found if stage.until <= poses.KNOWN), *FULL
    state.stages = found
    if len(found) > 1:
        factor = found[0].factor
        what = f"photos are reduced by a factor of {factor} at first: the object spans {pixels:.0f} pixels"
        state.report("stage", {"what": what})
        set_factor(state, factor)


def refine_due(state: State, progress: float) -> None:
    """Take larger photos once their stage has come. They are never reduced again, even if the training gets longer."""
    if state.reduced is not None:
        factor = next(stage.factor for stage in state.stages if progress < stage.until or stage.until == 1)
        if factor < state.reduced.factor:
            set_factor(state, factor)
            size = "in full size" if factor == 1 else f"reduced by a factor of {factor}"
            state.report("stage", {"what": f"photos are {size} from now on"})


def set_factor(state: State, factor: int) -> None:
    """Train on photos reduced by a factor, 1 for full photos."""
    if factor == (1 if state.reduced is None else state.reduced.factor):
        return
    state.reduced = None  # first, for its memory
    if factor > 1:
        with state.clock.part("reading"):
            views = reduced_views(state.views, factor, state.folder / PHOTOS)
            state.reduced = Reduced(factor, *_photos(state, views))


def _photos(state: State, views: list[LoadedView]) -> tuple[list[Photo], list[tuple[slice, slice]] | None]:
    photos = [Photo.of(view, state.device) for view in views]
    return photos, None if state.crops is None else [bounds(view.alpha, MARGIN) for view in views]
