"""Measure the errors of rendered pictures and of recovered lights.

Pictures are float arrays (height, width, 3). "Encoded" means sRGB values in 0..1, "linear" means radiance. The error of several views is
the mean of their errors.
"""

import importlib
import importlib.util
import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import cast

import cv2
import flip_evaluator
import numpy as np
import torch
from scipy.ndimage import maximum_filter, maximum_filter1d, median_filter
from scipy.optimize import linear_sum_assignment
from skimage.metrics import structural_similarity

from refgs.color import srgb_decode
from refgs.compare.pictures import over_white
from refgs.formats.panorama import directions
from refgs.render.rendering import SOLID

SPECK = 0.1  # encoded difference from the pixels around it, from which on a pixel stands out
LIGHT_BLUR = 3.0  # degrees, standard deviation
LIGHTS_APART = 15.0  # degrees
MOST_LIGHTS = 5
LOST_LIGHT = 30.0  # degrees; the error of a light that is not found
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec.709


def decibels(square: float) -> float:
    """Convert a mean squared error, `square`, to a peak signal-to-noise ratio (PSNR) in dB. The peak is 1.

    The result is at most 100. Without this limit, one error of 0 would make a mean over views infinite.
    """
    return -10 * math.log10(max(square, 1e-10))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Compute the PSNR in dB of a picture and its reference, both sRGB-encoded."""
    return decibels(float(((np.asarray(image, np.float64) - reference) ** 2).mean()))


def fitted_exposure(radiance: np.ndarray, alpha: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Compute a photo's exposure (3,): the factors that bring linear `radiance` (h, w, 3) closest to the sRGB-encoded `photo`.

    The factor of each channel is fitted by least squares in linear colours. Pixels are used if `alpha` (h, w) is above 0.5 and the photo is
    not clipped there. If a channel's radiance is 0 in all used pixels, its factor is 1.
    """
    seen = (alpha > 0.5) & (photo.max(axis=-1) < 0.98)
    rendered, taken = radiance[seen].astype(np.float64), srgb_decode(photo[seen].astype(np.float64))
    square, product = (rendered * rendered).sum(axis=0), (rendered * taken).sum(axis=0)
    return np.where(square > 0, product / np.where(square > 0, square, 1), 1)


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Compute SSIM (Wang et al. 2004, σ 1.5 pixels) of two sRGB-encoded pictures."""
    mean = structural_similarity(
        np.asarray(image, np.float64),
        np.asarray(reference, np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    return float(cast(np.float64, mean))


def flip(image: np.ndarray, reference: np.ndarray) -> float:
    """Compute the mean FLIP error (Andersson et al. 2020) between two sRGB-encoded pictures: 0 if they are equal, 1 at most.

    The viewing distance is the authors' default: one degree of the field of view spans 67 pixels.
    """
    true, shown = (np.ascontiguousarray(x, np.float32) for x in (reference, image))
    error, *_ = flip_evaluator.evaluate(true, shown, "LDR", applyMagma=False, computeMeanError=False)
    return float(error.mean(dtype=np.float64))


def specks(image: np.ndarray, reference: np.ndarray) -> float:
    """Count wrong single pixels of an sRGB-encoded picture, in thousandths of all pixels.

    A speck is a pixel that differs by more than SPECK from the median of the 5×5 pixels about it, in any channel. It is not counted if the
    reference has a speck at the same pixel or at one of its 8 neighbours, as on thin lines and small highlights.
    """
    stands_out = [(np.abs(x - median_filter(x, (5, 5, 1))) > SPECK).any(axis=-1) for x in (image, reference)]
    return 1e3 * float((stands_out[0] & np.logical_not(maximum_filter(stands_out[1], 3))).mean())


def lpips_missing() -> str | None:
    """Name in one line the package or file that LPIPS lacks, or return None."""
    missing = [name for name in ("lpips", "torchvision") if importlib.util.find_spec(name) is None]
    if missing:
        return f"the package {missing[0]} is not installed"
    weights = Path(torch.hub.get_dir(), "checkpoints", "vgg16-397923af.pth")
    return None if weights.is_file() else f"torchvision's weights of VGG-16 are not there: {weights}"


@lru_cache(maxsize=1)
def _lpips_network():
    lpips = importlib.import_module("lpips")  # no dependency of ours
    return lpips.LPIPS(net="vgg", verbose=False).eval()


def lpips(image: np.ndarray, reference: np.ndarray) -> float:
    """Compute the LPIPS error (Zhang et al. 2018), with VGG-16, of two sRGB-encoded pictures."""
    pair = (torch.from_numpy(np.asarray(x, np.float32)).permute(2, 0, 1)[None] for x in (image, reference))
    with torch.no_grad():
        return float(_lpips_network()(*pair, normalize=True))


def normal_mae_degrees(
    normals: np.ndarray, reference: np.ndarray, alpha: np.ndarray, reference_alpha: np.ndarray
) -> float:
    """Compute the mean angle in degrees between rendered and true normals (h, w, 3), over the pixels of the object.

    A pixel belongs to the object if `reference_alpha` is at least 0.5. All these pixels have the same weight. Normals are normalised first.
    The error is 90° where the rendering is almost empty (`alpha` below 0.1) or its normal has length 0. So a rendering cannot lower its
    error by leaving out a part of the object.
    """
    seen = reference_alpha >= SOLID
    a, b = normals[seen].astype(np.float64), reference[seen].astype(np.float64)
    length = np.linalg.norm(a, axis=-1)
    missing = (length < 1e-6) | (alpha[seen] < 0.1) | ~np.isfinite(length)
    cosine = (a * b).sum(-1) / np.where(missing, 1, length) / np.linalg.norm(b, axis=-1)
    return float(np.degrees(np.where(missing, np.pi / 2, np.arccos(np.clip(cosine, -1, 1)))).mean())


def normal_ssim(normals: np.ndarray, reference: np.ndarray, alpha: np.ndarray, reference_alpha: np.ndarray) -> float:
    """Compute the structural similarity (SSIM) of two pictures of unit normals (h, w, 3), over all pixels.

    Normals n are turned into colours (n + 1)/2. Each picture is then composited over white, with its own alpha.
    """

    def encoded(n: np.ndarray, alpha: np.ndarray) -> np.ndarray:
        return np.nan_to_num((n * 0.5 + 0.5) * alpha[..., None]) + 1 - alpha[..., None]

    return ssim(encoded(normals, alpha), encoded(reference, reference_alpha))


def channel_products(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Compute three means for each colour channel over the pixels in `mask` (h, w). `aligned_psnr` needs them from every view.

    They are the means of image², image · reference and reference². Returns (3, channels), one row for each mean.
    """
    a, b = image[mask].astype(np.float64), reference[mask].astype(np.float64)
    return np.stack([(a * a).mean(0), (a * b).mean(0), (b * b).mean(0)])


def aligned_psnr(views: list[np.ndarray]) -> dict[str, float | list[float]]:
    """Compute the PSNR in dB of linear base colours, as they are and after a correction of their tint. Both are means over the views.

    `views` has the result of `channel_products` for each view. Returns a dictionary:

    - psnr_raw: the PSNR of the base colours as they are
    - scale: the correction, one least-squares factor a channel, the same for all views
    - psnr_aligned: the PSNR after each channel is multiplied by its factor

    The correction is made because photos do not show whether the light is tinted or the base colours are.
    """
    aa, ab, bb = np.moveaxis(np.array(views), 1, 0)
    power = aa.sum(0)
    scale = np.where(power > 0, ab.sum(0) / np.where(power > 0, power, 1), 1)

    def mean(scale: np.ndarray) -> float:
        return float(np.mean([decibels(e) for e in (scale * scale * aa - 2 * scale * ab + bb).mean(-1)]))

    return {"psnr_raw": mean(np.ones(3)), "psnr_aligned": mean(scale), "scale": scale.tolist()}


def relit(
    pairs: Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]],
    measures: tuple[Callable[[np.ndarray, np.ndarray], float], ...] = (psnr, flip),
) -> dict[str, float]:
    """Measure the errors of an object's renderings under another light, as means over the views.

    Each call of `pairs()` yields the rendered and the true picture of every view, in premultiplied linear RGBA. Both are composited over
    white and then compared by each function in `measures`. Returns a dictionary with two entries for each function, and one factor:

    - NAME_raw, such as psnr_raw: the result for the renderings as they are
    - NAME_aligned, such as psnr_aligned: the result after the renderings' radiance is multiplied by `scale`
    - scale: a least-squares factor, the same for all views and functions

    The factor is needed because photos do not show how bright the base colours are: darker ones under a brighter light look the same. The
    fit of the factor leaves out pixels that are 1 or brighter in either picture, such as a sun in a mirror. A few of them would dominate
    the fit.
    """
    product = power = 0.0
    for image, reference in pairs():
        a, b = (np.asarray(x[..., :3], np.float64) for x in (image, reference))
        fit = (a.max(-1) < 1) & (b.max(-1) < 1)
        product, power = product + (a[fit] * b[fit]).sum(), power + (a[fit] ** 2).sum()
    scale = float(product / power) if power > 0 else 1.0
    rows = []
    for image, reference in pairs():
        truth = over_white(reference)
        rows.append([measure(over_white(image, s), truth) for measure in measures for s in (1.0, scale)])
    names = [f"{measure.__name__}_{how}" for measure in measures for how in ("raw", "aligned")]
    return dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True)) | {"scale": scale}


def resized(panorama: np.ndarray, height: int) -> np.ndarray:
    """Reduce an equirectangular panorama to `height` rows and twice as many columns. Pixels are averaged."""
    return cv2.resize(panorama.astype(np.float32), (2 * height, height), interpolation=cv2.INTER_AREA)


def _elevations(height: int) -> np.ndarray:
    return np.pi * (0.5 - (np.arange(height) + 0.5) / height)


def environment_log_rmse(environment: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Compute the RMS error of a recovered panorama's log radiance, after a correction of its brightness.

    The correction is one factor on the recovered panorama, `environment`. It is chosen such that the mean difference of the logarithms is
    zero. Returns the error and the factor.

    Both panoramas are equirectangular (h, w, 3) and linear. The larger one is averaged down to the size of the smaller one. Pixels are
    weighted by solid angle. The logarithm is natural: an error of 0.1 is about 10 %. Before the logarithm, a thousandth of a panorama's
    mean radiance is added to its pixels. So differences between almost black pixels hardly count.
    """
    a, b = (resized(x, min(len(environment), len(reference))) for x in (environment, reference))
    weight = np.cos(_elevations(len(a)))
    weight = np.broadcast_to(weight[:, None, None], a.shape) / (weight.sum() * a.shape[1] * 3)
    difference = np.log(b + 1e-3 * (b * weight).sum()) - np.log(a + 1e-3 * (a * weight).sum())
    mean = (difference * weight).sum()
    return float(np.sqrt(((difference - mean) ** 2 * weight).sum())), float(np.exp(mean))


def _blur(values: np.ndarray, degrees: float) -> np.ndarray:
    """Blur a panorama (h, 2h) by a Gaussian on the sphere with σ of `degrees`."""
    # A pixel at the angle a has the weight exp((cos a − 1) / σ²).
    elevation, turn = _elevations(len(values)), 2 * np.pi / values.shape[1] * np.arange(values.shape[1])
    up, out = np.sin(elevation), np.cos(elevation)
    cosine = up[:, None, None] * up[:, None] + out[:, None, None] * out[:, None] * np.cos(turn)
    kernel = np.fft.rfft(np.exp((cosine - 1) / np.radians(degrees) ** 2))  # of each pair of rows, along the columns

    def convolve(rows: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.einsum("rsk,sk->rk", kernel, np.fft.rfft(rows * out[:, None])), rows.shape[1])

    return convolve(values) / convolve(np.ones_like(values))


def find_lights(panorama: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the light sources in a panorama. Returns unit directions (K, 3) and luminances (K,), the brightest first.

    The luminance is blurred by LIGHT_BLUR degrees and divided by its mean over the sphere. A light source is a peak above the mean. A peak
    is ignored if a brighter one lies within LIGHTS_APART degrees.
    """
    luminance = panorama.astype(np.float64) @ _LUMINANCE
    area = np.broadcast_to(np.cos(_elevations(len(luminance)))[:, None], luminance.shape)
    luminance = luminance / max((luminance * area).sum() / area.sum(), 1e-30)
    blurred = _blur(luminance, LIGHT_BLUR)
    rays = directions(*luminance.shape).astype(np.float64)
    around = maximum_filter1d(maximum_filter1d(blurred, 3, axis=0, mode="nearest"), 3, axis=1, mode="wrap")
    peaks = (blurred >= around) & (blurred > 1.01)
    found: list[np.ndarray] = []
    values = []
    for place in sorted(zip(*np.nonzero(peaks), strict=True), key=lambda place: -blurred[place]):
        if all(rays[place] @ other < np.cos(np.radians(LIGHTS_APART)) for other in found):
            found.append(rays[place])
            values.append(blurred[place])
    for i in range(len(found)):  # refine beyond pixels: mean shift converges to the blurred peak
        for _ in range(30):
            weight = np.exp((rays @ found[i] - 1) / np.radians(LIGHT_BLUR) ** 2)
            centre = np.einsum("hw,hwa->a", weight * luminance * area, rays)
            found[i] = centre / np.linalg.norm(centre)
    return np.array(found).reshape(-1, 3), np.array(values)


def lights_error(environment: np.ndarray, reference: np.ndarray) -> tuple[float, int] | None:
    """Measure the mean angle in degrees between the brightest lights of the true panorama (`reference`) and the recovered lights.

    Returns the mean angle and the number of true lights; None if there is no bright light.

    - Lights are found by `find_lights` in both panoramas, reduced to at most 128 rows.
    - A true light is used if it has at least twice the panorama's mean brightness, and at least a quarter of the brightest light's. If
      there are more than MOST_LIGHTS, only the brightest MOST_LIGHTS are used.
    - If N true lights are used, the 2N brightest recovered lights are used.
    - True and recovered lights are matched one to one, such that the sum of the angles is as small as possible.
    - A true light without a match within LOST_LIGHT degrees has the error LOST_LIGHT.
    - The mean is weighted by the true lights' brightness. It does not depend on the overall brightness of a panorama.
    """
    recovered, truth = (resized(x, min(128, len(environment), len(reference))) for x in (environment, reference))
    lights, bright = find_lights(truth)
    count = int(((bright >= 2) & (bright >= 0.25 * bright.max(initial=0))).sum())
    lights, bright = lights[: min(count, MOST_LIGHTS)], bright[: min(count, MOST_LIGHTS)]
    if not len(lights):
        return None
    others = find_lights(recovered)[0][: 2 * len(lights)]
    angle = np.full((len(lights), len(others) + len(lights)), LOST_LIGHT)
    # The cosine alone does not resolve small angles: use the sine too.
    sine = np.linalg.norm(np.cross(lights[:, None], others[None]), axis=-1)
    angle[:, : len(others)] = np.degrees(np.arctan2(sine, lights @ others.T)).clip(max=LOST_LIGHT)
    match = angle[linear_sum_assignment(angle)]
    return float(match @ bright / bright.sum()), len(lights)
