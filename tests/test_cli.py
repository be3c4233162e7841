"""Test that help and errors in arguments are printed without importing torch, which takes seconds."""

import subprocess
import sys

import pytest
import tomli_w

from refgs.settings import load_settings

HELP, WRONG = 0, 2


def refgs(tmp_path, *words) -> tuple[int, str, set[str]]:
    """Run the command `refgs` with these arguments. Return its exit status, its output, and the slow packages that it imported.

    Slow packages are torch, scipy and trimesh.
    """
    program = (
        "import sys\n"
        "from refgs.cli import main\n"
        "try:\n    main()\n"
        "finally:\n    print(*({'torch', 'scipy', 'trimesh'} & set(sys.modules)), file=open('imported', 'w'))"
    )
    done = subprocess.run([sys.executable, "-c", program, *words], cwd=tmp_path, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr, set((tmp_path / "imported").read_text().split())


@pytest.mark.parametrize(
    ("status", "words", "says"),
    [
        (HELP, "--help", "evaluate"),
        (HELP, "train --help", "--resume"),
        (WRONG, "trian", "No such command"),
        (WRONG, "train", "Missing argument"),
        (WRONG, "train photos --out run --minutes 0", "--minutes"),
        (WRONG, "train photos --out run --device foo", "--device foo: take auto, cpu or cuda"),
        (WRONG, "train photos --out run --preset nonsense", "no preset nonsense"),
        (WRONG, "train photos --out run --set a.b=c", "unknown key a"),
        (WRONG, "train photos --out run", "photos: there is no such folder"),
        (WRONG, "train . --out run", ".: no capture here"),
        (WRONG, "train photos --out full", "full is not empty"),
        (WRONG, "train . --out run --minutes nan", "--minutes nan: take a number"),
        (WRONG, "train . --out run --minutes inf", "--minutes inf: take a number"),
        (WRONG, "train photos --out run --resume", "run is not a run folder"),
        (WRONG, "train photos --out stopped --resume", "photos: there is no such folder"),
        (WRONG, "train . --out run --from full", "--from and --hints go together"),
        (WRONG, "train . --out run --hints a.json", "--from and --hints go together"),
        (WRONG, "train . --out run --from full --hints a.json", "full is not a run folder"),
        (WRONG, "train . --out run --from stopped --hints a.json", "stopped: the training has not ended"),
        (WRONG, "train . --out stopped --resume --from full --hints a.json", "knows its hints"),
        (WRONG, "check photos", "photos: there is no such folder"),
        (WRONG, "frames film.mp4", "Missing option"),
        (WRONG, "frames film.mp4 --out capture", "film.mp4: there is no such file"),
        (WRONG, "render stopped --cameras a.json --out out --format gif", "--format gif"),
        (WRONG, "render stopped --cameras a.json --out out --passes colour", "--passes colour"),
        (WRONG, "render stopped --cameras a.json --out out", "stopped: the training has not ended"),
        (WRONG, "evaluate stopped --split all", "--split all"),
        (WRONG, "evaluate run", "run is not a run folder"),
        (WRONG, "export run", "run is not a run folder"),
        (WRONG, "export splats.ply", "there is no mesh"),
        (WRONG, "bench nonsense", "no benchmark 'nonsense'"),
    ],
)
def test_torch_is_not_imported(tmp_path, status, words, says):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    (tmp_path / "stopped").mkdir()
    run = {"refgs": "0.2.0", "capture": "photos", "fingerprint": "", "preset": "quick"}
    run |= {"centre": [0.0, 0.0, 0.0], "radius": 1.0, "bounded": True}
    facts = {"run": run, "settings": load_settings("quick").model_dump(mode="json")}
    (tmp_path / "stopped" / "run.toml").write_text(tomli_w.dumps(facts))
    got, said, imported = refgs(tmp_path, *words.split())
    assert got == status and not imported, said
    assert " ".join(says.split()) in " ".join(said.replace("│", " ").split())
