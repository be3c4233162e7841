"""Train on unusual photos. Compare the PSNR on held-out views with that of a training on the usual photos."""

import functools
from collections.abc import Callable

import numpy as np

from benchmarks.stability.cases import Case, Outcome
from benchmarks.stability.training import TOTAL, Course, ball, changed, train, usual
from refgs.errors import InputError
from refgs.model.surfels import activate

ONE = ["surfels.start=1", "surfels.budget=1"]
NOISE = 0.7  # dB: another seed changes less than this (docs/stability.md)


def against(course: Course, least: float) -> Outcome:
    """Return the outcome of a finished training that should reach a PSNR of `least` dB on held-out views.

    Its error is the number of dB by which the final PSNR is below `least`. If the final PSNR is not below, the error is 0.
    """
    return Outcome(course.finite, max(0.0, least - course.end))


def elsewhere(scale: float, offset: float) -> Outcome:
    """Train on a scene that is multiplied by `scale` and moved by `offset`. The error is the change of the PSNR in dB.

    Check also that the surfels end up where the scene is.
    """

    def pose(matrix: np.ndarray) -> np.ndarray:
        matrix[:3, 3] = scale * matrix[:3, 3] + offset
        return matrix

    course = train(changed(pose=pose))
    made = course.trainer.state
    surfels = activate(made.learned.constant | made.learned.by_row)
    to_capture = made.capture.to_capture
    place = surfels.positions.detach().numpy().astype(float) @ to_capture[:3, :3].T + to_capture[:3, 3]
    # The 75th percentile, because half of the surfels start inside the object.
    radius = np.percentile(np.linalg.norm((place - offset) / scale, axis=1), 75)
    return Outcome(course.finite and 0.9 < radius < 1.05, abs(course.end - usual().end))


def photographed(
    photo: Callable[[np.ndarray, int], np.ndarray], least: Callable[[], float], total: int = TOTAL
) -> Outcome:
    return against(train(changed(photo=photo), total=total), least())


def of_these(**how) -> Outcome:
    return against(train(ball(**how)), usual().end)


def refused(make: Callable[[], object]) -> Outcome:
    """Call `make`, which trains on a bad capture. Check that it raises InputError with a message of one line."""
    try:
        make()
    except InputError as error:
        return Outcome("\n" not in str(error), 0.0)
    return Outcome(False, 1.0)


def mixed(pixels: np.ndarray, index: int) -> np.ndarray:
    """Resize every third photo to 24×24 pixels, so that the capture has photos of two sizes. `index` is the photo's number."""
    if index % 3 == 0:
        return pixels
    from PIL import Image

    size = (24, 24) if index % 3 == 1 else (32, 32)
    return np.asarray(Image.fromarray(np.rint(pixels * 255).astype(np.uint8)).resize(size)) / 255


def with_color(color) -> Callable[[np.ndarray, int], np.ndarray]:
    return lambda pixels, index: np.dstack([np.broadcast_to(color, pixels[..., :3].shape), pixels[..., 3]])


def noise(pixels: np.ndarray, index: int) -> np.ndarray:
    return np.dstack([np.random.default_rng(index).random(pixels[..., :3].shape), pixels[..., 3]])


def brighter(stops: float) -> Callable[[np.ndarray, int], np.ndarray]:
    return lambda pixels, index: np.dstack([pixels[..., :3] * 2 ** (stops / 2.2), pixels[..., 3]])


def opaque(pixels: np.ndarray, index: int) -> np.ndarray:
    return np.full_like(pixels, 0.5)


def _case(
    name: str, run, guard: str, most: float = NOISE, because: str = "what another seed changes", against="usual scene"
) -> Case:
    return Case(f"photos: {name}", run, against, most, because, guard, "dB")


NORMALISED = "what is far from the origin or of an odd size is learned in the run's frame, radius 1 at the origin"
LEAST = "as a picture without detail"


def _without_detail(name: str, photo, least: float, guard: str, total: int = TOTAL) -> Case:
    """Make a case that trains for `total` iterations on photos without detail. It passes if the held-out PSNR reaches `least` dB."""
    run = functools.partial(photographed, photo, lambda: least, total)
    return _case(name, run, guard, 0.0, LEAST, f"{least:g} dB")


def _refused(name: str, make, guard: str) -> Case:
    return _case(name, functools.partial(refused, make), guard, 0.0, "it is one line or it is not", "an InputError")


CASES = [
    _case(
        "another seed",
        lambda: against(train(ball(), "train.seed=1"), usual().end),
        "none: it is the noise of the others",
    ),
    *(
        _case(f"scene scaled by {scale:g}", functools.partial(elsewhere, scale, 0.0), NORMALISED)
        for scale in (1e-6, 1e-3, 1e3, 1e6)
    ),
    _case("scene moved by 1e5", functools.partial(elsewhere, 1.0, 1e5), NORMALISED),
    *(
        _case(
            f"focal length {focal:g} widths",
            functools.partial(of_these, distance=2.92 * focal),
            "depths in double in camera space",
        )
        for focal in (1e1, 1e2, 1e4)
    ),
    _case(
        "mixed sizes",
        functools.partial(photographed, mixed, lambda: usual().end),
        "each photo has its own camera",
        3.0,
        "fewer pixels",
    ),
    _refused("one view", lambda: train(changed(views=1)), "refused: three at the least"),
    _refused(
        "masks of nothing", lambda: train(changed(photo=lambda pixels, index: 0 * pixels)), "refused: nothing to learn"
    ),
    _case(
        "one surfel",
        lambda: against(train(ball(), *ONE), 8.0),
        "a lone surfel is as large as the scene",
        0.0,
        LEAST,
        "8 dB",
    ),
    _without_detail(
        "total darkness", with_color(0.0), 25.0, "raw light stays above −12, where its slope still counts", total=450
    ),
    _without_detail(
        "over-exposed by 4 stops, clipped", brighter(4), 24.0, "a prediction is clipped only where the photo is"
    ),
    _without_detail("constant, masked", with_color(0.5), 28.0, ""),
    _without_detail("constant, no masks", opaque, 24.0, "white masks are not used, and that is said"),
    _without_detail("noise", noise, 10.0, ""),
    _case(
        "exposures of ±1 stop",
        lambda: of_these(stops=(0.0, 1.0, 0.0, -1.0, 0.0)),
        "each photo's exposure is learned, held near one",
        4.0,
        "exposures are found late in so short a training",
    ),
]
