"""Name the metrics of metrics.json, such as PSNR, and format them for the console and the report page."""

import sys
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeGuard

RELIT = {
    "truth": "ground truth",
    "refgs": "surfels (RefGS)",
    "splats": "splats (Eevee)",
    "mesh": "mesh (Eevee)",
}


class Quantity(NamedTuple):
    """Describe a metric of metrics.json.

    `key` joins nested keys by dots, such as "mesh.chamfer". `heading` is its title in tables. `text` formats its value. `better` is `max`
    if larger values are better, `min` if smaller ones are, or None if neither is.
    """

    key: str
    heading: str
    text: Callable[[float], str]
    better: Callable[[Iterable[float]], float] | None


def duration(seconds: float) -> str:
    """Format seconds as minutes and seconds from one minute on, else as seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


HEADLINE = [
    Quantity("psnr", "PSNR", "{:.2f} dB".format, max),
    Quantity("ssim", "SSIM", "{:.4f}".format, max),
    Quantity("flip", "FLIP", "{:.4f}".format, min),
    Quantity("normal_mae_degrees", "normal error", "{:.2f}°".format, min),
    Quantity("training_seconds", "training", duration, min),
    Quantity("total_seconds", "training with start and end", duration, min),
    Quantity("seconds", "whole demo", duration, min),
    Quantity("frames_per_second", "rendering", "{:.3g} frames a second".format, max),
    Quantity("splats", "surfels", "{:,.0f}".format, None),
    Quantity("peak_memory_bytes", "peak memory", lambda x: f"{x / 2**30:.2f} GiB", min),
]

DETAILS = [
    Quantity("psnr_pose_fitted", "PSNR, each photo's pose fitted", "{:.2f} dB".format, max),
    Quantity("psnr_exposure_fitted", "PSNR, each photo's exposure and white balance fitted", "{:.2f} dB".format, max),
    Quantity("lpips", "LPIPS, VGG", "{:.4f}".format, min),
    Quantity("normal_ssim", "normals: SSIM", "{:.4f}".format, max),
    Quantity("albedo.psnr_raw", "base colour: PSNR", "{:.2f} dB".format, max),
    Quantity("albedo.psnr_aligned", "base colour: PSNR after one scale a channel", "{:.2f} dB".format, max),
    Quantity("roughness_mae", "roughness: mean error", "{:.4f}".format, min),
    Quantity("metallic_mae", "metallic: mean error", "{:.4f}".format, min),
    Quantity("metallic_wrong", "metallic off by more than 0.5", "{:.1%}".format, min),
    Quantity("doubt.part", "surface where photos do not tell metal from paint", "{:.1%}".format, None),
    Quantity("visibility_agreement", "mirror visibility: pixels that agree", "{:.1%}".format, max),
    Quantity("visibility_free", "mirror visibility: pixels that are free in truth", "{:.1%}".format, None),
    Quantity("environment.log_rmse", "light: RMS error of log radiance after one scale", "{:.3f}".format, min),
    Quantity("environment.lights_degrees", "light: angular error of the brightest lights", "{:.2f}°".format, min),
    Quantity("mesh.chamfer", "mesh: Chamfer distance, of the object's radius", "{:.3%}".format, min),
    Quantity("mesh.normal_consistency", "mesh: normal consistency", "{:.4f}".format, max),
    Quantity("tensoir.relit_psnr", "relit, as TensoIR measures: PSNR", "{:.2f} dB".format, max),
    Quantity("tensoir.albedo_psnr", "base colour, as TensoIR measures: PSNR", "{:.2f} dB".format, max),
    Quantity("stanford_orb.light.psnr_h", "relit, as Stanford-ORB measures: PSNR-H", "{:.2f} dB".format, max),
    Quantity("stanford_orb.light.psnr_l", "relit, as Stanford-ORB measures: PSNR-L", "{:.2f} dB".format, max),
    Quantity("peak_card_memory_bytes", "peak memory on the card", lambda x: f"{x / 2**30:.2f} GiB", min),
]


def is_number(value: object) -> TypeGuard[int | float]:
    """Tell whether a value is a finite number that a float can hold."""
    most = sys.float_info.max
    return isinstance(value, int | float) and not isinstance(value, bool) and -most <= value <= most


def flatten(values: object, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield each finite number in nested dicts, with its keys joined by dots: ("a.b", number)."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from flatten(value, f"{prefix}.{key}" if prefix else str(key))
    elif is_number(values):
        yield prefix, values


def in_words(metrics: dict, figures: list[Quantity]) -> list[str]:
    """Format metrics that `figures` describes as text, such as "PSNR 24.31 dB"."""
    known = dict(flatten(metrics))
    return [f"{heading} {text(known[key])}" for key, heading, text, _ in figures if key in known]


def relit_pair(figures: dict[str, float], prefix: str) -> str:
    """Format PSNR and FLIP of pictures under another light as text, such as "24.10 / 26.30 dB, FLIP 0.081 / 0.072".

    The first number of each pair is "raw". The second is "aligned": measured after the renderings' radiance was multiplied by the factor
    that fits best. `figures` has the metrics as a flat dict. Its keys are joined by dots, such as "relight.studio.mesh.psnr_raw". `prefix`
    is the start of the keys to format, such as "relight.studio.mesh".
    """
    parts = []
    for name, text in (("psnr", "{:.2f}"), ("flip", "{:.3f}")):
        found = [figures.get(f"{prefix}.{name}_{which}") for which in ("raw", "aligned")]
        parts.append(" / ".join(text.format(x) for x in found if x is not None))
    psnr, flip = parts
    return ", ".join([f"{psnr} dB"] * bool(psnr) + [f"FLIP {flip}"] * bool(flip)) or "–"


def relit_in_words(metrics: dict) -> list[str]:
    """Format PSNR and FLIP as a line for each light and way of rendering."""
    known = dict(flatten(metrics))
    lit = [(hdri, kind) for hdri, kinds in metrics.get("relight", {}).items() for kind in kinds]
    return [
        f"relit by {hdri}, {RELIT.get(kind, kind)}: {relit_pair(known, f'relight.{hdri}.{kind}')}" for hdri, kind in lit
    ]
