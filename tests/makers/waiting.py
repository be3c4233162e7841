"""Wait for the add-on's jobs, which run in processes of their own."""

import time
from collections.abc import Callable

from refgs_addon import jobs


def until(condition: Callable[[], object], seconds: float = 30) -> None:
    """Poll the jobs until the condition holds; fail after `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, [(job.name, job.state, job.line) for job in jobs.JOBS]
        jobs.poll()
        time.sleep(0.005)


def final_state(job: jobs.Job, seconds: float = 30) -> str:
    """Wait until a job has ended, and return its state; fail after `seconds`."""
    until(lambda: job.ended, seconds)
    return job.state
