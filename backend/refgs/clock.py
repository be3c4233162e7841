"""Time the parts of a training: forward and backward passes, and work at intervals.

`timed` marks a function or an autograd Function as a part; it is timed while a clock watches an iteration. A part called within
another part counts as the outer one. On the CPU every iteration is watched, which costs about 25 µs. A card runs asynchronously: one of
`SAMPLED` iterations is watched, by events on the card's stream, and stands for the others.
"""

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

SAMPLED = 50  # iterations; a card is watched in one of them

_watching: "Clock | None" = None


class Clock:
    """Count seconds of work on a device, by part."""

    def __init__(self, device: torch.device):
        self.seconds: dict[str, float] = {}
        self._on_card, self._within = device.type == "cuda", False
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    def resume(self, seconds: dict[str, float]) -> None:
        """Add the seconds that were counted before the training was interrupted."""
        for name, value in seconds.items():
            self._add(name, value)

    @contextmanager
    def iteration(self, number: int) -> Iterator[None]:
        """Watch an iteration. On a card, watch only one of `SAMPLED`."""
        global _watching
        if self._on_card and number % SAMPLED != SAMPLED // 2:
            yield
            return
        _watching = self
        try:
            yield
        finally:
            _watching = None
        if self._events:
            torch.cuda.synchronize()
            for name, begun, ended in self._events:
                self._add(name, SAMPLED * begun.elapsed_time(ended) / 1000)
            self._events.clear()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the work in this `with` as one part, less the time of the parts nested in it. Use it for work done only at intervals.

        The results of the work must be on the CPU, because the clock does not wait for a card.
        """
        begun, known = time.perf_counter(), sum(self.seconds.values())
        before, self._within = self._within, True
        try:
            yield
        finally:
            self._within = before
            others = sum(self.seconds.values()) - known
            self._add(name, time.perf_counter() - begun - others)

    def call(self, name: str, function: Callable, *arguments, **words):
        """Call a function and count it as a part."""
        if self._within:
            return function(*arguments, **words)
        self._within, begun = True, self._now()
        try:
            return function(*arguments, **words)
        finally:
            self._within, ended = False, self._now()
            if self._on_card:
                self._events.append((name, begun, ended))
            else:
                self._add(name, ended - begun)

    def _now(self):
        if not self._on_card:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def timed(name: str) -> Callable:
    """Mark a function, or an autograd Function's forward and backward, as a part."""

    def decorate(what):
        if isinstance(what, type):
            for way in ("forward", "backward"):
                setattr(what, way, staticmethod(decorate(getattr(what, way))))
            return what

        @functools.wraps(what)
        def call(*arguments, **words):
            clock = _watching
            return what(*arguments, **words) if clock is None else clock.call(name, what, *arguments, **words)

        return call

    return decorate
