"""Run the stability cases and print a Markdown table row by row; exit with status 1 if a case fails."""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import argparse
import importlib
import sys
import time

from benchmarks.stability.cases import HEADINGS, line

GROUPS = {
    "geometry": "Geometry, through the rasteriser",
    "material": "Light and material, through every other kernel",
    "photos": "Captures, through a training",
    "optimisation": "Optimisation",
    "stiffness": "Stiffness",
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="refgs stability")
    parser.add_argument("--only", default="", help="cases whose name holds this word, or those of a group")
    only, failed, begun = parser.parse_args().only, [], time.perf_counter()
    for module, title in GROUPS.items():
        group = importlib.import_module(f"benchmarks.stability.{module}")
        chosen = [case for case in group.CASES if only in case.name or only == module]
        if not chosen:
            continue
        _begin(title, HEADINGS)
        for case in chosen:
            found = case.run()
            failed += [] if case.holds(found) else [case.name]
            print(line(case.row(found)), flush=True)
        for title, headings, rows in getattr(group, "tables", list)():
            _begin(title, headings)
            for row in rows:
                print(line(row))
    print(f"\n{time.perf_counter() - begun:.0f} s.", *[f"{len(failed)} fail: {'; '.join(failed)}"] * bool(failed))
    if failed:
        sys.exit(1)


def _begin(title: str, headings: list[str]) -> None:
    print(f"\n## {title}\n\n{line(headings)}\n{line(['---'] * len(headings))}", flush=True)


if __name__ == "__main__":
    main()
