"""Train on reduced photos first. An iteration's time grows with the number of pixels, and early iterations need no fine details.

Small objects are trained on full photos from the start: if the object spans only 64 pixels, half-size photos cost 0.3 dB of PSNR.
"""

from collections.abc import Mapping
from typing import Any

from refgs.camera import Camera
from refgs.capture import LoadedView, reduced_views
from refgs.run_folder import PHOTOS
from refgs.train.part import Part
from refgs.train.photo import MARGIN, Crop, Photo, crop_of
from refgs.train.plan import FULL, Stage, by_pixels, iterations_time
from refgs.train.state import State
from refgs.train.timeline import PHOTO_STAGES, POSES_KNOWN, Step, stage_at

LEAST_SPAN = 200  # pixels that the object must span in reduced photos


class Coarse(Part):
    """Remember the training's stages, and the reduced photos of the present stage. Each stage has its own size of photos.

    `photos` are the training photos with both sides divided by `factor`. `crops` are the parts of them to train on, or None to train on all
    of them. If `factor` is 1, `photos` is empty and `crops` is None, because `State.photos` are used.
    """

    name, saved = "coarse", ("factor",)

    def __init__(self) -> None:
        self.stages: tuple[Stage, ...] = FULL
        self.factor = 1
        self.photos: list[Photo] = []
        self.crops: list[Crop] | None = None

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        set_factor(state, facts["factor"])


def stages(pixels: float, detail: float = 1.0) -> tuple[Stage, ...]:
    """Plan the stages for an object that spans `pixels` in the full photos. With less `detail`, 0..1, smaller objects have them, too."""
    least, area = detail * LEAST_SPAN, pixels**2
    reduced = ((until, factor) for until, factor in PHOTO_STAGES if pixels / factor >= least)
    return *(Stage(until, factor, by_pixels(area, factor**-2)) for until, factor in reduced), *FULL


def begin(state: State, pixels: float, refined: bool) -> None:
    """Choose the stages for an object that spans `pixels` in the full photos, and start with the first one.

    `refined` tells whether poses are refined. If so, stages of reduced photos that last beyond the progress POSES_KNOWN are left out.
    """
    if state.settings.image.coarse == "off":
        return
    found = stages(pixels, state.plan.detail)
    if refined:
        found = *(stage for stage in found if stage.until <= POSES_KNOWN), *FULL
    state.part(Coarse).stages = found
    if len(found) > 1:
        factor = found[0].factor
        what = f"photos are reduced by a factor of {factor} at first: the object spans {pixels:.0f} pixels"
        state.report("stage", {"what": what, "detail": True})
        set_factor(state, factor)


def refine(state: State, step: Step) -> None:
    """Switch to larger photos when the training's progress reaches the next stage."""
    coarse = state.part(Coarse)
    factor = stage_at(step.progress, coarse.stages).factor
    if factor < coarse.factor:
        set_factor(state, factor)
        size = "in full size" if factor == 1 else f"reduced by a factor of {factor}"
        state.report("stage", {"what": f"photos are {size} from now on", "detail": True})


def set_factor(state: State, factor: int) -> None:
    """Reduce the training photos by a factor, 1 for full photos."""
    coarse = state.part(Coarse)
    if factor == coarse.factor:
        return
    coarse.photos, coarse.crops, coarse.factor = [], None, factor  # drop the old photos first, to free their memory
    if factor > 1:
        with state.clock.part("reading"):
            views: list[LoadedView] = reduced_views(state.views, factor, state.folder / PHOTOS)
            coarse.photos = [Photo.of(view, state.device) for view in views]
            coarse.crops = None if state.crops is None else [crop_of(view, MARGIN) for view in views]


def photo(state: State, view: int, whole: bool) -> Photo:
    """Return a view's photo in the present stage's size, cropped unless `whole` is true."""
    coarse = state.part(Coarse)
    if coarse.factor == 1:
        return state.photo(view, whole)
    return coarse.photos[view] if whole or coarse.crops is None else coarse.photos[view].part(*coarse.crops[view])


def move_camera(state: State, view: int, camera: Camera) -> None:
    """Update the camera of a view's reduced photo from `camera`, that of the full photo."""
    coarse = state.part(Coarse)
    if coarse.factor > 1:
        small = coarse.photos[view]
        coarse.photos[view] = small._replace(camera=camera.resized(small.camera.width, small.camera.height))


def cost(state: State, first: int, last: int) -> float:
    """Estimate the time of iterations `first` to `last`, in iterations on full photos."""
    stages = state.part(Coarse).stages
    begun, ended = (iterations_time(1.0, k / state.total, stages) for k in (first, last))
    return state.total * (ended - begun)
