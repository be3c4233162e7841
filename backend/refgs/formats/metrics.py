"""Describe metrics.json: the results of evaluating a run, as nested objects (docs/run-folder.md)."""

from pathlib import Path
from typing import Any

from pydantic import Field, JsonValue, RootModel

from refgs.formats.validate import Model, read_json, validated


class _Figures(RootModel[dict[str, JsonValue]]):
    pass


class Said(Model):
    """Hold a message for the user about a measurement, None if there is none."""

    what: str | None = None


class Metrics(Model):
    """Hold the messages in metrics.json about light and materials that the photos leave open.

    - `ambiguities`: messages about two changes that cancel in all pictures, by the pair's name. For example, darker base colours cancel a
      brighter light.
    - `doubt`: a message about surfaces that may be metal or paint
    """

    ambiguities: dict[str, Said] = Field(default_factory=dict)
    doubt: Said | None = None

    def said(self) -> list[str]:
        """Return the sentences that `ambiguities` and `doubt` hold."""
        return [about.what for about in (*self.ambiguities.values(), self.doubt) if about and about.what]


def read_metrics(file: Path) -> tuple[dict[str, Any], Metrics]:
    """Read a metrics.json as nested dicts and as `Metrics`. Raises InputError."""
    again = "Remove it, and evaluate the run again."
    found = read_json(file, _Figures, again).root
    return found, validated(found, Metrics, str(file), again)
