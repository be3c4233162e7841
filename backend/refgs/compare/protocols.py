"""Measure errors as the authors of published data sets do, so that the figures can stand beside published ones.

"TensoIR's" means as in `renderer.py` and `scripts/relight_importance.py` of its repository (Jin et al., CVPR 2023). "Stanford-ORB's" means
as in `orb/utils/metrics.py` and `orb/utils/test.py` of its repository (Kuang et al., NeurIPS 2023). Masks are (h, w) in 0..1.
"""

import cv2
import numpy as np

from refgs.color import srgb_encode
from refgs.compare import metrics

BACKGROUND_NORMAL = (0.0, 0.0, 1.0)  # TensoIR's, of pixels that the object does not cover
GAMMA = 2.2  # with which TensoIR encodes base colour
MOST_RADIANCE = 4.0  # Stanford-ORB clips radiance here for PSNR-H


def albedo_ratio(pairs: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Compute TensoIR's correction of base colour: a factor for each channel (3,), the median of true divided by rendered values.

    `pairs` has a pair for each view: the rendered and the true linear base colours (N, 3) of the object's pixels. The median is over the
    pixels of all views.
    """
    rendered, true = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return np.median(true / np.maximum(rendered, 1e-6), axis=0)


def albedo_square(rendered: np.ndarray, true: np.ndarray, alpha: np.ndarray) -> float:
    """Compute TensoIR's mean squared error of one view's linear base colours (h, w, 3), over all pixels of the picture.

    The caller has already corrected `rendered` by `albedo_ratio`. The function clips it to 0..1, and sets it to white where `alpha` is 0.
    It blends `true` with white by `alpha`, which is the object's true alpha. It then encodes both with the gamma GAMMA. Pixels where
    `alpha` is 0 have no error.
    """
    ours = np.where((alpha > 0)[..., None], np.clip(rendered, 0, 1), 1)
    theirs = true * alpha[..., None] + 1 - alpha[..., None]
    return float(((np.maximum(theirs, 0) ** (1 / GAMMA) - ours ** (1 / GAMMA)) ** 2).mean(dtype=np.float64))


def whole_normal_mae_degrees(normals: np.ndarray, alpha: np.ndarray, true: np.ndarray, true_alpha: np.ndarray) -> float:
    """Compute TensoIR's mean angle in degrees between two pictures of normals (h, w, 3), over all pixels of the picture.

    Pixels beside the object have BACKGROUND_NORMAL in both: they make the mean smaller than that of `metrics.normal_mae_degrees`.
    """
    a, b = (
        n * w[..., None] + np.multiply.outer(1 - w, BACKGROUND_NORMAL)
        for n, w in ((normals, alpha), (true, true_alpha))
    )
    lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    cosine = (a * b).sum(-1) / np.maximum(lengths, 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean(dtype=np.float64))


def eroded(mask: np.ndarray) -> np.ndarray:
    """Return the mask (h, w) after Stanford-ORB's erosion by 5×5 pixels, as bool."""
    return cv2.erode(np.rint(mask * 255).astype(np.uint8), np.ones((5, 5), np.uint8)) > 127


def similarity(image: np.ndarray, photo: np.ndarray, mask: np.ndarray, scaled: bool, lpips: bool) -> dict[str, float]:
    """Measure how alike a rendering and a photo are, as Stanford-ORB does. Both are linear radiance (h, w, 3). Returns by name:

    - psnr_h: PSNR of radiance. Both pictures are first multiplied by one factor, and then clipped at MOST_RADIANCE. The factor is the mean
      of the sRGB-encoded photo divided by the mean of the linear photo. The PSNR's peak is 1, although MOST_RADIANCE is more.
    - psnr_l: PSNR of the pictures after clipping to 0..1 and sRGB encoding
    - ssim: SSIM of these encoded pictures, with a Gaussian window of 3×3 pixels and σ 1.5
    - lpips, only if the argument `lpips` is true: LPIPS (VGG-16) of these encoded pictures after a second sRGB encoding, as in
      Stanford-ORB's program

    Both pictures are black outside the eroded mask. Means include these black pixels. If `scaled` is true, each channel of the rendering is
    first multiplied by its least-squares factor. Stanford-ORB does this for pictures under another light. If a uniform grey of 0.5 has a
    higher PSNR than the rendering, the PSNR of the grey is returned.
    """
    inside = eroded(mask > 0.5)[..., None]
    image, photo = (np.where(inside, np.maximum(x, 0), 0).astype(np.float64) for x in (image, photo))
    if scaled:
        power = (image * image).sum(axis=(0, 1))
        image = np.where(power > 1e-6, image * ((image * photo).sum(axis=(0, 1)) / np.maximum(power, 1e-6)), image)
    clipped = np.clip(photo, 0, 1)
    factor = srgb_encode(clipped).mean() / clipped.mean() if clipped.mean() > 1e-8 else 1.0
    rendered, real = (np.clip(x * factor, 0, MOST_RADIANCE) for x in (image, photo))
    found = {"psnr_h": _psnr(rendered, real, inside)}
    shown, taken = (srgb_encode(np.clip(x, 0, 1)) for x in (image, photo))
    found |= {"psnr_l": _psnr(shown, taken, inside), "ssim": _small_ssim(shown, taken)}
    return found | ({"lpips": metrics.lpips(srgb_encode(shown), srgb_encode(taken))} if lpips else {})


def _psnr(image: np.ndarray, photo: np.ndarray, inside: np.ndarray) -> float:
    return max(metrics.decibels(float(((x - photo) ** 2).mean())) for x in (image, 0.5 * inside))


def _small_ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """Compute SSIM like kornia's `ssim_loss` with a 3-pixel window (Wang et al. 2004, Eq. 13)."""

    def mean(x: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(x, (3, 3), 1.5, borderType=cv2.BORDER_REFLECT_101)

    a, b = mean(image), mean(reference)
    variances = mean(image * image) - a * a + mean(reference * reference) - b * b
    covariance = mean(image * reference) - a * b
    c1, c2 = 0.01**2, 0.03**2
    return float(((2 * a * b + c1) * (2 * covariance + c2) / ((a * a + b * b + c1) * (variances + c2))).mean())


def cosine_distance(normals: np.ndarray, true: np.ndarray, mask: np.ndarray) -> float:
    """Compute Stanford-ORB's error of normals (h, w, 3): the mean of 1 − cosine over the eroded mask (see `eroded`).

    A pixel where a normal has length 0 has the error 1. If the eroded mask is empty, the result is 0.
    """
    seen = eroded(mask > 0.5)
    a, b = (x[seen] / (np.linalg.norm(x[seen], axis=-1, keepdims=True) + 1e-6) for x in (normals, true))
    return float((1 - (a * b).sum(-1)).mean(dtype=np.float64)) if seen.any() else 0.0


def depth_error(views: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float:
    """Compute Stanford-ORB's scale-invariant error of depth: the mean squared error after one least-squares factor for all views.

    `views` has rendered depth, true depth and mask (h, w) of each view. The mean is over all pixels of the picture, but outside the eroded
    mask (see `eroded`) the error is 0.
    """
    rows = [
        (a * seen, b * seen) for a, b, seen in ((a.astype(np.float64), b, eroded(mask > 0.5)) for a, b, mask in views)
    ]
    power = sum(float((a * a).sum()) for a, _ in rows)
    scale = sum(float((a * b).sum()) for a, b in rows) / power if power > 0 else 0.0
    return float(np.mean([((scale * a - b) ** 2).mean() for a, b in rows]))
