"""Describe two file formats.

- progress.json: how far a training has come. It is in the run folder while the training runs.
- the record of a finished batch step: how the step ended.
"""

from refgs.formats.checkpoint import Count, Seconds
from refgs.formats.validate import Model


class Progress(Model):
    """Hold how far a training is, and how many iterations it has in all."""

    iteration: Count
    total: Count


class Record(Model):
    """Hold how a step of a batch ended: its command's `words` and exit status, its seconds, and the machine."""

    status: int
    seconds: Seconds
    node: str
    words: list[str]
