"""Label runs that are shown side by side, by the settings in which they differ."""

from collections import Counter, defaultdict
from collections.abc import Hashable

from refgs.formats.run_toml import Summary

MOST = 4  # settings that a label names
BY_NAME = {  # in this order; other settings follow, under their own names
    "run.capture": "{}",
    "run.preset": "{}",
    "run.device": "{}",
    "run.threads": "{} threads",
    "run.refgs": "RefGS {}",
    "image.max_side": "{} px",
    "surfels.budget": "{:,} surfels",
    "train.iterations": "{:,} iterations",
    "train.seed": "seed {}",
}


def labels(names: list[str], facts: list[Summary]) -> list[str]:
    """Make a unique label for each run from the settings in which the runs differ.

    `facts` are the contents of the runs' run.toml, and `names` are the names of their folders. A label that would be empty or not unique
    ends with the folder's name. If a setting differs only because the presets differ, the label has the name of the preset instead.
    Settings are named without their section, unless another section has a setting with the same name.
    """
    known = [_settings(summary) for summary in facts]
    groups = defaultdict(list)
    for settings in known:
        groups[settings.get("run.preset")].append(settings)
    keys = [key for key in BY_NAME if key.startswith("run.")]
    keys += [key for settings in known for key in settings if key not in keys]
    keys = sorted(dict.fromkeys(keys), key=lambda key: list(BY_NAME).index(key) if key in BY_NAME else len(BY_NAME))

    def differs(key: str, among: list[dict]) -> bool:
        return len({settings.get(key) for settings in among}) > 1

    both = "run.capture", "run.preset"
    named = [k for k in keys if any(differs(k, group) for group in ([known] if k in both else groups.values()))]
    last = Counter(key.rsplit(".", 1)[-1] for key in keys)
    short = {key: key if last[key.rsplit(".", 1)[-1]] > 1 else key.rsplit(".", 1)[-1] for key in keys}
    found = []
    for name, settings in zip(names, known, strict=True):
        words = [_words(key, short[key], settings[key]) for key in named if key in settings]
        more = [f"and {len(words) - MOST} more"] if len(words) > MOST else []
        found.append(", ".join(words[:MOST] + more) or name)
    count = Counter(found)
    return [label if count[label] == 1 else f"{label} ({name})" for label, name in zip(found, names, strict=True)]


def _words(key: str, short: str, value: Hashable) -> str:
    if key not in BY_NAME:
        return f"{short}={value}"
    pattern = BY_NAME[key]
    return pattern.format(value) if isinstance(value, int) or ":" not in pattern else f"{value}"


def _settings(summary: Summary) -> dict[str, Hashable]:
    """Collect the values by which a label can tell runs apart: {"section.setting": value}."""
    found: dict[str, Hashable] = {f"run.{key}": value for key, value in summary.run.items() if f"run.{key}" in BY_NAME}
    for name in ("run.capture", "run.preset"):  # only the last part of a path
        if name in found:
            found[name] = str(found[name]).replace("\\", "/").rstrip("/").rsplit("/", 1)[-1]
    for section, values in summary.settings.items():
        for key, value in values.items():
            found[f"{section}.{key}"] = tuple(value) if isinstance(value, list) else value
    return found
