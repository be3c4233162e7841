"""Measure how much time each part of a training takes.

A part is a function, or an autograd Function, to which the decorator `timed` gives a name. While `Clock.iteration` is active, the run time
of its calls is added to the part's total. A part that is called inside another part counts for the outer one only.

On the CPU every iteration is measured, which takes about 25 µs each time. A GPU runs asynchronously. There only one in `SAMPLED` iterations
is measured, by CUDA events, and its times are multiplied by `SAMPLED`.
"""

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

SAMPLED = 50  # iterations; a card is watched in one of them

_watching: "Clock | None" = None


class Clock:
    """Add up the seconds that a device spends in each part of a training.

    `seconds` maps a part's name to its total. `processor` is the CPU time of all threads in all iterations, in seconds. Unlike run time,
    CPU time hardly depends on other programs.
    """

    def __init__(self, device: torch.device):
        self.seconds: dict[str, float] = {}
        self.processor = 0.0
        self._on_card, self._within = device.type == "cuda", False
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    def resume(self, seconds: dict[str, float], processor: float) -> None:
        """Add a checkpoint's `seconds` by part, and continue from its CPU time `processor`."""
        self.processor = processor
        for name, value in seconds.items():
            self._add(name, value)

    @contextmanager
    def iteration(self, number: int) -> Iterator[None]:
        """Measure one iteration in a `with` block, on a GPU only every SAMPLED-th one."""
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
        """Time a `with` block as the part `name`.

        Use it for work that is not done in every iteration. The time of other `part` blocks inside it is subtracted. A
        block that uses the GPU must wait for its results before it ends, for example by copying them to the CPU: the clock does not wait.
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
        """Call function(*arguments, **words), count its time for the part `name`, and return its result."""
        if self._within:
            return function(*arguments, **words)
        self._within, begun = True, _event() if self._on_card else time.perf_counter()
        try:
            return function(*arguments, **words)
        finally:
            self._within = False
            if isinstance(begun, torch.cuda.Event):
                self._events.append((name, begun, _event()))
            else:
                self._add(name, time.perf_counter() - begun)

    def _add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def _event() -> torch.cuda.Event:
    """Put an event into the GPU's queue to record the time, and return it."""
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def timed(name: str) -> Callable:
    """Return a decorator that times a function or autograd Function as the part `name`."""

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
