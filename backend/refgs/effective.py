"""Keep track of the settings that a training uses: the user's settings, and every later change with its reason."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from refgs.settings import Settings

By = Literal["plan", "photos", "needs", "memory"]
"""Causes of a change: a time limit, the photos, a need that the scene does without, a graphics card whose memory is full."""


@dataclass(frozen=True)
class Change:
    """Record that the training changed a setting.

    `asked` is the user's value, and `became` is the new value. `by` says what caused the change (see `By`), and `why` explains it in words.
    """

    asked: Any
    became: Any
    by: By
    why: str


@dataclass(frozen=True)
class Effective:
    """Hold the settings that a training uses now, and a record of each change that the training made to the user's settings.

    `asked` holds the user's own settings, which never change. `settings` holds those in use.
    """

    asked: Settings
    settings: Settings
    changes: dict[str, Change] = field(default_factory=dict)

    @classmethod
    def of(cls, asked: Settings) -> "Effective":
        """Make an `Effective` from the user's settings `asked`, without any changes."""
        return cls(asked, asked)

    def changed(self, key: str, value: Any, by: By, why: str) -> "Effective":
        """Return a copy with `value` for `key`, "section.name", recording `by` and `why` it changed."""
        section, name = key.split(".")
        table = getattr(self.settings, section).model_copy(update={name: value})
        return self.moved_to(self.settings.model_copy(update={section: table}), by, why)

    def noted(self, key: str, value: Any, by: By, why: str) -> "Effective":
        """Return a copy that only records a change of the setting `key`. The value in `settings` stays the same.

        Use this for values that the training keeps outside its settings, such as its total of iterations.
        """
        return replace(self, changes=self.changes | {key: Change(_by_key(self.asked)[key], value, by, why)})

    def moved_to(self, settings: Settings, by: By, why: str) -> "Effective":
        """Return a copy with other settings that records each difference with `by` and `why`."""
        asked, before, after = (_by_key(s) for s in (self.asked, self.settings, settings))
        changes = {key: Change(asked[key], value, by, why) for key, value in after.items() if value != before[key]}
        return replace(self, settings=settings, changes=self.changes | changes)

    def chosen(self) -> dict[str, str]:
        """Return the settings chosen from the photos as {key: "value: reason"} for run.toml's [chosen]."""
        return {key: f"{change.became}: {change.why}" for key, change in self.changes.items() if change.by == "photos"}

    def rows(self) -> dict[str, dict[str, Any]]:
        """Return all changes by key, as in the table [changed] of run.toml."""
        return {key: asdict(change) for key, change in self.changes.items()}


def _by_key(settings: Settings) -> dict[str, Any]:
    """Flatten settings to a dictionary with keys such as "train.iterations"."""
    tables = settings.model_dump(mode="json")
    return {f"{section}.{name}": value for section, table in tables.items() for name, value in table.items()}
