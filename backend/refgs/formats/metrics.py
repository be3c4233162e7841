"""Describe metrics.json: the figures and sentences that evaluating a run gives, as nested objects (docs/run-folder.md)."""

from pathlib import Path
from typing import Any

from pydantic import Field, JsonValue, RootModel

from refgs.formats.validate import Model, read_json, validated


class _Figures(RootModel[dict[str, JsonValue]]):
    pass


class Said(Model):
    """Hold `what`, a sentence that tells the user about a measurement, or None if there is nothing to tell."""

    what: str | None = None


class Metrics(Model):
    """Hold the sentences in metrics.json about what photos cannot tell apart.

    - `ambiguities`: for each change of light or materials, by its name: whether another change hides it in all pictures
    - `doubt`: surfaces that may be metal or paint
    """

    ambiguities: dict[str, Said] = Field(default_factory=dict)
    doubt: Said | None = None

    def said(self) -> list[str]:
        """Return the sentences that `ambiguities` and `doubt` hold."""
        return [about.what for about in (*self.ambiguities.values(), self.doubt) if about and about.what]


def read_metrics(file: Path) -> tuple[dict[str, Any], Metrics]:
    """Read a metrics.json as nested dicts, and as `Metrics`. Raises InputError naming the file and the value that is wrong."""
    again = "Remove it, and evaluate the run again."
    found = read_json(file, _Figures, again).root
    return found, validated(found, Metrics, str(file), again)
