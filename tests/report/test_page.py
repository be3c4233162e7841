"""Test the report page: it shows everything in a run folder, says what is missing, and loads nothing from the network."""

import base64
import csv
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from refgs.errors import InputError
from refgs.report.page import write_report
from tests.makers.captures import write

VIEWS = [f"test_{i:03d}" for i in range(8)]


class Page(HTMLParser):
    """Parse an HTML report. Collects its pictures with captions, its text, its tags, and every address that a browser would load."""

    def __init__(self, html: str):
        super().__init__()
        self.html, self.images, self.addresses, self.words, self.tags = html, [], [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.tags.append(tag)
        self.addresses += [found[key] for key in ("src", "href", "xlink:href", "srcset", "action") if key in found]
        if tag == "img":
            self.images.append((found["alt"], found["src"]))

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return re.sub(r"\s+", " ", " ".join(self.words))


def reported(*runs, out=None):
    """Write the report page of some runs, and parse it. The default file is report.html in the first run's folder."""
    out = out or runs[0] / "report.html"
    write_report(runs, out)
    return Page(out.read_text(encoding="utf-8"))


def picture(path, value, side=24, channels=3):
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = (side, side, channels) if channels > 1 else (side, side)
    cv2.imwrite(str(path), np.full(shape, value, np.uint8))


def pixels(address):
    """Decode the picture in a data: URL."""
    return cv2.imdecode(np.frombuffer(base64.b64decode(address.split(",")[1]), np.uint8), -1)


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "vases" / "first <run>"
    folder.mkdir(parents=True)
    for index, view in enumerate(VIEWS):
        for kind in ("photo", "color", "normal", "albedo"):
            picture(folder / f"pictures/test/{kind}/{view}.png", 10 * index)
        for kind in ("roughness", "metallic"):
            picture(folder / f"pictures/test/{kind}/{view}.png", 99, channels=1)
    for kind in ("truth", "splats", "mesh"):
        picture(folder / f"pictures/relight/{kind}/studio_test_002.png", 50, channels=4)
    picture(folder / "pictures/environment.png", 70)
    studio = {"splats": {"psnr_raw": 21.25, "psnr_aligned": 23.5}, "mesh": {"psnr_raw": 20.75}}
    studio["refgs"] = {"psnr_raw": 24.5, "flip_raw": 0.125, "flip_aligned": 0.111}
    figures = {"psnr": 29.604, "ssim": 0.94126, "normal_mae_degrees": 4.2, "seconds": 431.2, "splats": 19832}
    figures |= {"relight": {"studio": studio}, "environment": {"log_rmse": 0.3125}}
    figures |= {"peak_memory_bytes": 2**31, "split": "test"}
    (folder / "metrics.json").write_text(json.dumps(figures))
    lines = [{"seconds": s, "iteration": 10 * s, "loss": 1 / s} for s in range(1, 9)]
    for line in lines:
        decibels = 20 * np.log10(line["seconds"])
        line |= {"psnr_train": 22 + decibels, "psnr_test": 20 + decibels}
    lines[-1]["parts"] = {"raster": 6, "shading": 2, "measuring": 2}
    (folder / "history.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    needs = [{"what": "412 surfels", "why": "no view sees them", "saved": "2 %", "cost": "-0.125 dB"}]
    (folder / "needs.json").write_text(json.dumps(needs))
    (folder / "run.toml").write_text('[run]\ncapture = "/far/away/urn"\n\n[settings.train]\niterations = 4000\n')
    return folder


def test_everything_is_on_the_page_and_in_the_page(run):
    page = reported(run)
    figures = "29.60 dB", "0.9413", "4.20°", "7 min 11 s", "19,832", "2.00 GiB", "21.25 / 23.50", "20.75", "0.312"
    relit = "studio surfels (RefGS) 24.50 dB, FLIP 0.125 / 0.111"
    settings = "412 surfels", "no view sees them", "2 %", "iterations = 4000"
    for words in ("vases/first <run>", "“urn”", *figures, relit, *settings):
        assert words in page.text, words
    assert "is not there" not in page.text
    kinds = [kind for kind, _ in page.images]
    for kind in ("photo", "rendered", "normal", "base colour", "roughness", "metallic"):
        assert kinds.count(kind) == 4, "four of eight views, evenly chosen"
    for kind in ("ground truth", "splats (Eevee)", "mesh (Eevee)", "recovered"):
        assert kinds.count(kind) == 1
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert not {"script", "link", "iframe"} & set(page.tags)
    shown = pixels(page.images[0][1])
    assert shown.shape == (24, 24, 4) and (shown == 50).all()
    assert sorted(path.name for path in run.glob("report*")) == ["report.csv", "report.html"]


def test_where_photos_do_not_tell_is_shown_beside_the_materials(run):
    def captions():
        return [kind for kind, _ in reported(run).images]

    orange = "orange: photos do not tell metal from paint"
    assert orange not in captions()
    for view in VIEWS:
        picture(run / f"pictures/test/doubt/{view}.png", 120)
    shown = captions()
    assert shown.count(orange) == 4 and shown[shown.index(orange) - 1] == "metallic"
    figures = json.loads((run / "metrics.json").read_text())
    what = "photos do not tell metal from paint on 12% of the surface"
    (run / "metrics.json").write_text(json.dumps(figures | {"doubt": {"part": 0.1234, "what": what}}))
    text = reported(run).text
    assert (
        what.replace("photos", "Photos", 1) in text
        and "surface where photos do not tell metal from paint 12.3%" in text
    )


def charts(html):
    return [html[at.start() : html.index("</svg>", at.start())] for at in re.finditer("<svg", html)]


def places(svg, gid):
    """Read the curves drawn in an SVG's groups named `gid`. Return the points (n, 2) of each curve; y points down."""
    paths = re.findall(rf'<g id="{gid}">\s*<path d="([^"]+)"', svg)
    return [np.array(re.findall(r"[ML] (\S+) (\S+)", path), float) for path in paths]


def test_the_charts_draw_the_history(run):
    """Check the charts of error over time and of the seconds that each part of the training takes.

    Both axes of the error chart are logarithmic, so the test's power law is drawn as a straight line. The bars of the other chart have
    lengths proportional to the seconds.
    """
    page = reported(run)
    errors, parts = charts(page.html)
    for words in ("held-out views: RMS error", "training views: RMS error", "training loss", "seconds of training"):
        assert words in errors
    assert "currentColor" in errors and "knee" not in errors, "a power law has none"
    curves = places(errors, "curve")
    assert [len(line) for line in curves] == [8, 8, 8]
    for line in curves:
        across, down = np.diff(line, axis=0).T
        assert (across > 0).all() and (down > 0).all(), "a falling error falls on the page"
        np.testing.assert_allclose(down / across, down[0] / across[0], rtol=1e-2)
    bars = [re.findall(r"[ML] (\S+) \S+", path) for path in re.findall(r'<path d="([^"]+)" clip-path', parts)]
    widths = [max(map(float, bar)) - min(map(float, bar)) for bar in bars if len(bar) >= 4]
    assert widths[0] == pytest.approx(3 * widths[1], rel=1e-3), "raster took three times as long as shading"
    assert "raster 6 s, 60.0%" in page.text and "measuring 2 s, 20.0%" in page.text


def test_the_figures_are_beside_the_page(run):
    write_report([run], run / "report.html")
    with open(run / "report.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["run", "iteration", "seconds", "quantity", "value", "mark"]
    every = [row for row in rows if row["quantity"] == "test_rmse"]
    test = [row for row in every if row["mark"] != "reaches"]
    assert [(row["iteration"], row["seconds"]) for row in test] == [(str(10 * s), str(s)) for s in range(1, 9)]
    np.testing.assert_allclose([float(row["value"]) for row in test], [0.1 / s for s in range(1, 9)], rtol=1e-4)
    assert {row["run"] for row in rows} == {"vases/first <run>"} and {row["mark"] for row in test} == {"front"}
    spent = {row["quantity"]: float(row["value"]) for row in rows if row["quantity"].startswith("part: ")}
    assert spent == {"part: raster": 6, "part: shading": 2, "part: measuring": 2}
    reached = [(float(row["value"]), float(row["seconds"])) for row in every if row["mark"] == "reaches"]
    assert len(reached) > 2
    for error, seconds in reached:
        assert seconds == pytest.approx(0.1 / error, rel=1e-3)


def test_several_runs_stand_side_by_side_and_the_best_is_marked(run, tmp_path):
    other = tmp_path / "vases" / "second"
    picture(other / "pictures/test/color/test_000.png", 1)
    (other / "metrics.json").write_text(json.dumps({"psnr": 26.0, "normal_mae_degrees": 3.0}))
    page = reported(run, other, out=tmp_path / "pages" / "both.html")
    assert re.findall(r'class="best">([^<]+)<', page.html) == ["29.60 dB", "3.00°"]
    assert "vases/second" in page.text and "26.00 dB" in page.text
    assert "vases/second : run.toml is not there" in page.text.replace("second:", "second :")


def test_an_empty_folder_gives_a_page_that_says_what_is_missing(tmp_path):
    page = reported(tmp_path)
    for name in ("run.toml", "metrics.json", "history.jsonl", "needs.json", "pictures/test", "pictures/relight"):
        assert f"{name} is not there" in page.text
    assert not page.images and "svg" not in page.tags


def test_broken_parts_are_left_out(run):
    (run / "metrics.json").write_text('{"psnr": 2')
    (run / "needs.json").write_text('{"not": "a list"}')
    (run / "run.toml").write_text("= nonsense")
    with open(run / "history.jsonl", "a") as file:
        file.write('\n[1]\n{"seconds": null, "loss": 1}\n{"seconds": 9, "loss": NaN}\n{"seconds": 10, "lo')
    for path in run.glob("pictures/test/photo/*.png"):
        path.write_bytes(path.read_bytes()[:30])
    page = reported(run)
    assert "metrics.json cannot be read" in page.text
    assert "history.jsonl has damaged lines, which are left out: 2" in page.text
    assert "svg" in page.tags and "photo" not in dict(page.images) and "rendered" in dict(page.images)


def test_figures_that_are_no_numbers_are_left_out(tmp_path):
    (tmp_path / "metrics.json").write_text('{"psnr": NaN, "lpips": null, "views": 8, "split": "test", "flag": true}')
    text = reported(tmp_path).text
    assert "views 8" in text and "PSNR" not in text and "nan" not in text and "flag" not in text


def test_values_that_no_release_wrote_are_shown_or_left_out(run):
    (run / "metrics.json").write_text(json.dumps({"psnr": 10**400, "views": 8, "split": "\ud800"}))
    (run / "run.toml").write_text('[run]\ncapture = "/a/urn"\n[settings]\nx = 3\n')
    (run / "history.jsonl").write_text(
        "".join(f'{{"iteration": [], "seconds": {s}, "psnr_test": {-s}e307}}\n' for s in range(1, 9))
    )
    page = reported(run)
    assert "views 8" in page.text and "PSNR" not in page.text
    assert "run.toml cannot be read" in page.text and "settings.x should be" in page.text


def test_pictures_of_other_folders_are_not_shown(run):
    picture(run.parent / "private.png", 33)
    shown = {kind: "../private.png" for kind in ("on", "off", "photo")} | {"view": "a", "psnr_on": 1, "psnr_off": 2}
    row = {"need": "specular", "what": "specular shading", "why": "it shines", "pictures": shown}
    (run / "needs.json").write_text(json.dumps([row]))
    page = reported(run)
    assert "specular shading" in page.text and not any("with" in caption for caption, _ in page.images)


def test_large_pictures_are_made_smaller(tmp_path):
    picture(tmp_path / "pictures/test/photo/a.png", 90, side=1600)
    assert pixels(dict(reported(tmp_path).images)["photo"]).shape == (512, 512, 3)


def test_a_folder_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(InputError, match="is not a folder"):
        write_report([tmp_path / "nowhere"], tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()


def test_decisions_are_shown_with_pictures(tmp_path):
    folder = tmp_path / "run"
    for kind, value in (("on", 0), ("off", 100), ("photo", 200)):
        write(folder / "needs" / f"specular_{kind}.png", np.full((8, 8, 3), value, np.uint8))
    shown = {kind: f"needs/specular_{kind}.png" for kind in ("on", "off", "photo")}
    shown |= {"view": "0003", "psnr_on": 31.24, "psnr_off": 28.1}
    row = {"need": "specular", "what": "specular shading", "why": "it shines", "needed": True}
    broken = row | {"what": "something else", "pictures": {"on": "needs/gone.png"}}
    (folder / "needs.json").write_text(json.dumps([row | {"pictures": shown}, broken]))
    write_report([folder], tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text()
    assert "<h3>specular shading: kept</h3>" in html and "<h3>something else" not in html
    assert "with 31.2 dB, without 28.1 dB, of photo 0003" in html
    for kind in ("on", "off", "photo"):
        data = base64.b64encode((folder / "needs" / f"specular_{kind}.png").read_bytes()).decode()
        assert data in html


@pytest.mark.parametrize("name", ["$5 to $7 {", "two\nlines"])
def test_a_run_whose_name_is_no_formula(run, name):
    """Check that a report is written of a run whose folder's name has two dollar signs, which matplotlib would read as a formula."""
    renamed = run.rename(run.parent / name)
    shown = name.replace("\n", "\\n")
    assert f"vases/{shown}" in reported(renamed).text
