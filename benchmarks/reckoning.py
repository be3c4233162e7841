"""Fit the weights by which metal is told from paint: `python -m benchmarks.reckoning CAPTURE... --show CAPTURE... --out DIR`.

Each capture is a folder of `benchmarks.scenes` under the scene's name, so that its materials are known, or one that is named by `--metal`
or `--paint`: all of it is that. A training of each stops after two thirds. At a tenth, a third, and then, the terms of
`refgs.train.material.reckoning` are written to DIR. Captures that DIR holds are not trained again.

A logistic regression on the captures before `--show` gives the weights, drawn to those in use, which were fitted to other captures. The
table says how they do on all captures: which part of the surface is wrong, in doubt, and right where it is not in doubt.
"""

import argparse
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.scenes import NAMES, build
from refgs.asked import Asked
from refgs.capture import read_files, to_run_frame
from refgs.effective import Effective
from refgs.train.material import questions, reckoning, same_material
from refgs.train.state import State
from refgs.train.trainer import Trainer

TOTAL, TIMES = 1500, (150, 500, 1000)
SAMPLES = 1500  # surfels of each capture at each time, drawn by their pixels
PRIOR = 3e-3  # weight of the weights in use

MetalAt = Callable[[np.ndarray], Tensor]
"""From points (N, 3), in the capture's frame, to whether each is metal (N,)."""


class Row(NamedTuple):
    """Hold spread terms (N, 1 + K), the first of them 1, whether each surfel is metal (N,), and its pixels (N,)."""

    terms: Tensor
    metal: Tensor
    pixels: Tensor


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reckoning", description=__doc__)
    parser.add_argument("fit", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--show", nargs="*", type=Path, default=[], metavar="CAPTURE")
    parser.add_argument("--metal", nargs="*", default=[], metavar="NAME", help="captures that are all metal")
    parser.add_argument("--paint", nargs="*", default=[], metavar="NAME", help="captures that are all paint")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    kinds = dict.fromkeys(options.metal, True) | dict.fromkeys(options.paint, False)
    rows = {}
    for capture in (*options.fit, *options.show):
        file = options.out / f"{capture.name}.pt"
        if not file.exists():
            torch.save([tuple(row) for row in observed(capture, kinds.get(capture.name), options.out)], file)
        rows[capture.name] = [Row(*each) for each in torch.load(file)]
    weights = fitted([rows[capture.name] for capture in options.fit])
    for name, weight in zip(("bias", *reckoning.WEIGHTS), weights.tolist(), strict=True):
        print(f"{name}: {weight:.2f}")
    for capture in (*options.fit, *options.show):
        cells = " | ".join(line(row, weights) for row in rows[capture.name])
        print(f"{'shown' if capture in options.show else 'fitted'} {capture.name}: {cells}")


def observed(capture: Path, kind: bool | None, out: Path) -> Iterable[Row]:
    """Train on a capture, and yield a row at each of TIMES. `kind` tells whether all of it is metal; None: the scene's materials tell."""
    asked = Asked(capture=capture, out=out / capture.name, preset="quick", changes=(f"train.iterations={TOTAL}",))
    settings = asked.settings()
    frame = to_run_frame(read_files(capture), settings.region)
    trainer = Trainer(frame, Effective.of(settings), out / capture.name, lambda event, facts: None, None)
    state, metal_at = trainer.state, true_metal(capture.name) if kind is None else partial(all_of, kind)
    while state.iteration < max(TIMES):
        trainer.iterate()
        if state.iteration in TIMES:
            yield row(state, metal_at, np.asarray(frame.to_capture))


def row(state: State, metal_at: MetalAt, to_capture: np.ndarray) -> Row:
    found = reckoning.reckon(state)
    values = torch.ones(len(found.pixels)), *(found.terms[name] for name in reckoning.WEIGHTS)
    spread = [same_material.spread(found.graph, each, found.known.float()) for each in values]
    points = found.surfels.positions.double().numpy()
    points = (np.c_[points, np.ones(len(points))] @ to_capture.T)[:, :3]
    return Row(torch.stack(spread, dim=1), metal_at(points), found.pixels)


def all_of(kind: bool, points: np.ndarray) -> Tensor:
    return torch.full((len(points),), kind)


def true_metal(name: str) -> MetalAt:
    """Return a function that tells which points are next to metal in a scene of `benchmarks.scenes`."""
    if name not in NAMES:
        raise SystemExit(
            f"{name}: no scene of benchmarks.scenes; name it after --metal or --paint if all of it is that"
        )
    scene = build(name)
    triangles = cKDTree(scene.mesh.vertices[scene.mesh.triangles].mean(axis=1))
    metal = torch.tensor([material.metallic == 1.0 for material in scene.materials])[scene.mesh.material]
    return lambda points: metal[triangles.query(points)[1]]


def fitted(captures: list[list[Row]]) -> Tensor:
    """Fit a logistic regression by Newton's method. Each capture counts the same. Returns the bias and the weights (1 + K,).

    Weights are drawn to those in use in proportion to the standard deviation of their terms.
    """
    generator, parts = torch.Generator().manual_seed(0), []
    for rows in captures:
        for each in rows:
            drawn = torch.multinomial(each.pixels, SAMPLES, True, generator=generator)
            parts.append(
                (each.terms[drawn].double(), each.metal[drawn].double(), torch.full((SAMPLES,), 1 / len(rows)))
            )
    terms, metal, weight = (torch.cat(each) for each in zip(*parts, strict=True))
    scale, weight = terms.std(dim=0).clamp_min(1e-6), weight.double() / weight.sum()
    scale[0] = 1
    columns, prior = terms / scale, PRIOR * torch.eye(terms.shape[1]).double()
    prior[0, 0] *= 0.1  # the odds before any test depend the most on the captures
    found = used = torch.tensor([reckoning.BIAS, *reckoning.WEIGHTS.values()]).double() * scale
    for _ in range(50):
        likely = torch.sigmoid(columns @ found)
        slope = columns.T @ (weight * (likely - metal)) + prior @ (found - used)
        curvature = (columns.T * (weight * likely * (1 - likely))) @ columns + prior
        found = found - torch.linalg.solve(curvature, slope)
    return (found / scale).float()


def line(row: Row, weights: Tensor) -> str:
    likely = torch.sigmoid(row.terms @ weights)
    right, sure = (likely > 0.5) == row.metal, (2 * likely - 1).abs() > questions.DOUBTFUL
    part = row.pixels / row.pixels.sum()
    among = float((part * sure * right).sum() / (part * sure).sum().clamp_min(1e-9))
    return f"wrong {float((part * ~right).sum()):.1%}, doubt {float((part * ~sure).sum()):.1%}, else right {among:.1%}"


if __name__ == "__main__":
    main()
