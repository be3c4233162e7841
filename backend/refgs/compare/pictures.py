"""Convert renderings to arrays for measurements, and to pictures for people."""

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from refgs.capture import LoadedView
from refgs.color import srgb_encode
from refgs.paths import whole
from refgs.render.renderer import Rendering

TOLD, DOUBTFUL = (0.33, 0.35, 0.38), (1.0, 0.6, 0.15)  # sRGB: where photos tell metal from paint, and where they do not


def composite(view: LoadedView, background: Tensor) -> Tensor:
    """Composite a photo over a background (3,), clipped to 0..1; both are sRGB-encoded."""
    image = torch.from_numpy(view.encoded).to(background.device).clamp_max(1)
    if view.alpha is None:
        return image
    alpha = torch.from_numpy(view.alpha).to(background.device).float()[..., None] / 255
    return image * alpha + background * (1 - alpha)


def maps(rendering: Rendering) -> dict[str, np.ndarray]:
    """Collect the passes of a rendering, such as depth and base colour, as float arrays by name.

    `color` is premultiplied linear RGBA (H, W, 4). The others are (H, W, 3) or (H, W). Passes that the rendering lacks are left out.
    """
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
    """Convert a rendering's colour, without its `background`, to 8-bit sRGB RGBA with straight alpha."""
    alpha = rendering.alpha.numpy(force=True)[..., None]
    over = rendering.color.numpy(force=True) - background * (1 - alpha)
    return as_bytes(np.dstack([over / np.maximum(alpha, 1e-6), alpha]))


def picture(name: str, value: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Convert one map of a rendering to an 8-bit RGB or grey picture.

    `name` and `value` are an entry of the dictionary that `maps` returns. `name` may also be "doubt". `value` (H, W) is then 0 where the
    photos show whether the surface is metal or paint, and 1 where they do not.

    - color: composited over white
    - albedo: sRGB-encoded
    - normal: n/2 + 1/2; black where `alpha` is 0.5 or less
    - depth: divided by its maximum
    - doubt: grey (TOLD) where the value is 0, orange (DOUBTFUL) where it is 1, mixed in between; black where `alpha` is 0.5 or less
    - others: only converted from 0..1 to 8 bits
    """
    if name == "color":
        value = over_white(value)
    elif name == "normal":
        value = (value * 0.5 + 0.5) * (alpha > 0.5)[..., None]
    elif name == "albedo":
        value = srgb_encode(value)
    elif name == "doubt":
        told, doubtful = (np.array(color) for color in (TOLD, DOUBTFUL))
        value = (told + (doubtful - told) * value[..., None]) * (alpha > 0.5)[..., None]
    elif name == "depth":
        value = value / max(float(value.max()), 1e-12)
    return as_bytes(value)


def over_white(pixels: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Composite premultiplied linear RGBA over white as sRGB in 0..1, with radiance times `scale`."""
    return np.clip(srgb_encode(pixels[..., :3] * scale + 1 - pixels[..., 3:]), 0, 1)


def as_bytes(value: np.ndarray) -> np.ndarray:
    """Convert floats, clipped to 0..1, to 8-bit integers; NaN becomes 0."""
    return np.rint(np.clip(np.nan_to_num(value), 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write a grey, RGB or RGBA uint8 picture as PNG, completely or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    with whole(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
