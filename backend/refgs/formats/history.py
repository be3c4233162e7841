"""history.jsonl: the errors of a training as it goes, an object a line (docs/run-folder.md)."""

import json

FILE = "history.jsonl"  # in the run folder


def read(text: str) -> list[dict]:
    """The lines that are whole: a training that was killed can leave half of one."""
    found = []
    for line in text.splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return [item for item in found if isinstance(item, dict)]
