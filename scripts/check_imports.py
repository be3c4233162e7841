"""Check that modules of the trainer and of the extensions import only what they may.

The trainer's packages are ordered in layers, called floors. A module imports only from its own floor and from those below. There are no
import cycles. The trainer never imports bpy. The extensions never import torch. The extension RefGS imports nothing of the trainer's
extension. Only tests and benchmarks import the float64 reference.

    python scripts/check_imports.py [FOLDER]      # this repository, or a folder that is laid out like it

Imports at the top, inside functions and under TYPE_CHECKING all count. Print a line for each import that breaks a rule; exit with status 1
if there is one.
"""

import ast
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

# The trainer's floors, the lowest first. A module may import its own floor and those below. CONTRIBUTING.md describes each floor.
FLOORS = (
    (
        "",
        "asked",
        "camera",
        "clock",
        "color",
        "effective",
        "errors",
        "events",
        "memory",
        "paths",
        "process",
        "settings",
        "spread",
    ),
    ("formats",),
    ("kernels",),
    ("model",),
    ("geometry",),
    ("render",),
    ("capture",),
    ("lock", "run", "run_folder"),
    ("compare",),
    ("train",),
    ("export",),
    ("report",),
    ("batch",),
    ("cli", "commands", "demo", "train_job", "worker"),
)
# The same inside the package `train`, whose rooms stand on floors of their own.
ROOMS = (
    ("", "photo", "plan", "start"),
    ("state",),
    ("part", "timeline"),
    ("learn",),
    ("probe",),
    ("material",),
    ("decide",),
    ("keep",),
    ("setup",),
    ("trainer",),
    ("fit", "hints"),
)
ORACLE = "refgs.render.reference"  # float64, for tests and benchmarks, which compare the kernels with it
TRAINER = "refgs_addon.trainer"  # the trainer's extension has it; without that, the add-on runs all the same
FORBIDDEN = {
    "backend": ("bpy", "refgs_addon", "refgs_trainer"),
    "refgs_addon": ("torch", "refgs", "refgs_trainer"),
    "refgs_trainer": ("torch", "refgs", "refgs_addon"),
}


class Import(NamedTuple):
    """Hold one import: the module `source` imports the module `target`. `place` is the file and the line."""

    source: str
    target: str
    place: str


def modules(root: Path, package: str) -> dict[str, Path]:
    """Map the names of a package's modules to their files. The package's folder lies in `root`."""
    files = sorted((root / package).rglob("*.py"))
    return {".".join(f.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): f for f in files}


def imports(files: dict[str, Path], root: Path) -> Iterator[Import]:
    """Find all imports in `files`, which maps module names to paths.

    `from package import name` imports the module `package.name` if `files` has it, otherwise the module `package`.
    """
    for source, file in files.items():
        package = source if file.name == "__init__.py" else source.rpartition(".")[0]
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
                base = ".".join([*above, *filter(None, [node.module])])
                targets = [name if (name := f"{base}.{alias.name}") in files else base for alias in node.names]
            else:
                continue
            for target in dict.fromkeys(targets):
                yield Import(source, target, f"{file.relative_to(root).as_posix()}:{node.lineno}")


def circles(all_imports: list[Import]) -> Iterator[list[Import]]:
    """Find import cycles. Yields each cycle as a list of its imports.

    After each cycle, the search starts again and ignores the last import of that cycle.
    """
    places = {(i.source, i.target): i for i in all_imports if i.source != i.target}
    while True:
        graph: dict[str, list[str]] = {}
        for source, target in places:
            graph.setdefault(source, []).append(target)
        try:
            TopologicalSorter(graph).prepare()
            return
        except CycleError as error:
            way = error.args[1][::-1]  # graphlib lists a circle from imported to importing module
            circle = [places[pair] for pair in pairwise(way)]
            yield circle
            del places[circle[-1].source, circle[-1].target]


def floor(module: str) -> float | None:
    """Return the floor (layer) of a module of `refgs`; 0 is the lowest. Returns None if neither FLOORS nor ROOMS lists the module.

    Rooms of `train` are between its floor and the next.
    """
    parts = [*module.split("."), "", ""]
    height = next((height for height, names in enumerate(FLOORS) if parts[1] in names), None)
    if parts[1] != "train" or height is None:
        return height
    room = next((room for room, names in enumerate(ROOMS) if parts[2] in names), None)
    return None if room is None else height + room / len(ROOMS)


def check(root: Path) -> list[str]:
    """Check all imports of the repository in `root`. Returns a message for each broken rule."""
    wrong = []
    for half, folder, package in (
        ("backend", root / "backend", "refgs"),
        ("refgs_addon", root, "refgs_addon"),
        ("refgs_trainer", root, "refgs_trainer"),
    ):
        files = modules(folder, package)
        found = list(imports(files, root))
        for source, target, place in found:
            if (name := target.split(".")[0]) in FORBIDDEN[half]:
                wrong.append(f"{place}: {source} imports {target}: nothing under {half}/ imports {name}")
        inside = [i for i in found if i.target in files]
        for source, target, place in inside:
            if f"{target}.".startswith(f"{TRAINER}.") and not f"{source}.".startswith(f"{TRAINER}."):
                wrong.append(f"{place}: {source} imports {target}: only modules of {TRAINER} do")
        if package == "refgs":
            lost = [name for name in files if floor(name) is None]
            wrong += [
                f"{files[name].relative_to(root).as_posix()}: {name} has no floor in FLOORS or ROOMS" for name in lost
            ]
            wrong += [
                f"{place}: {source} imports {ORACLE}: only tests and benchmarks do"
                for source, target, place in inside
                if target == ORACLE
            ]
            for source, target, place in inside:
                if None not in (low := floor(source), high := floor(target)) and low < high:
                    wrong.append(f"{place}: {source} imports {target}, which is on a floor above its own")
        for circle in circles(inside):
            steps = [f"{place} {source} -> {target}" for source, target, place in circle]
            wrong.append("\n  ".join(["these import each other in a circle:", *steps]))
    return wrong


def main() -> None:
    root = Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else Path(__file__).resolve().parents[1]
    wrong = check(root)
    print(*wrong, sep="\n", end="\n" if wrong else "")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
