"""Define the type of functions that receive a job's events."""

from collections.abc import Callable
from typing import Any

Report = Callable[[str, dict[str, Any]], None]
"""Called with an event's name and its facts: "stage", "decided", "progress", "measured", "warning"."""
