"""How far a rendering is from the truth.

Pictures are (height, width, 3) float arrays; "encoded" means sRGB, 0..1, as on a screen, "linear" means radiance.
A figure for a set of views is the mean of the figures of the views.
"""

from pathlib import Path

import cv2
import numpy as np
from skimage.metrics import structural_similarity

from refgs.color import srgb_decode, srgb_encode
from refgs.errors import InputError
from refgs.export.environment import read_exr


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB of encoded pictures, the peak being 1; over a (height, width) mask if given.

    Identical pictures give 100 dB, so that means and JSON stay finite.
    """
    error = (np.asarray(image, np.float64) - reference) ** 2
    if mask is not None:
        error = error[mask]
    return float(-10 * np.log10(max(error.mean(), 1e-10)))


def fitted_exposure(radiance: np.ndarray, alpha: np.ndarray, photo: np.ndarray) -> float:
    """What linear radiance (h, w, 3) is to be multiplied by to come nearest, by least squares, to an encoded photo; over the
    pixels that are opaque, alpha (h, w), and not clipped in the photo. 1 where there is nothing to go by."""
    seen = (alpha > 0.5) & (photo.max(axis=-1) < 0.98)
    rendered, taken = radiance[seen].astype(np.float64), srgb_decode(photo[seen].astype(np.float64))
    square = (rendered * rendered).sum()
    return float((rendered * taken).sum() / square) if square > 0 else 1.0


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Structural similarity of encoded pictures with the settings of Wang et al. 2004: a Gaussian window, sigma 1.5."""
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


def normal_mae_degrees(
    normals: np.ndarray, reference: np.ndarray, alpha: np.ndarray, reference_alpha: np.ndarray
) -> float:
    """Mean angle in degrees between normals (h, w, 3), over the pixels that the object covers at least by half.

    Each pixel counts the same and both normals are made unit length first. Where the rendering has next to nothing
    (alpha below 0.1) or a normal of no length, the error is 90°: leaving a part out doesn't pay.
    """
    seen = reference_alpha >= 0.5
    a, b = normals[seen].astype(np.float64), reference[seen].astype(np.float64)
    length = np.linalg.norm(a, axis=-1)
    missing = (length < 1e-6) | (alpha[seen] < 0.1) | ~np.isfinite(length)
    cosine = (a * b).sum(-1) / np.where(missing, 1, length) / np.linalg.norm(b, axis=-1)
    return float(np.degrees(np.where(missing, np.pi / 2, np.arccos(np.clip(cosine, -1, 1)))).mean())


def scale_aligned_psnr(image: np.ndarray, reference: np.ndarray) -> tuple[float, float, float]:
    """PSNR of premultiplied linear RGBA pictures as a screen shows them over white: (raw, aligned, scale).

    Albedo and light share one free scale; `aligned` is after multiplying the picture's radiance by the `scale` that
    fits the reference best in least squares. Pixels in which either is brighter than a screen is (a sun in a mirror) are
    left out of the fit, for a few of them would decide it.
    """
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    a, b = image[..., :3], reference[..., :3]
    fit = (a.max(-1) < 1) & (b.max(-1) < 1)
    power = (a[fit] ** 2).sum()
    scale = float((a[fit] * b[fit]).sum() / power) if power > 0 else 1.0

    def shown(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
        return np.clip(srgb_encode(rgb + 1 - alpha), 0, 1)

    truth = shown(b, reference[..., 3:])
    return psnr(shown(a, image[..., 3:]), truth), psnr(shown(a * scale, image[..., 3:]), truth), scale


def compare_relight(rendered: Path, truth: Path) -> dict[str, float]:
    """A relit preview against ground truth, both EXR files of premultiplied linear RGBA and the same size.

    Returns psnr_raw, psnr_aligned and scale (see `scale_aligned_psnr`). Raises InputError if the files don't fit.
    """
    pictures = []
    for path in (rendered, truth):
        pixels = read_exr(path)
        if pixels.ndim != 3 or pixels.shape[2] != 4:
            raise InputError(f"{path} has no alpha: an RGBA picture is needed to put it over a background")
        pictures.append(pixels)
    if pictures[0].shape != pictures[1].shape:
        sizes = " and ".join(f"{p.shape[1]}×{p.shape[0]}" for p in pictures)
        raise InputError(f"{rendered} and {truth} are not the same size ({sizes}): render at the size of the truth")
    raw, aligned, scale = scale_aligned_psnr(*pictures)
    return {"psnr_raw": raw, "psnr_aligned": aligned, "scale": scale}


def environment_log_rmse(environment: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Error of a recovered panorama: (root mean square of the difference of log radiance, the scale taken out first).

    Both are equirectangular (h, w, 3), linear, each of its own size: the larger is averaged down to the smaller.
    Pixels count by solid angle. The scale is the one that makes the mean difference zero. Natural logarithm: 0.1 is
    about 10 %. A thousandth of the mean radiance is added to both, below which nothing can be seen.
    """
    height = min(environment.shape[0], reference.shape[0])
    size = (2 * height, height)
    a, b = (cv2.resize(x.astype(np.float32), size, interpolation=cv2.INTER_AREA) for x in (environment, reference))
    weight = np.cos((np.arange(height) + 0.5) / height * np.pi - np.pi / 2)
    weight = np.broadcast_to(weight[:, None, None], a.shape) / (weight.sum() * a.shape[1] * 3)
    difference = np.log(b + 1e-3 * (b * weight).sum()) - np.log(a + 1e-3 * (a * weight).sum())
    mean = (difference * weight).sum()
    return float(np.sqrt(((difference - mean) ** 2 * weight).sum())), float(np.exp(mean))
