"""Error against run time: each curve, small. Finer settings err less, by the order that theory has where it has one."""

import numpy as np
import pytest

from benchmarks.approximations import Row, directions, prefiltering, raster, rays, shading, surfaces, textures, timed
from benchmarks.approximations.chart import draw, write_table


def curve(rows, method: str = "") -> dict:
    """Errors by setting, which no one has yet."""
    rows = [row for row in rows if row.method == method]
    assert all(row.milliseconds > 0 or np.isnan(row.milliseconds) for row in rows)
    return {row.setting: row.error for row in rows}


def order(errors: dict) -> float:
    """By which power of the setting the error falls, from the first to the last."""
    settings, values = list(errors), list(errors.values())
    return float(-np.log(values[-1] / values[0]) / np.log(settings[-1] / settings[0]))


def test_monte_carlo_falls_with_the_root_of_its_samples_and_the_split_sum_is_the_cheaper():
    rows = [r for r in shading.split_sum((48, 768), 60_000, 3000, 512) if r.approximation.endswith("gradient")]
    assert 0.35 < order(curve(rows, "Monte Carlo")) < 0.65
    split, fine = rows[0], rows[-1]
    assert split.default and split.error < fine.error and split.milliseconds < fine.milliseconds
    assert all(row.uncertainty < 0.3 * split.error for row in rows)


def test_rays_of_a_lobe():
    rows = list(rays.mirror_rays((1, 16), points=512, truth=1024, roughnesses=(0.3,)))
    assert 0.3 < order(curve(rows, "Monte Carlo")) < 0.8  # in strata of one variable: between 1/2 and 1
    one, *_, of_lobe, _, _ = rows
    assert of_lobe.setting == 16 and of_lobe.error < one.error
    assert all(row.uncertainty < 0.3 * row.error for row in rows)


def test_the_prefilter():
    least = curve(prefiltering.cut_off((1e-2, 1e-3, 1e-4), resolution=32, rows=8))
    assert least[1e-3] < least[1e-2] / 5 and least[1e-4] < least[1e-3]
    levels = curve(prefiltering.levels((3, 7), resolution=64, count=60))
    assert levels[7] < levels[3] / 2
    sides = curve(prefiltering.sides((0.25, 1), resolution=64, count=60))
    assert sides[1] < sides[0.25] / 2
    parts = curve(prefiltering.cells((16, 256), resolution=32, rows=8))
    assert parts[256] < parts[16] / 2


def test_texels_are_of_second_order_where_they_resolve_the_light(monkeypatch):
    monkeypatch.setattr(prefiltering, "room", lambda d: 1 + np.exp(30 * (d[:, 2] - 1)))
    prefiltering.directly.cache_clear()
    errors = [prefiltering.looked_up(side, 100, 0.02) for side in (16, 32, 64)]
    prefiltering.directly.cache_clear()
    assert errors[1] < errors[0] / 3 and errors[2] < errors[1] / 3


def test_harmonics():
    rows = list(directions.degrees((0, 1, 2, 3, 4), count=200, points=8, splats=200, roughnesses=(0.7,)))
    for method in dict.fromkeys(row.method for row in rows):
        errors = list(curve(rows, method).values())
        assert errors[3] < errors[2] < errors[1] < errors[0]
    assert sum(row.default for row in rows) == 2 and all(
        np.isnan(row.milliseconds) == (row.setting == 4) for row in rows
    )


def test_cut_offs_of_the_rasteriser():
    """Each with another one compiled in beside today's."""
    disc = curve(raster.footprint((1 / 16, 1 / 255), splats=300, side=32))
    assert disc[255] < disc[16] / 8  # what is cut off is as the cut-off
    through = curve(raster.transmittance((0.3, 1e-4), splats=300, side=32))
    assert through[10_000] < through[3] / 50
    filtered = list(raster.low_pass((0.5, 2.0), sizes=(1.0,), splats=200, side=24, fine=3))
    assert filtered[1].error < filtered[0].error  # two pixels wide, it blurs


def test_precision():
    for what in ("ball", "from the edge"):
        rows = [row for row in raster.precision(300, 32, (32.0,)) if row.method.endswith(what)]
        kernels, single, double = rows
        assert kernels.default and 0 < kernels.error < 1e-6 and 0 < single.error < 1e-4 and double.error == 0
        assert kernels.milliseconds < single.milliseconds


def test_voxels():
    """Of second order on what is smooth."""
    rows = list(surfaces.voxels((32, 64), views=16, pixels=128))
    assert order(curve(rows, "torus")) > 1.5 and order(curve(rows, "box")) > 0.8


def test_textures():
    rows = list(textures.sizes((64, 128, 256), splats=2000, level=3, points=2000))
    found = curve(rows, "from the splats")
    assert found[256] < found[128] < found[64]
    painted = curve(rows, "from the paint")
    assert all(painted[size] > found[size] for size in found)


def test_samples_of_a_preview():
    pytest.importorskip("bpy")
    from benchmarks.approximations import previews

    rows = list(previews.samples((1, 16), truth=64, splats=200, size=32))
    assert 0.3 < order(curve(rows)) < 1.2
    assert rows[1].uncertainty < rows[1].error


def test_a_chart_and_a_table(tmp_path):
    rows = [Row("one", "", n, 1 / n, "error", 2.0 * n, n == 2) for n in (1, 2, 4)]
    rows.append(Row("two", "words", "exact", 0.0, "error", timed(sum, [1])[1], False))
    draw(rows, tmp_path / "a.png")
    write_table(rows, tmp_path / "a.csv")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert (
        lines[0].startswith("approximation,method,setting")
        and lines[2] == "one,,2,0.5,error,4,True,0"
        and len(lines) == 5
    )
