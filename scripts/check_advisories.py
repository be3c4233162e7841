"""Fail if a package that pyproject.toml pins, or one that is installed with it, has a known fault.

    python scripts/check_advisories.py

The faults are in `scripts/advisories.toml`, with the date of the last search. A release that is used in spite of a fault is listed there
as accepted, with the reason why the fault does no harm here.
"""

import sys
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]


def pins(project: dict) -> Iterator[tuple[str, str]]:
    """Yield name and version of each package that a pyproject.toml pins, also of those for one platform or Python only."""
    extras = project["project"].get("optional-dependencies", {}).values()
    lists = [project["build-system"]["requires"], project["project"]["dependencies"], *extras]
    for requirement in (Requirement(line) for lines in lists for line in lines):
        for specifier in requirement.specifier:
            yield canonicalize_name(requirement.name), specifier.version


def installed(names: set[str]) -> Iterator[tuple[str, str]]:
    """Yield name and version of each of these packages that is installed."""
    for name in sorted(names):
        with suppress(PackageNotFoundError):
            yield name, version(name)


def faults(packages: list[tuple[str, str]], advisories: list[dict]) -> list[str]:
    """Return a line for each of these packages, given by name and version, and each advisory about it."""
    found = {}
    for name, release in packages:
        for one in advisories:
            bad = one["package"] == name and SpecifierSet(one["affected"]).contains(release, prereleases=True)
            if bad and release not in one.get("accepted", ()):
                ids = ", ".join(one["ids"])
                found[f"{name} {release}: {one['what']} ({ids}). Take {one['fixed']} or newer."] = None
    return [*found]


def main() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    advisories = tomllib.loads((ROOT / "scripts" / "advisories.toml").read_text(encoding="utf-8"))["advisory"]
    found = faults([*pins(project), *installed({one["package"] for one in advisories})], advisories)
    for line in found:
        print(line)
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
