"""Simulate a batch on a farm, from measured costs, to see what saturates first: `refgs bench farm`.

Steps wait in one queue for a free place on a node. A step reads from the shared storage, computes, and writes to it; a training does so
once for each checkpoint. Storage and Ray's head serve one request after another. A node that dies loses what its steps have computed since
their last checkpoint. docs/batch.md says where the costs come from.
"""

import argparse
import heapq
import itertools
import random
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from benchmarks.harness import console, markdown_table

START, HEAD = 4.9, 0.05  # seconds: Ray's start, what the head does for a step
CROWDED = (
    405.4 / 374.6
)  # a step takes so much longer while others run on the same node: 24 captures by two workers, by one
LINK = 125e6  # bytes a second of a node's network: 1 Gbit/s
NOTICE, REPAIR = 30.0, 600.0  # seconds until Ray notices that a node has died, and until the node is back
MB, HOUR = 1e6, 3600.0


class Costs(NamedTuple):
    """Hold what the steps of a capture cost: seconds of one core, and bytes read and written. A training's seconds are one of `train`."""

    masks: float
    train: tuple[float, ...]
    evaluate: float
    export: float
    photos: float
    checkpoint: float  # bytes of one
    checkpoints: int
    asset: float
    mesh: float


# 24 captures of 28 photos of 64 pixels, `quick` with 800 surfels and 300 iterations.
TRAIN = (6.11, 5.61, 6.21, 6.02, 6.02, 5.81, 5.91, 6.21, 6.11, 6.01, 5.51, 5.51)
TRAIN += (5.81, 5.82, 5.61, 5.91, 5.51, 5.92, 5.71, 5.71, 5.81, 5.81, 5.51, 5.81)
SMALL = Costs(0.70, TRAIN, 2.68, 6.39, 0.1 * MB, 0, 1, 2.9 * MB, 20.6 * MB)
# Four scenes of 256 pixels by `standard` without a card: processor seconds, as the machine was busy.
STANDARD = Costs(0.70, (491, 523, 462, 451), 6.3, 37.4, 3.7 * MB, 64 * MB, 6, 34 * MB, 71 * MB)


class Farm(NamedTuple):
    """Describe a farm. `storage` is in bytes a second, `dies` the mean seconds from a node's start to its death.

    One capture in `slow` takes ten times as long to train. Zero means never, and that storage and network take no time.
    """

    nodes: int
    places: int  # steps at once on a node
    storage: float = 0.0
    dies: float = 0.0
    slow: int = 0


@dataclass(eq=False)
class Step:
    """Hold a step: for each part of it the bytes read, the seconds, and the bytes written; and the steps that follow."""

    parts: list[tuple[float, float, float]]
    then: "list[Step]"
    done: int = 0
    tries: int = 0

    @property
    def seconds(self) -> float:
        return sum(seconds for _, seconds, _ in self.parts)


class Result(NamedTuple):
    """Say how a batch went, and the least seconds that such nodes can take, `bound`.

    `storage` and `head` are the shares of the time that they were busy, 0 … 1, and `twice` is that of the work that was done twice. In the
    last `tail` seconds, less than half of the places had work.
    """

    seconds: float
    bound: float
    storage: float
    head: float
    twice: float
    tail: float


def make_chains(costs: Costs, captures: int, slow: int, chance: random.Random) -> list[list[Step]]:
    """Make the steps of all captures: masks, train, evaluate and export of each."""
    chains = []
    for number in range(captures):
        seconds = chance.choice(costs.train) * (10 if slow and number % slow == slow // 2 else 1) / costs.checkpoints
        parts = [(costs.photos * (part == 0), seconds, costs.checkpoint) for part in range(costs.checkpoints)]
        evaluate = Step([(costs.asset + costs.photos, costs.evaluate, MB)], [])
        export = Step([(costs.asset, costs.export, costs.mesh)], [])
        train = Step([*parts, (0, 0, costs.asset)], [evaluate, export])
        chains.append([Step([(costs.photos, costs.masks, 0)], [train]), train, evaluate, export])
    return chains


def simulate(farm: Farm, costs: Costs, captures: int) -> Result:
    """Simulate a batch from Ray's start to its last step. The same arguments give the same result."""
    chance, crowded, number = random.Random(0), CROWDED if farm.places > 1 else 1.0, itertools.count()
    chains = make_chains(costs, captures, farm.slow, chance)
    total, left = sum(step.seconds for chain in chains for step in chain), 4 * captures
    longest = max(masks.seconds + train.seconds + max(a.seconds, b.seconds) for masks, train, a, b in chains)
    events: list[tuple] = []
    ready, free = deque(chain[0] for chain in chains), deque(list(range(farm.nodes)) * farm.places)
    runs: list[set[Step]] = [set() for _ in range(farm.nodes)]
    now = head = storage = half = START
    moved = twice = 0.0

    def at(time: float, what: str, node: int, step: Step | None = None) -> None:
        heapq.heappush(events, (time, next(number), what, node, step, step.tries if step else 0))

    def transfer(size: float) -> float:
        nonlocal storage, moved
        if not size or not farm.storage:
            return now
        storage, moved = max(storage, now) + size / farm.storage, moved + size
        return max(storage, now + size / LINK)

    for node in range(farm.nodes if farm.dies else 0):
        at(START + chance.expovariate(1 / farm.dies), "dies", node)
    while left:
        while ready and free:
            node, step, head = free.popleft(), ready.popleft(), max(head, now) + HEAD
            runs[node].add(step)
            at(head, "read", node, step)
        half = now if 2 * sum(map(len, runs)) >= farm.nodes * farm.places else half
        now, _, what, node, step, tries = heapq.heappop(events)
        if what == "dies":
            for step in runs[node]:
                twice += step.parts[step.done][1] / 2  # on average
                step.tries += 1
                at(now + NOTICE, "again", node, step)
            runs[node], free = set(), deque(other for other in free if other != node)
            at(now + REPAIR, "back", node)
        elif what == "back":
            free.extend([node] * farm.places)
            at(now + chance.expovariate(1 / farm.dies), "dies", node)
        elif tries != step.tries:  # its node has died meanwhile
            continue
        elif what == "again":
            ready.append(step)
        elif what == "read":
            at(transfer(step.parts[step.done][0]) + crowded * step.parts[step.done][1], "write", node, step)
        elif what == "write":
            at(transfer(step.parts[step.done][2]), "next", node, step)
        else:
            step.done += 1
            if step.done < len(step.parts):
                at(now, "read", node, step)
            else:
                runs[node].remove(step)
                free.append(node)
                ready.extend(step.then)
                left -= 1
    bound = START + max(crowded * total / farm.nodes / farm.places, longest)
    busy = moved / farm.storage / now if farm.storage else 0.0
    return Result(now, bound, busy, 4 * captures * HEAD / now, twice / total, now - half)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the measured batches beside their simulation, and a table of farms."""
    argparse.ArgumentParser(prog="refgs bench farm", description=__doc__.splitlines()[0]).parse_args(arguments)
    for workers, measured in ((1, 379.5), (2, 211.2)):
        found = simulate(Farm(1, workers), SMALL, 24)
        console.print(f"24 small captures, {workers} at once: {found.seconds:.1f} s; measured {measured}")
    farm = Farm(50, 2, storage=10 * LINK)
    farms = {
        "50 nodes, 2 steps at once on each, storage of 10 Gbit/s": (farm, STANDARD),
        "storage of 1 Gbit/s": (farm._replace(storage=LINK), STANDARD),
        "each node dies once a day": (farm._replace(dies=24 * HOUR), STANDARD),
        "each node dies every two hours": (farm._replace(dies=2 * HOUR), STANDARD),
        "one capture in 100 takes ten times as long": (farm._replace(slow=100), STANDARD),
        "16 steps at once on each": (farm._replace(places=16), STANDARD),
        "16 steps, storage of 1 Gbit/s": (farm._replace(places=16, storage=LINK), STANDARD),
        "small captures, 2 steps": (farm, SMALL),
    }
    lines = [["2,000 captures", "hours", "at the least", "storage busy", "head busy", "done twice", "tail, minutes"]]
    for name, (one, costs) in farms.items():
        found = simulate(one, costs, 2000)
        hours = [f"{found.seconds / HOUR:.2f}", f"{found.bound / HOUR:.2f}"]
        shares = [f"{found.storage:.0%}", f"{found.head:.0%}", f"{found.twice:.1%}"]
        lines.append([name, *hours, *shares, f"{found.tail / 60:.0f}"])
    console.print(markdown_table(lines))
