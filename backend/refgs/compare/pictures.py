"""Convert renderings to arrays to compare, and to pictures to look at."""

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from refgs.capture import LoadedView
from refgs.color import srgb_encode
from refgs.paths import whole
from refgs.render.renderer import Rendering


def composite(view: LoadedView, background: Tensor) -> Tensor:
    """Composite a photo over the background (3,): sRGB-encoded float (H, W, 3) in 0..1."""
    image = torch.from_numpy(view.image).to(background.device).float() / 255
    if view.alpha is None:
        return image
    alpha = torch.from_numpy(view.alpha).to(background.device).float()[..., None] / 255
    return image * alpha + background * (1 - alpha)


def maps(rendering: Rendering) -> dict[str, np.ndarray]:
    """Collect a rendering's passes as float arrays: colour (H, W, 4), linear and premultiplied; the others (H, W, 3) or (H, W)."""
    alpha = rendering.alpha.numpy(force=True)
    normal = torch.nn.functional.normalize(rendering.normal, dim=-1).numpy(force=True)
    images = {"normal": normal, "depth": rendering.depth.numpy(force=True), "alpha": alpha}
    if rendering.material is not None:
        images["color"] = np.dstack([rendering.radiance.numpy(force=True) * alpha[..., None], alpha])
        images |= {name: getattr(rendering, name).numpy(force=True) for name in ("albedo", "metallic", "roughness")}
    if rendering.visibility is not None:
        images["visibility"] = rendering.visibility.numpy(force=True)
    return images


def color_picture(rendering: Rendering, background: np.ndarray) -> np.ndarray:
    """Convert a rendering's colour to 8-bit RGBA, sRGB-encoded, with straight alpha."""
    alpha = rendering.alpha.numpy(force=True)[..., None]
    over = rendering.color.numpy(force=True) - background * (1 - alpha)
    return as_bytes(np.dstack([over / np.maximum(alpha, 1e-6), alpha]))


def picture(name: str, value: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Convert a pass of `maps` to 8-bit RGB or grey.

    Colour is over white, base colour is sRGB-encoded, normals are n/2 + 1/2, depth is divided by its maximum.
    """
    if name == "color":
        value = over_white(value)
    elif name == "normal":
        value = (value * 0.5 + 0.5) * (alpha > 0.5)[..., None]
    elif name == "albedo":
        value = srgb_encode(value)
    elif name == "depth":
        value = value / max(float(value.max()), 1e-12)
    return as_bytes(value)


def over_white(pixels: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Composite premultiplied linear RGBA over white, radiance times `scale`: sRGB-encoded (H, W, 3), 0..1."""
    return np.clip(srgb_encode(pixels[..., :3] * scale + 1 - pixels[..., 3:]), 0, 1)


def as_bytes(value: np.ndarray) -> np.ndarray:
    """Convert 0..1 to 0..255; NaN becomes 0."""
    return np.rint(np.clip(np.nan_to_num(value), 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W), (H, W, 3) or (H, W, 4) uint8 as PNG, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    with whole(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
