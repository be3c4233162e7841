"""Where things lie on this disk."""

from pathlib import Path

from refgs.errors import InputError

PACKAGE = Path(__file__).resolve().parent
ROOT = PACKAGE.parents[1]
PRESETS = ROOT / "presets"


def clone_root() -> Path:
    """The repository's root, for what is not part of the package: the benchmark scenes and the Blender extension."""
    if not (ROOT / "blender_manifest.toml").exists():
        raise InputError("this needs the whole repository: clone it and install with `pip install -e .` from there")
    return ROOT
