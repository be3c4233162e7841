"""Make the Python wheels that the extension contains: an empty one for the trainer, and one with a fake uv (package installer)."""

import sys
import zipfile
from pathlib import Path


def bring(folder: Path, version: str = "9.9") -> Path:
    """Write an empty wheel of the trainer and a wheel of the fake uv (package installer). Return their folder."""
    folder = folder / f"wheels {version}"
    folder.mkdir()
    (folder / f"refgs-{version}-py3-none-any.whl").touch()
    fake = Path(__file__).with_name("fake_uv.py")
    with zipfile.ZipFile(folder / "uv-1.0-py3-none-any.whl", "w") as archive:
        archive.writestr("uv-1.0.data/scripts/uv", f"#!{sys.executable}\nimport runpy\nrunpy.run_path({str(fake)!r})\n")
    return folder
