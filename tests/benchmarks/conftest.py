"""Provide a fixture for tests of the benchmarks' scenes."""

from pathlib import Path

import pytest

from benchmarks.scenes.solids import sculpt

ROOT = Path(__file__).parents[2]


@pytest.fixture(params=["coarse", pytest.param("as they are", marks=pytest.mark.slow)])
def cells(request, monkeypatch):
    """Let scenes sculpt coarse meshes, whose cells are twice as large. The slow tests sculpt them as they are."""

    def coarse(solid, low, high, cell, material):
        return sculpt(solid, low, high, 2 * cell, material)

    for file in (ROOT / "benchmarks/scenes").glob("*.py"):
        if request.param == "coarse" and file.stem not in ("solids", "__main__") and " sculpt" in file.read_text():
            monkeypatch.setattr(f"benchmarks.scenes.{file.stem}.sculpt", coarse, raising=False)
