"""Effective settings of a training: those that were asked for, and each change with what made it."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from refgs.settings import Settings

By = Literal["plan", "photos", "needs", "memory"]
"""What changes a setting: a time given to the training, the photos, a need that the scene does without, a card's full memory."""


@dataclass(frozen=True)
class Change:
    """One setting's change."""

    asked: Any
    became: Any
    by: By
    why: str


@dataclass(frozen=True)
class Effective:
    """Settings that a training goes by. The user's own are in `asked` and stay as they are."""

    asked: Settings
    settings: Settings
    changes: dict[str, Change] = field(default_factory=dict)

    @classmethod
    def of(cls, asked: Settings) -> "Effective":
        """Start from the settings that were asked for."""
        return cls(asked, asked)

    def changed(self, key: str, value: Any, by: By, why: str) -> "Effective":
        """Change one setting, `section.name`."""
        section, name = key.split(".")
        table = getattr(self.settings, section).model_copy(update={name: value})
        return self.moved_to(self.settings.model_copy(update={section: table}), by, why)

    def noted(self, key: str, value: Any, by: By, why: str) -> "Effective":
        """Keep a change of a number that the state holds in the settings' place: how many iterations there are."""
        return replace(self, changes=self.changes | {key: Change(_numbers(self.asked)[key], value, by, why)})

    def moved_to(self, settings: Settings, by: By, why: str) -> "Effective":
        """Take other settings, and keep each number that differs as a change."""
        asked, before, after = (_numbers(s) for s in (self.asked, self.settings, settings))
        changes = {key: Change(asked[key], value, by, why) for key, value in after.items() if value != before[key]}
        return replace(self, settings=settings, changes=self.changes | changes)

    def chosen(self) -> dict[str, str]:
        """Say what the photos decided, and why: run.toml's [chosen]."""
        return {key: f"{change.became}: {change.why}" for key, change in self.changes.items() if change.by == "photos"}

    def rows(self) -> dict[str, dict[str, Any]]:
        """List the changes: run.toml's [changed]."""
        return {key: asdict(change) for key, change in self.changes.items()}


def _numbers(settings: Settings) -> dict[str, Any]:
    """List all settings by their dotted keys."""
    tables = settings.model_dump(mode="json")
    return {f"{section}.{name}": value for section, table in tables.items() for name, value in table.items()}
