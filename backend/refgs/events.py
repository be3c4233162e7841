"""Events of a job, for whoever shows its progress."""

from collections.abc import Callable
from typing import Any

Report = Callable[[str, dict[str, Any]], None]
"""Called with an event's name and its facts: "stage", "decided", "progress", "measured", "warning"."""
