"""Read history.jsonl: the errors measured during a training, one JSON object a line (docs/run-folder.md)."""

import json

FILE = "history.jsonl"  # in the run folder


def read(text: str) -> list[dict]:
    """Parse the text of a history.jsonl file to one dictionary a line.

    A truncated line is skipped. A training that is killed can leave one.
    """
    found = []
    for line in text.splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return [item for item in found if isinstance(item, dict)]
