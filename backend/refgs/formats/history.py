"""Read history.jsonl: the errors during a training, one JSON object a line (docs/run-folder.md)."""

import json

FILE = "history.jsonl"  # in the run folder


def read(text: str) -> list[dict]:
    """Parse the lines; skip a line that is truncated, which a killed training can leave."""
    found = []
    for line in text.splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return [item for item in found if isinstance(item, dict)]
