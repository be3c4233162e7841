"""Check the trainer's types with pyright: no folder has more errors than its ceiling, and ceilings only fall.

`python scripts/check_types.py` prints the errors of each folder of backend/refgs. The exit status is 1 if there are more errors than
CEILINGS allows, or fewer: then lower the ceiling.
"""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TYPED = ("batch", "formats", "geometry", "kernels", "model", "train")
ELSEWHERE = 16  # errors in all other folders together
CEILINGS = {**dict.fromkeys(TYPED, 0), "elsewhere": ELSEWHERE}


def main() -> None:
    """Run pyright, print its errors and their number by folder, and exit."""
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--outputjson"]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        said = json.loads(done.stdout)
        errors = [row for row in said["generalDiagnostics"] if row["severity"] == "error"]
        checked = said["summary"]["filesAnalyzed"]
    except (ValueError, KeyError):
        sys.exit(f"pyright did not run (exit status {done.returncode}):\n{done.stdout}")
    if checked < (files := len(list((ROOT / "backend" / "refgs").rglob("*.py")))):
        sys.exit(f"pyright checked only {checked} of {files} files")
    found: Counter[str] = Counter()
    for row in errors:
        file = Path(row["file"]).relative_to(ROOT / "backend" / "refgs")
        found[file.parts[0] if file.parts[0] in TYPED else "elsewhere"] += 1
        print(f"backend/refgs/{file.as_posix()}:{row['range']['start']['line'] + 1}: {row['message'].splitlines()[0]}")
    wrong = False
    for folder, ceiling in CEILINGS.items():
        more = found[folder] - ceiling
        wrong |= more != 0
        say = "more than the ceiling" if more > 0 else "lower its ceiling in scripts/check_types.py" if more < 0 else ""
        print(f"{folder:>10} {found[folder]:3} {say}")
    sys.exit(wrong)


if __name__ == "__main__":
    main()
