"""Wait for the add-on's background jobs, each of which is a process of its own."""

import time
from collections.abc import Callable

from refgs_addon import jobs


def until(condition: Callable[[], object], seconds: float = 30) -> None:
    """Poll the add-on's background jobs until `condition()` is true. Fail after `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, [(job.name, job.state, job.line) for job in jobs.JOBS]
        jobs.poll()
        time.sleep(0.005)


def final_state(job: jobs.Job, seconds: float = 30) -> str:
    """Wait until a background job has ended, and return its state. Fail after `seconds`."""
    until(lambda: job.ended, seconds)
    return job.state
