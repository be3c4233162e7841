"""Print hashes of all that short trainings write: equal lines before and after a change show that it kept every bit.

`python -m scripts.same_bits CAPTURE… > before.txt`, where a capture is one by `python -m benchmarks.scenes ball --size 128 --train 40`, or
photos of a real object with masks. Each training runs on one thread with seed 0, stops halfway and is resumed. A line has its name, the
iteration of a checkpoint, the name of a tensor and the SHA-256 of its bytes; the last line of a training is of splats.ply.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import hashlib
import sys
import tempfile
from pathlib import Path

from safetensors import safe_open

from refgs.asked import Asked
from refgs.train_job import train

SMALL = [
    "image.max_side=128",
    "surfels.start=3000",
    "surfels.budget=5000",
    "surfels.hull=64",
    "image.masks=off",
    "train.seed=0",
]
LESS = ["train.iterations=900", "train.checkpoint_every=150", "indirect.every=150", "densify.every=50"]
PAPER = [
    "densify.reset_every=120",
    "propagation.every=100",
    "initial.until=0.3",
    "needs.initial=on",
    "cameras.poses=on",
]
CASES = {
    "quick": ("quick", SMALL),
    "paper": ("paper", [*SMALL, *LESS, *PAPER]),
    "exposures": ("quick", [*SMALL, *LESS, "light.exposure=on", "cameras.poses=on", "indirect.least=0"]),
    "sh": ("quick", [*SMALL, *LESS, "render.shading=sh"]),
    "auto": ("quick", [*SMALL, *LESS, "light.exposure=auto", "cameras.poses=auto", "image.coarse=off"]),
}


def hashes(capture: Path, preset: str, changes: list[str], out: Path) -> dict[str, str]:
    """Train on a capture into the folder `out`, with one stop. Return the hashes of what is written, by words for each."""
    found: dict[str, str] = {}

    def look() -> None:
        for file in sorted(out.glob("checkpoints/*.safetensors")):
            if f"{file.stem} all" not in found:
                with safe_open(file, "pt") as tensors:
                    for name in sorted(tensors.keys()):
                        value = tensors.get_tensor(name).contiguous().view(-1)
                        found[f"{file.stem} {name}"] = hashlib.sha256(value.numpy().tobytes()).hexdigest()[:16]
                found[f"{file.stem} all"] = ""

    def train_until(stop: float, resume: bool) -> None:
        def attend(state) -> bool:
            look()
            return state.iteration >= stop * state.total

        given = {"resume": True} if resume else {"preset": preset, "changes": tuple(changes)}
        train(Asked(capture, out, device="cpu", **given), lambda event, facts: None, attend)
        look()

    train_until(0.5, resume=False)
    train_until(1.0, resume=True)
    found["splats.ply"] = hashlib.sha256((out / "splats.ply").read_bytes()).hexdigest()[:16]
    return {words: value for words, value in found.items() if value}


def main() -> None:
    """Train each of CASES on each capture that the command line names, and print the hashes."""
    for argument in sys.argv[1:]:
        for name, (preset, changes) in CASES.items():
            with tempfile.TemporaryDirectory() as folder:
                for words, value in hashes(Path(argument), preset, changes, Path(folder) / "run").items():
                    print(Path(argument).name, name, words, value, flush=True)


if __name__ == "__main__":
    main()
