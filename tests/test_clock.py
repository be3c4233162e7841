"""Test the clock that measures how long each step of a training takes. Time is faked: only the test advances it."""

from types import SimpleNamespace

import pytest
import torch

from refgs import clock
from refgs.clock import Clock, timed


@pytest.fixture
def time(monkeypatch):
    """Replace the module `time` that the clock uses by a fake. To let time pass, tests increase its `now`, in seconds."""
    fake = SimpleNamespace(now=0.0, perf_counter=lambda: fake.now)
    monkeypatch.setattr(clock, "time", fake)
    return fake


@pytest.fixture
def watch():
    return Clock(torch.device("cpu"))


def test_a_function_is_timed_while_an_iteration_is_watched(time, watch):
    @timed("raster")
    def draw(seconds):
        time.now += seconds
        return seconds

    assert draw(5) == 5
    with watch.iteration(0):
        assert draw(2) == 2
        time.now += 7  # outside any part: not counted
        draw(1)
    draw(9)
    assert watch.seconds == {"raster": 3}


def test_what_a_part_calls_counts_as_that_part(time, watch):
    @timed("shading")
    def shade():
        time.now += 2

    @timed("loss")
    def loss():
        shade()
        time.now += 1

    with watch.iteration(0):
        loss()
        with watch.part("mesh"):
            shade()
        shade()
    assert watch.seconds == {"loss": 3, "mesh": 2, "shading": 2}


def test_parts_of_a_part_are_their_own(time, watch):
    with watch.part("visibility"):
        time.now += 1
        with watch.part("mesh"):
            time.now += 10
        time.now += 2
    assert watch.seconds == {"mesh": 10, "visibility": 3}


def test_both_ways_of_an_autograd_function(time, watch):
    @timed("raster")
    class Double(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            time.now += 1
            return 2 * x

        @staticmethod
        def backward(ctx, by):
            time.now += 10
            return 2 * by

    x = torch.ones(3, requires_grad=True)
    with watch.iteration(0):
        Double.apply(x).sum().backward()
    assert watch.seconds == {"raster": 11} and (x.grad == 2).all()


def test_it_goes_on_after_an_error_and_after_a_rest(time, watch):
    @timed("raster")
    def draw():
        time.now += 1
        raise RuntimeError

    for _ in range(2):
        with pytest.raises(RuntimeError), watch.iteration(0):
            draw()
    assert watch.seconds == {"raster": 2} and clock._watching is None
    watch.resume({"raster": 3.0, "writing": 1.0}, 2.0)
    assert watch.processor == 2.0
    assert watch.seconds == {"raster": 5, "writing": 1}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA card here")
def test_a_card_is_watched_in_one_of_many_iterations_cuda():
    @timed("product")
    def product(a):
        return a @ a

    a, watch = torch.rand(2000, 2000, device="cuda"), Clock(torch.device("cuda"))
    for number in range(clock.SAMPLED):
        with watch.iteration(number):
            product(a)
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    for _ in range(clock.SAMPLED):
        a @ a
    end.record()
    torch.cuda.synchronize()
    whole = start.elapsed_time(end) / 1000
    assert 0.2 * whole < watch.seconds["product"] < 5 * whole
