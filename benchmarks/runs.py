"""Runs that a benchmark trains and evaluates: one that is finished is not done again, one that was interrupted goes on."""

import json
import signal
import subprocess
import sys
from pathlib import Path

from rich.console import Console

console = Console(soft_wrap=True, width=None if sys.stdout.isatty() else 200)  # into a file tables come whole


def call(*arguments: object) -> int:
    """Run a command of refgs in a process of its own, which gives all memory back; its exit status."""
    process = subprocess.Popen([sys.executable, "-m", "refgs.cli", *map(str, arguments)])
    try:
        status = process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        process.wait()  # a training writes a checkpoint first
        raise
    if status == 130:
        raise KeyboardInterrupt
    return status


def measure(
    capture: Path, run: Path, words: list[object], minutes: float | None = None, truth: Path | None = None
) -> bool:
    """Train as the `words` say, and evaluate, what of it is not done yet; whether that succeeded."""
    if figures(run) is not None:
        return True
    if not (run / "splats.ply").exists():
        console.rule(str(run))
        begun = ["--resume"] if (run / "run.toml").exists() else words
        limit = [] if minutes is None else ["--minutes", minutes]
        if call("train", capture, "--out", run, *begun, *limit) != 0:
            return False
    return call("evaluate", run, *([] if truth is None else ["--ground-truth", truth])) == 0


def figures(run: Path) -> dict | None:
    """What a finished run was measured to be; None if it is not finished."""
    try:
        found = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if "psnr" in found and found.get("split") == "test" else None


def say_failed(failed: list[Path]) -> None:
    """End a benchmark that could not do all of its runs with status 1."""
    if failed:
        console.print(f"not measured, see above: {', '.join(map(str, failed))}")
        raise SystemExit(1)


def mean(values: list[float | None]) -> float | None:
    """None unless all are known: a mean over other scenes than those beside it would mislead."""
    return None if None in values or not values else sum(values) / len(values)


def text(value: float | None, form: str) -> str:
    """A cell of a table."""
    return "–" if value is None else format(value, form)
