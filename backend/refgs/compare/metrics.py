"""Measure the errors of pictures and lights.

Pictures are (height, width, 3) float arrays; "encoded" means sRGB in 0..1, "linear" means radiance. Errors of several views are averaged
over the views.
"""

import importlib.util
import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path

import cv2
import flip_evaluator
import numpy as np
import torch
from scipy.ndimage import maximum_filter
from scipy.optimize import linear_sum_assignment
from skimage.metrics import structural_similarity

from refgs.color import srgb_decode
from refgs.compare.pictures import over_white
from refgs.formats.panorama import directions

COVERED = 0.5  # alpha from which on a pixel belongs to the object

LIGHT_BLUR = 3.0  # degrees, standard deviation
LIGHTS_APART = 15.0  # degrees
MOST_LIGHTS = 5
LOST_LIGHT = 30.0  # degrees; the error of a light that is not found
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec.709


def decibels(square: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error, for a peak of 1. At most 100, so that means stay finite."""
    return -10 * math.log10(max(square, 1e-10))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of encoded pictures."""
    return decibels(float(((np.asarray(image, np.float64) - reference) ** 2).mean()))


def fitted_exposure(radiance: np.ndarray, alpha: np.ndarray, photo: np.ndarray) -> float:
    """Fit the factor by which linear radiance (h, w, 3) matches an encoded photo, by least squares.

    Only pixels count that are opaque by alpha (h, w) and not clipped in the photo. Returns 1 if there are none.
    """
    seen = (alpha > 0.5) & (photo.max(axis=-1) < 0.98)
    rendered, taken = radiance[seen].astype(np.float64), srgb_decode(photo[seen].astype(np.float64))
    square = (rendered * rendered).sum()
    return float((rendered * taken).sum() / square) if square > 0 else 1.0


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Structural similarity of encoded pictures, with the Gaussian window of Wang et al. 2004, σ 1.5."""
    return float(
        structural_similarity(
            np.asarray(image, np.float64),
            np.asarray(reference, np.float64),
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1.0,
            channel_axis=-1,
        )
    )


def flip(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean FLIP (Andersson et al. 2020) of encoded pictures, 0 (equal) to 1, at the authors' 67 pixels a degree."""
    pair = (np.ascontiguousarray(x, np.float32) for x in (reference, image))
    error, *_ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False)
    return float(error.mean(dtype=np.float64))


def lpips_missing() -> str | None:
    """Say why LPIPS cannot be measured here; None if it can. The network's weights are never downloaded."""
    missing = [name for name in ("lpips", "torchvision") if importlib.util.find_spec(name) is None]
    if missing:
        return f"the package {missing[0]} is not installed"
    weights = Path(torch.hub.get_dir(), "checkpoints", "vgg16-397923af.pth")
    return None if weights.is_file() else f"torchvision's weights of VGG-16 are not there: {weights}"


@lru_cache(maxsize=1)
def _lpips_network():
    import lpips

    return lpips.LPIPS(net="vgg", verbose=False).eval()


def lpips(image: np.ndarray, reference: np.ndarray) -> float:
    """LPIPS (Zhang et al. 2018) of encoded pictures with VGG-16 and its linear layers, version 0.1."""
    pair = (torch.from_numpy(np.asarray(x, np.float32)).permute(2, 0, 1)[None] for x in (image, reference))
    with torch.no_grad():
        return float(_lpips_network()(*pair, normalize=True))


def normal_mae_degrees(
    normals: np.ndarray, reference: np.ndarray, alpha: np.ndarray, reference_alpha: np.ndarray
) -> float:
    """Mean angle in degrees between normals (h, w, 3), over the pixels that the object covers at least by half.

    Each pixel counts the same, and both normals are normalised first. Where the rendering is almost empty (alpha below 0.1) or its normal
    has no length, the error is 90°, so that leaving a part out does not pay.
    """
    seen = reference_alpha >= COVERED
    a, b = normals[seen].astype(np.float64), reference[seen].astype(np.float64)
    length = np.linalg.norm(a, axis=-1)
    missing = (length < 1e-6) | (alpha[seen] < 0.1) | ~np.isfinite(length)
    cosine = (a * b).sum(-1) / np.where(missing, 1, length) / np.linalg.norm(b, axis=-1)
    return float(np.degrees(np.where(missing, np.pi / 2, np.arccos(np.clip(cosine, -1, 1)))).mean())


def normal_ssim(normals: np.ndarray, reference: np.ndarray, alpha: np.ndarray, reference_alpha: np.ndarray) -> float:
    """Structural similarity of unit normals, encoded as (n + 1)/2, each over white by its own alpha. All pixels count."""

    def encoded(n: np.ndarray, alpha: np.ndarray) -> np.ndarray:
        return np.nan_to_num((n * 0.5 + 0.5) * alpha[..., None]) + 1 - alpha[..., None]

    return ssim(encoded(normals, alpha), encoded(reference, reference_alpha))


def channel_products(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Means over a mask (h, w) of image², image · reference and reference² (rows), for each channel (columns): input of `aligned_psnr`."""
    a, b = image[mask].astype(np.float64), reference[mask].astype(np.float64)
    return np.stack([(a * a).mean(0), (a * b).mean(0), (b * b).mean(0)])


def aligned_psnr(views: list[np.ndarray]) -> dict[str, float | list[float]]:
    """Compute the PSNR of linear base colours, averaged over views. `views` are the results of `channel_products`.

    Returns psnr_raw, psnr_aligned and scale. Photos cannot tell a tinted light from tinted base colours, so psnr_aligned is measured after
    each channel is multiplied by its least-squares `scale`, the same for all views.
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
    """Measure pictures under another light, over white, by each of `measures`. Returns scale, and psnr_raw, psnr_aligned and so on.

    Each call of `pairs()` yields every view's picture and truth, premultiplied linear RGBA. Photos do not tell the overall brightness of
    the base colours, so "aligned" errors are measured after radiance is multiplied by the least-squares `scale`, the same for all views.
    Pixels of 1 or brighter in either picture, such as a sun in a mirror, are left out of the fit: a few of them would dominate it.
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
    """Reduce a panorama to `height` rows, by averaging."""
    return cv2.resize(panorama.astype(np.float32), (2 * height, height), interpolation=cv2.INTER_AREA)


def _elevations(height: int) -> np.ndarray:
    return np.pi * (0.5 - (np.arange(height) + 0.5) / height)


def environment_log_rmse(environment: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """RMS error of a recovered panorama's log radiance, after it is multiplied by the best scale. Returns the error and the scale.

    Both are equirectangular (h, w, 3) and linear; the larger is averaged down to the smaller. Pixels are weighted by solid angle. The scale
    makes the mean difference zero. The logarithm is natural: 0.1 is about 10 %. A thousandth of the mean radiance is added to both, since
    darker light cannot be seen.
    """
    a, b = (resized(x, min(len(environment), len(reference))) for x in (environment, reference))
    weight = np.cos(_elevations(len(a)))
    weight = np.broadcast_to(weight[:, None, None], a.shape) / (weight.sum() * a.shape[1] * 3)
    difference = np.log(b + 1e-3 * (b * weight).sum()) - np.log(a + 1e-3 * (a * weight).sum())
    mean = (difference * weight).sum()
    return float(np.sqrt(((difference - mean) ** 2 * weight).sum())), float(np.exp(mean))


def _blur(values: np.ndarray, degrees: float) -> np.ndarray:
    """Blur a panorama (h, 2h) on the sphere, with weights exp((cos angle − 1) / σ²), the sphere's Gaussian."""
    elevation, turn = _elevations(len(values)), 2 * np.pi / values.shape[1] * np.arange(values.shape[1])
    up, out = np.sin(elevation), np.cos(elevation)
    cosine = up[:, None, None] * up[:, None] + out[:, None, None] * out[:, None] * np.cos(turn)
    kernel = np.fft.rfft(np.exp((cosine - 1) / np.radians(degrees) ** 2))  # of each pair of rows, along the columns

    def convolve(rows: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.einsum("rsk,sk->rk", kernel, np.fft.rfft(rows * out[:, None])), rows.shape[1])

    return convolve(values) / convolve(np.ones_like(values))


def find_lights(panorama: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find a panorama's lights: unit directions (K, 3) and luminance (K,) relative to the mean, the brightest first.

    A light is a peak of the luminance blurred by LIGHT_BLUR that is brighter than the mean over the sphere and has no brighter peak within
    LIGHTS_APART.
    """
    luminance = panorama.astype(np.float64) @ _LUMINANCE
    area = np.broadcast_to(np.cos(_elevations(len(luminance)))[:, None], luminance.shape)
    luminance = luminance / max((luminance * area).sum() / area.sum(), 1e-30)
    blurred = _blur(luminance, LIGHT_BLUR)
    rays = directions(*luminance.shape).astype(np.float64)
    peaks = (blurred >= maximum_filter(blurred, size=3, mode=("nearest", "wrap"))) & (blurred > 1.01)
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
    """Measure the mean angular error of the brightest lights in degrees. Returns it and the number of lights; None if there are none.

    True lights are found by `find_lights` in at most 128 rows. Lights below twice the mean brightness, or below a quarter of the brightest
    light, are left out. At most MOST_LIGHTS count, the brightest. They are matched one to one with lights of the recovered panorama, so
    that the sum of angles is least. The recovered panorama offers twice as many lights, its brightest. A true light without a match within
    LOST_LIGHT counts as LOST_LIGHT. The mean is weighted by the true brightness. A scale of the radiance has no effect.
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
