"""Imitate uv, the Python package installer, for tests of the add-on. Print what uv prints; install a fake trainer.

The environment variable FAKE_UV names a failure: "hang" (a download does not end), "network", "full" (the disk is full), "mute" (the
installed trainer fails).
"""

import json
import os
import sys
import time
from pathlib import Path

NETWORK = """error: Request failed after 3 retries in 9.0s
  cause: Failed to fetch: https://wheels.example/torch/
  cause: error sending request for url (https://wheels.example/torch/)
  cause: dns error"""
FULL = """error: Failed to extract archive: torch-2.14.0.whl
  cause: No space left on device (os error 28)"""

words, fate = sys.argv[1:], os.environ.get("FAKE_UV", "")
cache = Path(words[words.index("--cache-dir") + 1])
cache.mkdir(exist_ok=True)
with open(cache.parent.parent / "uv calls", "a") as calls:
    calls.write(json.dumps({"words": words, "pid": os.getpid(), "variables": dict(os.environ)}) + "\n")
if "venv" in words:
    environment = Path(words[-1])
    if environment.exists():
        sys.exit(
            f"error: Failed to create virtual environment\n  cause: A virtual environment already exists at: {environment}"
        )
    (environment / "bin").mkdir(parents=True)
    print("Using CPython 3.13.0\nCreating virtual environment")
    sys.exit()
python = Path(words[words.index("--python") + 1])
(cache / "torch").write_bytes(b"0" * 50_000_000)
print("Resolved 3 packages in 1.04s\nDownloading torch (850.5MiB)\nDownloading numpy (15.0MiB)", flush=True)
if fate in ("network", "full"):
    print({"network": NETWORK, "full": FULL}[fate], file=sys.stderr)
    sys.exit(2)
while fate == "hang":
    time.sleep(0.1)
print(
    " Downloaded numpy\n Downloaded torch\nPrepared 3 packages in 17.19s\nInstalled 3 packages in 1.25s\n + torch==2.14.0"
)
worker = Path(__file__).with_name("fake_worker.py") if fate != "mute" else "/nothing.py"
python.write_text(f"#!{sys.executable}\nimport runpy\nrunpy.run_path({str(worker)!r})\n")
python.chmod(0o755)
