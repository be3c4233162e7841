"""Define the events of a long-running job, such as progress and warnings: the functions that receive them, and their text."""

from collections.abc import Callable
from typing import Any

from refgs.errors import one_line

Report = Callable[[str, dict[str, Any]], None]
"""Called with an event's name and its facts: "stage", "decided", "progress", "measured", "warning".

An event with a line for the user has it as `what`. If `detail` is true, the line is only for those who want to know more: it is in the
run's log.txt, but neither the command line nor Blender shows it unasked.
"""


def event_line(event: str, facts: dict[str, Any]) -> str:
    """Return the text of an event, facts["what"], as one line. Warnings are marked."""
    return ("warning: " if event == "warning" else "") + one_line(facts["what"])
