"""Write the report: one self-contained HTML file about one run folder, or about several side by side.

It reads these files of a run folder. If a file is missing, its section is left out:

    metrics.json     nested objects. Their numbers are metrics: those that `refgs.report.figures` names,
                     relight.HDRI.{refgs,splats,mesh}.{psnr,flip}_{raw,aligned}, and any others.
                     ambiguities.NAME.what and doubt.what are sentences on what photos leave open, such as metal or paint.
    history.jsonl    one object a line: seconds, iteration, parts (seconds by kind of work), and the errors that `refgs.report.curves` names
    needs.json       a list with an object for each optional part of the training: "what" is the part, "why" the reason to keep it or leave
                     it out. If known: "needed", "saved", "cost", and "pictures" (files in needs/: a view with and without the part)
    run.toml         the settings, and the capture's folder
    pictures/test/{photo,color,normal,albedo,roughness,metallic}/VIEW.png, and doubt/VIEW.png, true_normal/VIEW.png … if known
    pictures/relight/{truth,refgs,splats,mesh}/HDRI_VIEW.png
    pictures/environment.png, and environment_truth.png if the true light is known
"""

import base64
import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import jinja2

from refgs import __version__
from refgs.errors import InputError, one_line
from refgs.formats import history
from refgs.formats.metrics import Metrics, read_metrics
from refgs.formats.needs import Needs, Row
from refgs.formats.pixels import read_png
from refgs.formats.run_toml import Summary
from refgs.formats.validate import parse_toml, read_json, validated
from refgs.paths import disk_errors_named, make_folders, read_bytes, read_text, write_text
from refgs.report.charts import PARTS, error_chart, parts_chart
from refgs.report.curves import QUANTITIES, Curve, as_csv, curve, knee, levels, time_to
from refgs.report.figures import DETAILS, HEADLINE, RELIT, Quantity, duration, flatten, is_number, relit_pair
from refgs.report.labels import labels
from refgs.spread import spread

PASSES = {
    "photo": "photo",
    "color": "rendered",
    "normal": "normal",
    "albedo": "base colour",
    "roughness": "roughness",
    "metallic": "metallic",
    "doubt": "orange: photos do not tell metal from paint",
    "true_normal": "true normal",
    "true_albedo": "true base colour",
    "true_roughness": "true roughness",
    "true_metallic": "true metallic",
}
MOST_VIEWS, MOST_RELIT = 4, 8
LARGEST_SIDE = 512  # pixels, so that the page stays small enough to open


@dataclass
class RunPage:
    """Hold what the report shows of one run; `label` is its unique name."""

    name: str
    label: str
    figures: dict[str, float]
    history: list[dict]
    left_out: list[Row]
    decisions: list[dict]
    ambiguities: list[str]
    settings: str
    facts: Summary
    trained_on: str
    views: dict[str, dict[str, str]]
    relit: dict[str, dict[str, str]]
    light: dict[str, str]
    missing: list[str] = field(default_factory=list)


def write_report(runs: list[Path], out: Path) -> None:
    """Write a report page about these run folders to `out`, and a CSV file with the numbers of its charts beside it.

    Existing files are replaced. Raises InputError if a run folder does not exist, or if the disk is full or read-only.
    """
    pages = [_read_run(folder) for folder in runs]
    if len(pages) > 1:
        for page, label in zip(pages, labels([p.name for p in pages], [p.facts for p in pages]), strict=True):
            page.label = label
    groups = _error_curves(pages)
    parts = {page.label: spent for page in pages if (spent := _seconds_by_work(page))}
    html = template(Path(__file__).with_name("template.html")).render(
        runs=pages,
        version=__version__,
        headline=_columns(pages, HEADLINE),
        details=_columns(pages, DETAILS),
        relit_table=_relit_table(pages),
        rest=_other_figures(pages),
        views=_unique_names(page.views for page in pages),
        relit=_unique_names(page.relit for page in pages),
        passes={
            kind: PASSES[kind] for kind in PASSES if any(view[kind] for page in pages for view in page.views.values())
        },
        relit_kinds=RELIT,
        errors=error_chart(groups, [page.label for page in pages]),
        times=_time_tables(groups),
        parts=parts_chart(parts),
        timed=list(parts),
        parts_table=_parts_table(parts),
    )
    figures = as_csv({page.label: page.history for page in pages}, groups)
    html, figures = (text.encode(errors="replace").decode() for text in (html, figures))  # without lone surrogates
    make_folders([out.parent])
    with disk_errors_named([out.parent], "write the report again"):
        for file, text in ((out, html), (out.with_suffix(".csv"), figures)):
            write_text(file, text)


def template(file: Path) -> jinja2.Template:
    """Load a page's Jinja template, which may include files of the report's folder."""
    folders = [file.parent, Path(__file__).parent]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(file.name)


def _read_run(folder: Path) -> RunPage:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a run folder")
    missing: list[str] = []

    def read(file: str, parse, without: str):
        path = folder / file
        if not os.path.lexists(path):
            missing.append(f"{file} is not there: {without}")
            return None
        try:
            return parse(path)
        except (InputError, OSError, ValueError) as error:
            missing.append(f"{file} cannot be read ({error}): {without}")
            return None

    settings, facts = read("run.toml", _settings, "its settings are not shown") or ("", Summary())
    metrics, known = read("metrics.json", read_metrics, "there are no figures") or ({}, Metrics())
    lines = _history(folder, missing)
    needs = read("needs.json", _needs, "what was left out of this scene is not known")
    rows = needs.root if needs else []
    pictures = folder / "pictures"
    name = one_line("/".join(folder.resolve().parts[-2:]).lstrip("/"))
    page = RunPage(
        name=name,
        label=name,
        figures=dict(flatten(metrics)),
        history=lines,
        left_out=rows,
        decisions=_decisions(folder, rows),
        ambiguities=known.said(),
        settings=settings,
        facts=facts,
        trained_on=Path(str(facts.run.get("capture", ""))).name,
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


def _settings(file: Path) -> tuple[str, Summary]:
    """Return a run.toml's text and its parsed content. Raises InputError."""
    again = "Copy the run folder again."
    text = read_text(file, again)
    return text, validated(parse_toml(text, str(file), again), Summary, str(file), again)


def _needs(file: Path) -> Needs:
    return read_json(file, Needs, "Copy the run folder again.")


def _decisions(folder: Path, rows: list[Row]) -> list[dict]:
    """Return "what", "figures" and "pictures" (data URLs) for each row that has pictures."""
    found = []
    for row in rows:
        if (shown := row.pictures) is None:
            continue
        files = ((shown.on, "with"), (shown.off, "without"), (shown.photo, "photo"))
        pictures = [(caption, _embed(folder / file)) for file, caption in files]
        figures = f"with {shown.psnr_on:.1f} dB, without {shown.psnr_off:.1f} dB, of photo {shown.view}"
        if all(url for _, url in pictures):
            answer = "kept" if row.needed else "left out"
            found.append({"what": f"{row.what}: {answer}", "figures": figures, "pictures": pictures})
    return found


def _history(folder: Path, missing: list[str]) -> list[dict]:
    """Read history.jsonl's lines with "seconds", and add to `missing` what cannot be read."""
    without = "there is no chart of error against time"
    try:
        lines, damaged = history.read(folder / history.FILE)
    except FileNotFoundError:
        missing.append(f"{history.FILE} is not there: {without}")
        return []
    except OSError as error:
        missing.append(f"{history.FILE} cannot be read ({error}): {without}")
        return []
    if damaged:
        missing.append(history.damage(damaged))
    return [line for line in lines if is_number(line.get("seconds"))]


def _pictures(folder: Path, kinds: dict[str, str], most: int) -> dict[str, dict[str, str]]:
    """Return {name: {kind: data URL}} of folder/KIND/NAME.png, for at most `most` complete names."""
    count = Counter(path.stem for kind in kinds for path in folder.glob(f"{kind}/*.png"))
    names = sorted(name for name in count if count[name] == max(count.values()))
    found = {name: {kind: _embed(folder / kind / f"{name}.png") for kind in kinds} for name in spread(names, most)}
    return {name: images for name, images in found.items() if any(images.values())}


def _embed(path: Path) -> str:
    """Return a picture as a data URL of at most LARGEST_SIDE pixels, or ""."""
    image = read_png(path)
    if image is None:
        return ""
    scale = LARGEST_SIDE / max(image.shape[:2])
    if scale >= 1:
        data = read_bytes(path)
    else:
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        data = cv2.imencode(".png", small)[1].tobytes()
    return "data:image/png;base64," + base64.b64encode(data).decode()


def _unique_names(groups) -> list[str]:
    """List the names in all groups once each, in order of first occurrence."""
    return list(dict.fromkeys(name for group in groups for name in group))


def _columns(pages: list[RunPage], figures: list[Quantity]) -> list[dict]:
    """Make a column of cells (text, is best) for each metric that any run has."""
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
    """Make a row of PSNR and FLIP for each light and way of rendering."""
    found = _unique_names({key.rsplit(".", 1)[0] for key in sorted(page.figures) if _is_relit(key)} for page in pages)
    rows = []
    for prefix in sorted(found):
        _, hdri, kind = prefix.split(".")
        cells = [relit_pair(page.figures, prefix) for page in pages]
        rows.append({"hdri": hdri, "kind": RELIT.get(kind, kind), "cells": cells})
    return rows


def _is_relit(key: str) -> bool:
    parts = key.split(".")
    return parts[0] == "relight" and len(parts) == 4 and parts[3].startswith(("psnr_", "flip_"))


def _other_figures(pages: list[RunPage]) -> list[dict]:
    """Make a table row for each metric that no other table shows."""
    shown = {figure.key for figure in HEADLINE + DETAILS}
    keys = [key for key in _unique_names(page.figures for page in pages) if key not in shown and not _is_relit(key)]
    texts = {key: [page.figures.get(key) for page in pages] for key in keys}
    return [{"key": key, "cells": ["–" if x is None else f"{x:.5g}" for x in row]} for key, row in texts.items()]


def _error_curves(pages: list[RunPage]) -> list[list[Curve]]:
    """Return, for each recorded error measure, the curves of all runs that have it."""
    groups = []
    for quantity in QUANTITIES:
        curves = [curve(page.label, page.history, quantity) for page in pages]
        if known := [found for found in curves if len(found.seconds)]:
            groups.append(known)
    return groups


def _time_tables(groups: list[list[Curve]]) -> list[dict]:
    """Make a table of times to reach errors, and knees, for each error measure."""
    tables = []
    for curves in groups:
        quantity, errors = curves[0].quantity, levels(curves)
        cells = {found.run: [_duration_or_dash(time_to(found, error)) for error in errors] for found in curves}
        heads, knees = [quantity.text(error) for error in errors], [knee(found) for found in curves]
        if any(at is not None for at in knees):
            heads.append("knee")
            for found, at in zip(curves, knees, strict=True):
                point = "–" if at is None else f"{duration(found.seconds[at])}: {quantity.text(found.errors[at])}"
                cells[found.run].append(point)
        if heads:
            tables.append({"what": quantity.title, "levels": heads, "cells": cells})
    return tables


def _duration_or_dash(seconds: float | None) -> str:
    return "–" if seconds is None else duration(seconds)


def _seconds_by_work(page: RunPage) -> dict[str, float]:
    """Return the seconds that a run spent on each kind of work, such as shading."""
    return next((dict(flatten(line["parts"])) for line in reversed(page.history) if line.get("parts")), {})


def _parts_table(parts: dict[str, dict[str, float]]) -> list[dict]:
    """Make a row of seconds and percentages for each kind of work in PARTS."""
    rows = []
    for name, title in PARTS.items():
        seconds = [spent.get(name, 0.0) for spent in parts.values()]
        if any(seconds):
            wholes = [sum(spent.values()) for spent in parts.values()]
            cells = [f"{s:.3g} s, {s / w:.1%}" for s, w in zip(seconds, wholes, strict=True)]
            rows.append({"what": title, "cells": cells})
    return rows
