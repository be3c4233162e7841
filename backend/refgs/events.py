"""Define the type of the functions that receive the events of a long-running job, such as progress and warnings."""

from collections.abc import Callable
from typing import Any

Report = Callable[[str, dict[str, Any]], None]
"""Called with an event's name and its facts: "stage", "decided", "progress", "measured", "warning"."""
