"""Share code between the benchmarks: train on scenes, collect measured values as rows, and print tables of the rows.

A finished run is not trained again. docs/measurements.csv keeps the values of earlier measurements: tables show them in brackets beside the
new values. `--csv FILE` writes the new rows into a file. `refgs bench page` makes docs/measurements.md from docs/measurements.csv.
"""

import argparse
import csv
import json
import platform
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from datetime import date
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table as Printed

from benchmarks.scenes import NAMES
from refgs import CORES
from refgs.capture import find_layout
from refgs.errors import InputError
from refgs.kernels.load import supported
from refgs.paths import clone_root, whole
from refgs.settings import load_settings

KEPT = clone_root() / "docs" / "measurements.csv"
WIDTH = None if sys.stdout.isatty() else 200  # files get whole tables
console = Console(soft_wrap=True, markup=False, emoji=False, width=WIDTH)


class Row(NamedTuple):
    """Hold one measured value, which is one row of the CSV.

    `figure` is the name of the measured quantity, such as "psnr". `value` is a number, or a word such as the name of a preset.
    """

    benchmark: str
    scene: str
    variant: str
    figure: str
    value: float | str
    unit: str
    machine: str
    date: str
    commit: str


class Column(NamedTuple):
    """Describe a column of a table. It shows the measured quantity `figure` under a `heading`, with its numbers formatted by `form`.

    If `variant` is given, all values in the column are of that variant. If not, each value is of the variant that its line is about.
    """

    heading: str
    figure: str
    form: str = ".1f"
    variant: str | None = None


class Table(NamedTuple):
    """Describe a table. It has one line for each scene. If `variant` is not empty, it has one line for each pair of scene and variant.

    `line` is the heading of the column of scenes, and `variant` that of the column of variants. `mean` has names of scenes. If the table
    has more than one line of these scenes, the means of these lines follow as the last line.
    """

    title: str
    benchmark: str
    columns: tuple[Column, ...]
    line: str = "scene"
    variant: str = ""  # heading of the column of variants; empty if there is one line for each scene
    mean: tuple[str, ...] = ()

    def lines(self, rows: Sequence[Row], kept: Sequence[Row] = ()) -> list[list[str]]:
        """Return the table as a list of lines, each a list of cells. The first line has the headings.

        `kept` are rows of earlier measurements, whose values are shown in brackets. Lines and columns without values are left out.
        """
        found, before = ({r[1:4]: r.value for r in some if r.benchmark == self.benchmark} for some in (rows, kept))
        lines = dict.fromkeys(
            (r.scene, r.variant if self.variant else "") for r in rows if r.benchmark == self.benchmark
        )
        columns = [c for c in self.columns if any(self._key(line, c) in found for line in lines)]
        result, counted = [[self.line, *([self.variant] if self.variant else []), *(c.heading for c in columns)]], []
        for line in lines:
            cells = [(found.get(key), before.get(key)) for key in (self._key(line, c) for c in columns)]
            if any(value is not None for value, _ in cells):
                shown = [_cell(*cell, c.form) for cell, c in zip(cells, columns, strict=True)]
                result.append([line[0], *([line[1]] if self.variant else []), *shown])
                counted += [[value for value, _ in cells]] if line[0] in self.mean else []
        if len(counted) > 1:
            means = map(mean, zip(*counted, strict=True))
            result.append(["mean", *(_cell(value, None, c.form) for value, c in zip(means, columns, strict=True))])
        return result

    def _key(self, line: tuple[str, str], column: Column) -> tuple[str, str, str]:
        return line[0], line[1] if column.variant is None else column.variant, column.figure


def _cell(value: float | str | None, kept: float | str | None, form: str) -> str:
    if value is None:
        return "–"
    now, *before = [v if isinstance(v, str) else format(v, form) for v in (value, kept) if v is not None]
    return f"{now} ({before[0]})" if before else now


def markdown_table(lines: Sequence[Sequence[str]]) -> str:
    """Make a Markdown table of the lines that `Table.lines` returns."""
    headings, *others = lines
    return "\n".join(f"| {' | '.join(line)} |" for line in (headings, ["---"] * len(headings), *others))


def mean(values: Sequence[float | str | None]) -> float | None:
    """Average the values. Return None if a value is missing or is a word.

    A mean without the missing value would not be comparable with the means of other columns.
    """
    return sum(values) / len(values) if values and all(isinstance(v, float | int) for v in values) else None


class Variant(NamedTuple):
    """Describe one of the ways to train that a benchmark compares: the options of `refgs train`, and a time limit.

    `minutes` is a number, the name of another variant, or None for no limit. With a name, a training may take as long as the training of
    that variant took on the same scene.
    """

    options: tuple[object, ...]
    minutes: float | str | None = None


class Bench:
    """Hold a benchmark while it runs: its command-line options, the rows measured so far, and the runs that failed."""

    def __init__(self, name: str, parser: argparse.ArgumentParser, arguments: Sequence[str] | None):
        parser.prog = f"refgs bench {name}"
        parser.add_argument("--csv", type=Path, metavar="FILE", help="write the figures into this file, too")
        self.name, self.options = name, parser.parse_args(arguments)
        self.rows: list[Row] = []
        self.failed: list[Path] = []
        self.where = this_machine(), date.today().isoformat(), commit()

    def record(self, scene: str, variant: str, unit: str, **figures: float | str | None) -> None:
        """Add measured values of a scene and variant to the rows. Values that are None are skipped."""
        for figure, value in figures.items():
            if value is not None:
                self.rows.append(Row(self.name, scene, variant, figure, value, unit, *self.where))

    def runs(
        self, variants: dict[str, Variant], captures: list[Path] | None = None
    ) -> Iterator[tuple[str, dict[str, Path]]]:
        """Train and evaluate the variants on each scene. A run's folder is OUT/[PRESET/]VARIANT/SCENE.

        The scenes are those in the folder of the option `--scenes`, or `captures` if they are given.

        Yield for each scene its name, and a dict from the names of variants to the folders of the runs that succeeded.

        Raise InputError if `--variants` has an unknown name. If variant A may take as long as variant B, also raise it if `--variants`
        names A but not B.
        """
        options = self.options
        chosen = options.variants or list(variants)
        if unknown := [name for name in chosen if name not in variants]:
            raise InputError(f"--variants: no variant is called {', '.join(unknown)}: there are {', '.join(variants)}")
        for name in chosen:
            other = variants[name].minutes
            if isinstance(other, str) and other not in chosen:
                raise InputError(f"--variants: {name} is trained for as long as {other}: add {other}")
        preset = getattr(options, "preset", "")
        if preset:
            load_settings(preset)  # report a wrong preset before anything is trained
        out = (options.out or clone_root() / "demo" / self.name) / Path(preset).stem
        for capture in captures or find_scenes(options.scenes, options.only):
            done: dict[str, Path] = {}
            for name, (words, minutes) in variants.items():
                if name not in chosen:
                    continue
                if isinstance(minutes, str):
                    if minutes not in done:
                        continue
                    minutes = figures(done[minutes])["total_seconds"] / 60
                run = out / name.replace(" ", "_") / capture.name
                truth = capture / "ground_truth"
                if train(capture, run, words, minutes, truth if truth.is_dir() else None):
                    done[name] = run
                else:
                    self.failed.append(run)
            yield capture.name, done

    def finish(self, *tables: Table) -> None:
        """Print the tables and write the CSV; exit with status 1 if a run failed."""
        kept = read(KEPT) if KEPT.exists() else []
        for table in tables:
            headings, *lines = table.lines(self.rows, kept)
            machines = ", ".join(sorted({row.machine for row in kept if row.benchmark == self.name}))
            caption = f"in brackets: kept, of {machines}" if machines else None
            printed = Printed(title=table.title, caption=caption)
            for index, heading in enumerate(headings):
                printed.add_column(heading, justify="right" if index > bool(table.variant) else "left")
            for line in lines:
                printed.add_row(*line)
            if lines:
                console.print(printed)
        if self.options.csv:
            write(self.options.csv, self.rows)
        if self.failed:
            console.print(f"not measured, see above: {', '.join(map(str, self.failed))}")
            raise SystemExit(1)


def scene_options(parser: argparse.ArgumentParser, preset: str | None = None) -> argparse.ArgumentParser:
    """Add the command-line options that benchmarks on scenes with ground truth share.

    If `preset` is given, an option `--preset` is added, and `preset` is its default.
    """
    parser.add_argument("--scenes", type=Path, required=True, help="folder of captures by benchmarks.scenes")
    parser.add_argument("--out", type=Path, help="folder for the runs (default: demo/BENCHMARK)")
    parser.add_argument("--only", nargs="+", metavar="SCENE", help="measure these scenes")
    parser.add_argument("--variants", nargs="+", default=[], metavar="VARIANT", help="train only these variants")
    if preset:
        parser.add_argument("--preset", default=preset, help=f"a preset's name or a TOML file ({preset})")
    return parser


def find_scenes(folder: Path, only: list[str] | None = None) -> list[Path]:
    """Find the captures of test scenes in a folder. If `only` is given, return only captures with these names.

    Raise InputError if none is found.
    """
    found = [folder / name for name in NAMES if (folder / name / "ground_truth").is_dir()]
    if not found:
        raise InputError(f"{folder}: no scene is here: render them with python -m benchmarks.scenes all --out {folder}")
    chosen = [scene for scene in found if not only or scene.name in only]
    if not chosen:
        raise InputError(f"{folder} has none of {', '.join(only)}")
    return chosen


def find_captures(folder: Path, only: Sequence[str] = ()) -> list[Path]:
    """Find the captures with cameras in a folder: its subfolders. If `only` is given, return only captures with these names.

    Raise InputError if none is found.
    """
    found = (
        [path for path in sorted(folder.iterdir()) if path.is_dir() and find_layout(path)] if folder.is_dir() else []
    )
    chosen = [path for path in found if not only or path.name in only]
    if not chosen:
        raise InputError(
            f"{folder}: no capture with cameras is in this folder: name the folder that holds the captures"
        )
    return chosen


def call(*arguments: object) -> int:
    """Run a command of refgs in a new process, so that all its memory is freed; return the exit status."""
    process = subprocess.Popen([sys.executable, "-m", "refgs.cli", *map(str, arguments)])
    try:
        status = process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        process.wait()  # let an interrupted training write its checkpoint
        raise
    if status == 130:
        raise KeyboardInterrupt
    return status


def train(
    capture: Path, run: Path, options: Iterable[object], minutes: float | None = None, truth: Path | None = None
) -> bool:
    """Train and evaluate a run; return True if both succeed. An interrupted run is resumed, a finished run is kept as it is.

    `options` are options of `refgs train`, `minutes` is a time limit, and `truth` is the folder of ground truth for the evaluation.
    """
    if figures(run) is not None:
        return True
    if not (run / "splats.ply").exists():
        console.rule(str(run))
        begun = ["--resume"] if (run / "run.toml").exists() else options
        limit = [] if minutes is None else ["--minutes", minutes]
        if call("train", capture, "--out", run, *begun, *limit) != 0:
            return False
    return call("evaluate", run, *([] if truth is None else ["--ground-truth", truth])) == 0


def figures(run: Path) -> dict | None:
    """Read a run's metrics.json. Return None if the run has not been evaluated on held-out views yet."""
    try:
        found = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if "psnr" in found and found.get("split") == "test" else None


def relit(metrics: dict, name: str) -> float | None:
    """Average the metric `name` over all lights with which the evaluation relit a run.

    `metrics` is the run's metrics.json. Return None if there are no such lights, or if one of them lacks the metric.
    """
    return mean([light.get("refgs", {}).get(name) for light in metrics.get("relight", {}).values()])


def this_machine() -> str:
    """Describe the CPU of this machine: architecture, number of cores, and best instruction set."""
    return f"{platform.machine()}, {CORES} cores, {supported()[0]}"


def commit() -> str:
    """Return the git commit of this program."""
    command = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    done = subprocess.run(command, cwd=clone_root(), capture_output=True, text=True)
    return done.stdout.strip()


def read(path: Path) -> list[Row]:
    """Read all rows of a CSV file."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = [Row(**row) for row in csv.DictReader(file)]
    return [row._replace(value=_number(row.value)) for row in rows]


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write rows into a CSV file. They replace rows with the same benchmark, scene, variant and name of the measured value."""
    merged = {row[:4]: row for row in ([*read(path), *rows] if path.exists() else rows)}
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(Row._fields)
        for row in merged.values():
            table.writerow(f"{value:.6g}" if isinstance(value, float) else value for value in row)
