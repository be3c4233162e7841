"""Describe two file formats.

- progress.json: how far a training has come. It is in the run folder while the training runs.
- the record of a finished batch step: how the step ended.
"""

from refgs.formats.checkpoint import Count, Seconds
from refgs.formats.validate import Model


class Progress(Model):
    """Hold the iteration that a training has reached, and the total number of its iterations."""

    iteration: Count
    total: Count


class Record(Model):
    """Hold how a step of a batch ended.

    - `status`, `seconds`: the exit status and the run time of the step's command
    - `node`: the name of the machine
    - `words`: the command, split into words
    """

    status: int
    seconds: Seconds
    node: str
    words: list[str]
