"""Track a training's settings in effect: the settings that were asked for, and each change with its cause."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from refgs.settings import Settings

By = Literal["plan", "photos", "needs", "memory"]
"""What changes a setting: a time given to the training, the photos, a need that the scene does without, a card's full memory."""


@dataclass(frozen=True)
class Change:
    """Record the change of one setting: the value asked for, the new value, the cause and the reason."""

    asked: Any
    became: Any
    by: By
    why: str


@dataclass(frozen=True)
class Effective:
    """Hold a training's settings in effect, and how each came to differ from the setting that was asked for.

    The user's own settings are in `asked` and never change.
    """

    asked: Settings
    settings: Settings
    changes: dict[str, Change] = field(default_factory=dict)

    @classmethod
    def of(cls, asked: Settings) -> "Effective":
        """Start from the settings that were asked for."""
        return cls(asked, asked)

    def changed(self, key: str, value: Any, by: By, why: str) -> "Effective":
        """Return a copy in which one setting, given by its key `section.name`, is changed. The copy records the cause and the reason."""
        section, name = key.split(".")
        table = getattr(self.settings, section).model_copy(update={name: value})
        return self.moved_to(self.settings.model_copy(update={section: table}), by, why)

    def noted(self, key: str, value: Any, by: By, why: str) -> "Effective":
        """Return a copy that records the change of a number, but keep `settings` as they are.

        This is for numbers that the training's state holds itself, such as the total of iterations.
        """
        return replace(self, changes=self.changes | {key: Change(_numbers(self.asked)[key], value, by, why)})

    def moved_to(self, settings: Settings, by: By, why: str) -> "Effective":
        """Return a copy with other settings. The copy records each setting that differs as a change."""
        asked, before, after = (_numbers(s) for s in (self.asked, self.settings, settings))
        changes = {key: Change(asked[key], value, by, why) for key, value in after.items() if value != before[key]}
        return replace(self, settings=settings, changes=self.changes | changes)

    def chosen(self) -> dict[str, str]:
        """List the settings that the photos chose, with the reasons: the table [chosen] of run.toml."""
        return {key: f"{change.became}: {change.why}" for key, change in self.changes.items() if change.by == "photos"}

    def rows(self) -> dict[str, dict[str, Any]]:
        """List the settings that were changed, with the value asked for and the new value: the table [changed] of run.toml."""
        return {key: asdict(change) for key, change in self.changes.items()}


def _numbers(settings: Settings) -> dict[str, Any]:
    """List the values of all settings by their dotted keys."""
    tables = settings.model_dump(mode="json")
    return {f"{section}.{name}": value for section, table in tables.items() for name, value in table.items()}
