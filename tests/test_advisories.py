"""Test scripts/check_advisories.py: it finds pins with a known fault, and none in pyproject.toml."""

import tomllib

import pytest

from refgs.paths import ROOT
from scripts.check_advisories import faults, pins

ADVISORIES = tomllib.loads((ROOT / "scripts" / "advisories.toml").read_text(encoding="utf-8"))


def test_no_pin_of_ours_has_a_known_fault():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found = [*pins(project)]
    assert ("opencv-python-headless", "4.14.0.94") in found and ("ray", "2.60.0") in found  # of one Python, of an extra
    assert faults(found, ADVISORIES["advisory"]) == []


def test_a_pin_with_a_known_fault_is_named():
    (line,) = faults([("pillow", "12.2.0"), ("openexr", "3.5.3")], ADVISORIES["advisory"])
    assert line.startswith("pillow 12.2.0: ") and "CVE-2026-55379" in line and line.endswith("Take 12.3.0 or newer.")


def test_an_accepted_release_is_accepted_alone():
    found = [
        faults([("opencv-python-headless", release)], ADVISORIES["advisory"]) for release in ("4.10.0.84", "4.11.0.86")
    ]
    assert "CVE-2025-53644" in found[0][0] and found[1] == []


@pytest.mark.parametrize("one", ADVISORIES["advisory"], ids=lambda one: f"{one['package']} {one['affected']}")
def test_every_advisory_says_all_that_is_needed(one):
    assert {"package", "affected", "fixed", "ids", "what"} <= one.keys()
    assert faults([(one["package"], one["fixed"])], [one]) == []
    assert ("accepted" in one) == ("why" in one)
