"""Render a capture with ground truth: `python -m benchmarks.scenes NAME --out DIR`. `all` renders each scene into DIR/NAME."""

from functools import partial

from benchmarks.scenes import NAMES, build
from scripts.demo.photograph import main

if __name__ == "__main__":
    main("benchmarks.scenes", {name: partial(build, name) for name in NAMES})
