"""Where a training's seconds go, by its parts: forward and backward, and what is done now and then.

Functions and autograd's Functions that belong to a part say so (`timed`); they are timed while a clock is watching an iteration.
What is called within a part counts as that. On the CPU every iteration is watched, which takes some 25 µs of it. A card works on while
Python goes on: it is watched in one of `SAMPLED` iterations, by events on its stream, and that one counts for the others.
"""

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

SAMPLED = 50  # iterations, of which a card is watched in one

_watching: "Clock | None" = None


class Clock:
    """Seconds by part, of work on a device."""

    def __init__(self, device: torch.device):
        self.seconds: dict[str, float] = {}
        self._on_card, self._within = device.type == "cuda", False
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    def resume(self, seconds: dict[str, float]) -> None:
        """Count on from what was spent before."""
        for name, value in seconds.items():
            self._add(name, value)

    @contextmanager
    def iteration(self, number: int) -> Iterator[None]:
        """Watch an iteration, if it is one of those that are."""
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
        """Count what is done within, now and then, but for what is a part of its own. Its results are on the CPU, or a card's would not
        have been waited for."""
        begun, known = time.perf_counter(), sum(self.seconds.values())
        before, self._within = self._within, True
        try:
            yield
        finally:
            self._within = before
            others = sum(self.seconds.values()) - known
            self._add(name, time.perf_counter() - begun - others)

    def call(self, name: str, function: Callable, *arguments, **words):
        """Call a function as a part of an iteration."""
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
    """Say of a function, or of an autograd Function's two ways, which part it is."""

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
