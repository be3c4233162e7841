"""Write docs/settings.md, the reference of all settings, from backend/refgs/settings.py and the presets."""

from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from refgs.settings import COMPARISON, Settings, load_settings

PAGE = Path(__file__).resolve().parents[1] / "docs" / "settings.md"
PRESETS = ("quick", "standard", "paper")
HEAD = """# Settings

<!-- Written by `python scripts/settings_page.py` from backend/refgs/settings.py and presets/. -->

`refgs train CAPTURE --out RUN --preset NAME` trains with a preset: `quick`, `standard` or `paper`. `--set section.key=value` changes one
of its settings, e.g. `--set train.iterations=2000`. `--preset FILE.toml` takes a file of your own. Begin it with `base = "standard"` and
write only the sections and keys that differ from that preset.
"""
PAPERS = """
## For comparison with papers

These values exist only to compare with other methods.

"""
BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


def page() -> str:
    """Return the text of docs/settings.md."""
    tables = {preset: load_settings(preset).model_dump() for preset in PRESETS}
    parts = [HEAD]
    for section, field in Settings.model_fields.items():
        rows = []
        for name, info in field.annotation.model_fields.items():
            allowed = _allowed(f"{section}.{name}", info)
            if allowed is not None:
                values = [_value(tables[preset][section][name]) for preset in PRESETS]
                rows.append([f"`{name}`", info.description, allowed, *values])
        parts.append(f"\n## {section}\n\n{field.annotation.__doc__.split(chr(10))[0]}\n\n")
        parts.append(_table(["key", "meaning", "values", *PRESETS], rows))
    rows = []
    for key, values in COMPARISON.items():
        section, _, name = key.partition(".")
        for value, meaning in values.items():
            used = [preset for preset in PRESETS if tables[preset][section][name] == value]
            rows.append([f"`{key}`", f"`{value}`", meaning, ", ".join(used) or "none"])
    return "".join(parts) + PAPERS + _table(["key", "value", "meaning", "presets"], rows)


def _table(head: list[str], rows: list[list[str]]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, ["---"] * len(head), *rows))


def _allowed(key: str, info: FieldInfo) -> str | None:
    """Describe the values that a setting accepts, for the table on the page.

    Leaves out values that exist only to compare with papers. Returns None if only one value is left to choose.
    """
    if get_origin(info.annotation) is Literal:
        values = [value for value in get_args(info.annotation) if value not in COMPARISON.get(key, ())]
        return ", ".join(map(str, values)) if len(values) > 1 else None
    number, metadata = info.annotation, info.metadata
    if get_origin(number) is tuple:
        number, *inner = get_args(get_args(number)[0])
        metadata = [bound for part in inner for bound in getattr(part, "metadata", [])]
        many = "three "
    else:
        many = ""
    kind = {int: "integer", float: "number"}[number] + ("s" if many else "")
    bounds = [
        f"{sign} {_value(getattr(b, name))}" for b in metadata for name, sign in BOUNDS.items() if hasattr(b, name)
    ]
    return f"{many}{kind} {', '.join(bounds)}".strip()


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_value, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
