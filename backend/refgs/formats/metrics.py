"""Describe metrics.json: what is measured of a run, as nested objects of numbers and texts (docs/run-folder.md)."""

from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field, JsonValue

from refgs.formats.validate import Model, parse_json, validated
from refgs.paths import read_text


class Said(Model):
    """Hold words for the user about what was measured, if there are any."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, JsonValue]

    what: str | None = None


class Metrics(Model):
    """Hold a metrics.json: `ambiguities` and `doubt` are what photos cannot tell apart; all else are figures."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, JsonValue]

    ambiguities: dict[str, Said] = Field(default_factory=dict)
    doubt: Said | None = None

    def said(self) -> list[str]:
        """Return the sentences about what photos cannot tell apart: changes to the scene, and metal from paint."""
        return [about.what for about in (*self.ambiguities.values(), self.doubt) if about and about.what]


def read_metrics(file: Path) -> tuple[dict[str, Any], Metrics]:
    """Read a metrics.json as nested dicts, and what is known of it. Raises InputError naming the file and the value that is wrong."""
    again = "Remove it, and evaluate the run again."
    found = parse_json(read_text(file, again), str(file), again)
    return found, validated(found, Metrics, str(file), again)
