"""The report: one HTML file that holds all it shows, for one run folder or several side by side.

What is read of a run folder, each part left out where it is absent:

    metrics.json     numbers, nested at will; those of `refgs.report.figures` are named, and
                     relight.HDRI.{refgs,splats,mesh}.{psnr,flip}_{raw,aligned}
    history.jsonl    one object a line: seconds, iteration, loss, psnr_train, psnr_test, splats
    needs.json       a list of {"what", "why", "saved"}
    run.toml         the settings, and what was trained on
    pictures/test/{photo,color,normal,albedo,roughness,metallic}/VIEW.png, and true_normal/VIEW.png … where it is known
    pictures/relight/{truth,refgs,splats,mesh}/HDRI_VIEW.png
    pictures/environment.png, and environment_truth.png where the true light is known
"""

import base64
import io
import json
import tomllib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import jinja2
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from refgs import __version__
from refgs.errors import InputError
from refgs.paths import whole
from refgs.report.figures import DETAILS, HEADLINE, RELIT, Quantity, flatten, is_number, relit_pair

PASSES = {
    "photo": "photo",
    "color": "rendered",
    "normal": "normal",
    "albedo": "base colour",
    "roughness": "roughness",
    "metallic": "metallic",
    "true_normal": "true normal",
    "true_albedo": "true base colour",
    "true_roughness": "true roughness",
    "true_metallic": "true metallic",
}
MOST_VIEWS, MOST_RELIT = 4, 8
LARGEST_SIDE = 512  # pixels; a page of full-size photos would be too heavy to open
INK = "#010203"  # stands for the page's own text colour in a chart, light or dark


@dataclass
class RunPage:
    """What the page shows of one run."""

    name: str
    figures: dict[str, float]
    history: list[dict]
    left_out: list[dict]
    settings: str
    trained_on: str
    views: dict[str, dict[str, str]]
    relit: dict[str, dict[str, str]]
    light: dict[str, str]
    missing: list[str] = field(default_factory=list)


def write_report(runs: list[Path], out: Path) -> None:
    """Write the page of these run folders to `out`, replacing it. Raises InputError where a folder isn't there."""
    pages = [_read_run(folder) for folder in runs]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    html = environment.get_template("template.html").render(
        runs=pages,
        version=__version__,
        headline=_columns(pages, HEADLINE),
        details=_columns(pages, DETAILS),
        relit_table=_relit_table(pages),
        rest=_rest(pages),
        views=_names(page.views for page in pages),
        relit=_names(page.relit for page in pages),
        passes=PASSES,
        relit_kinds=RELIT,
        chart=_chart(pages),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole(out) as temporary:
        temporary.write_text(html, encoding="utf-8")


def _read_run(folder: Path) -> RunPage:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a run folder")
    missing: list[str] = []

    def read(file: str, parse, without: str):
        path = folder / file
        try:
            return parse(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            missing.append(f"{file} is not there: {without}")
        except (OSError, ValueError) as error:  # JSON's, TOML's and Unicode's errors are ValueErrors
            missing.append(f"{file} cannot be read ({error}): {without}")
        return None

    settings = read("run.toml", str, "its settings are not shown") or ""
    try:
        trained_on = Path(tomllib.loads(settings)["run"]["capture"]).name
    except (KeyError, TypeError, tomllib.TOMLDecodeError):
        trained_on = ""
    metrics = read("metrics.json", json.loads, "there are no figures") or {}
    history = read("history.jsonl", _lines, "there is no chart of error against time") or []
    left_out = read("needs.json", json.loads, "what was left out of this scene is not known")
    pictures = folder / "pictures"
    page = RunPage(
        name="/".join(folder.resolve().parts[-2:]).lstrip("/"),
        figures=dict(flatten(metrics)),
        history=history,
        left_out=[item for item in left_out if isinstance(item, dict)] if isinstance(left_out, list) else [],
        settings=settings,
        trained_on=trained_on,
        views=_pictures(pictures / "test", PASSES, MOST_VIEWS),
        relit=_pictures(pictures / "relight", RELIT, MOST_RELIT),
        light={kind: _embed(pictures / f"{kind}.png") for kind in ("environment", "environment_truth")},
        missing=missing,
    )
    if not page.views:
        missing.append("pictures/test is not there: no held-out views are shown")
    if not page.relit:
        missing.append("pictures/relight is not there: no relit pictures are shown")
    if not page.light["environment"]:
        missing.append("pictures/environment.png is not there: the recovered light is not shown")
    return page


def _lines(text: str) -> list[dict]:
    """The lines of history.jsonl that are whole: a training that was killed can leave half of one."""
    found = []
    for line in text.splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return [item for item in found if isinstance(item, dict) and is_number(item.get("seconds"))]


def _pictures(folder: Path, kinds: dict[str, str], most: int) -> dict[str, dict[str, str]]:
    """{name: {kind: data address}} of the pictures in folder/KIND/NAME.png: of the names that there are most kinds of, at
    most so many, evenly chosen."""
    count = Counter(path.stem for kind in kinds for path in folder.glob(f"{kind}/*.png"))
    names = sorted(name for name in count if count[name] == max(count.values()))
    if len(names) > most:
        names = [names[i] for i in np.linspace(0, len(names) - 1, most).round().astype(int)]
    found = {name: {kind: _embed(folder / kind / f"{name}.png") for kind in kinds} for name in names}
    return {name: images for name, images in found.items() if any(images.values())}


def _embed(path: Path) -> str:
    """The picture as a data address, made smaller if it is large; "" if there is none that can be read."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.exists() else None
    if image is None:
        return ""
    scale = LARGEST_SIDE / max(image.shape[:2])
    if scale >= 1:
        data = path.read_bytes()
    else:
        data = cv2.imencode(".png", cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))[1]
    return "data:image/png;base64," + base64.b64encode(data).decode()


def _names(groups) -> list[str]:
    """Every name once, in the order of the runs."""
    return list(dict.fromkeys(name for group in groups for name in group))


def _columns(pages: list[RunPage], figures: list[Quantity]) -> list[dict]:
    """The figures that some run has: heading, and for each run the text and whether it is the best of several."""
    columns = []
    for key, heading, text, better in figures:
        values = [page.figures.get(key) for page in pages]
        known = [value for value in values if value is not None]
        if not known:
            continue
        best = better(known) if better and len(set(known)) > 1 else None
        cells = [("–", False) if value is None else (text(value), value == best) for value in values]
        columns.append({"heading": heading, "cells": cells})
    return columns


def _relit_table(pages: list[RunPage]) -> list[dict]:
    """Rows of what was lit by an HDRI, and how well for each run."""
    found = _names({key.rsplit(".", 1)[0] for key in sorted(page.figures) if _is_relit(key)} for page in pages)
    rows = []
    for prefix in sorted(found):
        _, hdri, kind = prefix.split(".")
        cells = [relit_pair(page.figures, prefix) for page in pages]
        rows.append({"hdri": hdri, "kind": RELIT.get(kind, kind), "cells": cells})
    return rows


def _is_relit(key: str) -> bool:
    parts = key.split(".")
    return parts[0] == "relight" and len(parts) == 4 and parts[3].startswith(("psnr_", "flip_"))


def _rest(pages: list[RunPage]) -> list[dict]:
    """Every figure that no other table has."""
    shown = {figure.key for figure in HEADLINE + DETAILS}
    keys = [key for key in _names(page.figures for page in pages) if key not in shown and not _is_relit(key)]
    texts = {key: [page.figures.get(key) for page in pages] for key in keys}
    return [{"key": key, "cells": ["–" if x is None else f"{x:.5g}" for x in row]} for key, row in texts.items()]


def _chart(pages: list[RunPage]) -> str:
    """PSNR and loss against seconds of training, as inline SVG; "" where no run has a history."""
    drawn = [
        page for page in pages if any(_series(page.history, key)[0] for key in ("psnr_test", "psnr_train", "loss"))
    ]
    if not drawn:
        return ""
    style = {"svg.fonttype": "none", "svg.hashsalt": "refgs", "font.family": "sans-serif", "font.size": 11}
    style |= dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK)
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(11, 3.8), layout="constrained")
        quality, loss = figure.subplots(1, 2)
        for index, page in enumerate(drawn):
            color = matplotlib.colormaps["Set2"](index % 8)
            for key, line, what in (("psnr_test", "-", "held-out views"), ("psnr_train", ":", "training views")):
                seconds, values = _series(page.history, key)
                if seconds:  # the error's logarithm: a decibel is the same step everywhere
                    quality.plot(seconds, values, line, color=color, lw=2, label=f"{page.name}, {what}")
            loss.plot(*_series(page.history, "loss"), color=color, lw=2, label=page.name)
        loss.set_yscale("log")
        quality.set_ylabel("PSNR, dB")
        loss.set_ylabel("training loss")
        for axes in (quality, loss):
            axes.set(xscale="log", xlabel="seconds of training", facecolor="none")
            axes.grid(alpha=0.25, color=INK, lw=0.5)
            axes.spines[["top", "right"]].set_visible(False)
            if len(axes.lines) > 1:
                axes.legend(frameon=False, fontsize=9)
        for axis in (quality.xaxis, loss.xaxis, loss.yaxis):  # plain numbers, also where there is less than a decade
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    return svg[svg.index("<svg") :].replace(INK, "currentColor")


def _series(history: list[dict], key: str) -> tuple[list[float], list[float]]:
    """Seconds and values of the lines that have this key."""
    points = [(line["seconds"], line[key]) for line in history if is_number(line.get(key)) and line["seconds"] > 0]
    return [x for x, _ in points], [y for _, y in points]
