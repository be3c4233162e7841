"""Waiting for the trainer's processes."""

import time
from collections.abc import Callable

from refgs_addon import jobs


def until(condition: Callable[[], object], seconds: float = 30) -> None:
    """Poll the jobs until it holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, [(job.name, job.state, job.line) for job in jobs.JOBS]
        jobs.poll()
        time.sleep(0.005)
