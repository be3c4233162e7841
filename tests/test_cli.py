"""Test the command line's door: help and wrong arguments without importing torch, exit statuses whatever the system lacks."""

import json
import os
import subprocess
import sys

import pytest
import tomli_w

from refgs import process
from refgs.errors import TRY_AGAIN
from refgs.settings import load_settings

HELP, WRONG = 0, 2


PROGRAM = """
import json, os, sys
from refgs.cli import main
for line in sys.stdin:
    folder, words = json.loads(line)
    if (child := os.fork()) == 0:
        os.chdir(folder)
        sys.argv[1:], said, status = words, os.open("said", os.O_WRONLY | os.O_CREAT), 0
        for stream in (1, 2):
            os.dup2(said, stream)
        try:
            main()
        except SystemExit as ended:
            status = ended.code or 0
        print(*({"torch", "scipy", "trimesh"} & set(sys.modules)), file=open("imported", "w"), flush=True)
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def refgs():
    """Start a process that forks for each command, because to load `refgs` takes longer than its answers.

    Yields a function that runs a command in a folder. It returns the exit status, the output, and the slow packages that the command
    imported: torch, scipy and trimesh.
    """
    if not hasattr(os, "fork"):
        pytest.skip("needs fork")
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", PROGRAM], stdin=pipe, stdout=pipe, text=True) as process:

        def run(folder, *words) -> tuple[int, str, set[str]]:
            process.stdin.write(json.dumps([str(folder), words]) + "\n")
            process.stdin.flush()
            status = int(process.stdout.readline())
            return status, (folder / "said").read_text(), set((folder / "imported").read_text().split())

        yield run
        process.stdin.close()


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
        (WRONG, "train . --out run", ". is not a capture: no photos are in it"),
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
        (WRONG, "check stopped", "stopped is a run, not a capture"),
        (WRONG, "frames film.mp4", "Missing option"),
        (WRONG, "frames film.mp4 --out capture", "film.mp4: there is no such file"),
        (WRONG, "check full/notes.txt", "notes.txt: this is a file"),
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
def test_torch_is_not_imported(refgs, tmp_path, status, words, says):
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


def in_shell(tmp_path, line: str, **variables: str) -> tuple[int, str, str]:
    """Run a line of bash in which `refgs` is the command. Return its exit status, its output and its errors."""
    program = f'refgs() {{ "{sys.executable}" -m refgs.cli "$@"; }}; {line}'
    done = subprocess.run(
        ["bash", "-c", program], cwd=tmp_path, env=os.environ | variables, capture_output=True, timeout=300
    )
    return done.returncode, done.stdout.decode(), done.stderr.decode()


POSIX = pytest.mark.skipif(os.name != "posix", reason="a POSIX shell closes the streams")
MISSING = "refgs: photos: there is no such folder. Name the folder that holds the capture.\n"


@POSIX
@pytest.mark.parametrize(
    ("line", "status", "errors"),
    [
        ("refgs --help >&-", 0, ""),
        ("refgs --help >&- 2>&- <&-", 0, ""),
        ("refgs check photos >&-", WRONG, MISSING),
        ("refgs check photos 2>&-", WRONG, ""),
        ("refgs check photos >&- 2>&- <&-", WRONG, ""),
        ("refgs check photos 2>/dev/full", WRONG, ""),
        ("refgs --help | true; exit ${PIPESTATUS[0]}", 0, ""),
        ("refgs check photos 2>&1 | true; exit ${PIPESTATUS[0]}", WRONG, ""),
        (
            "refgs --help >/dev/full",
            TRY_AGAIN,
            "refgs: what was printed cannot be written (No space left on device): mend that, and run the command again\n",
        ),
    ],
)
def test_streams_that_are_closed_or_full(tmp_path, line, status, errors):
    if "/dev/full" in line and not os.path.exists("/dev/full"):
        pytest.skip("this system has no /dev/full")
    got, _, said = in_shell(tmp_path, line)
    assert (got, said) == (status, errors)


@POSIX
def test_a_capture_is_checked_for_a_reader_that_leaves(ball_capture, tmp_path):
    line = f"refgs check {ball_capture} | head -n 1; exit ${{PIPESTATUS[0]}}"
    assert in_shell(tmp_path, line, PYTHONUNBUFFERED="1") == (0, "Layout: NeRF-Blender\n", "")


@POSIX
def test_files_do_not_get_what_is_printed(tmp_path):
    """Check that a file which is opened while the output is closed does not take its place."""
    program = (
        "import os, refgs.process; refgs.process.open_streams(); f = open('file', 'w'); print(1); os.write(1, b'2')"
    )
    subprocess.run(["bash", "-c", f'"{sys.executable}" -c "{program}" >&- 2>&- <&-'], cwd=tmp_path, check=True)
    assert (tmp_path / "file").read_text() == ""


@POSIX
def test_a_folder_that_was_deleted(tmp_path):
    status, _, said = in_shell(tmp_path, "mkdir gone; cd gone; rmdir ../gone; refgs check photos")
    assert (
        status == WRONG and said.startswith("refgs: the current folder is no longer there: ") and said.count("\n") == 1
    )


@pytest.mark.skipif(sys.platform != "linux", reason="the system cannot limit a process's memory")
@pytest.mark.parametrize("kilobytes", [300_000, 2_000_000, 3_600_000])
def test_too_low_a_limit_of_memory(tmp_path, kilobytes):
    """Check that a process that may reserve too little says so: torch's import would fail, crash or hang."""
    status, _, said = in_shell(tmp_path, f"ulimit -v {kilobytes}; refgs check photos")
    least = f"limited to {kilobytes * 1024 / 1e9:.1f} GB (ulimit -v): allow at least 4 GB"
    assert status == TRY_AGAIN and least in said and said.count("\n") == 1


@POSIX
@pytest.mark.parametrize("variables", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}])
def test_names_beyond_ascii(tmp_path, variables):
    status, _, said = in_shell(tmp_path, "refgs check 'é–日'", LANG="C", **variables)
    assert status == WRONG and "there is no such folder" in said and said.count("\n") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have names in UTF-8 only")
@pytest.mark.parametrize(
    ("line", "mend"),
    [
        ("refgs report $'\\xe9'", "rename the file or folder"),
        ("PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 LC_ALL=C refgs report é", "choose a language with UTF-8"),
    ],
)
def test_names_that_are_not_unicode(tmp_path, line, mend):
    """Check that one line says so, where a library crashed."""
    status, _, said = in_shell(tmp_path, line)
    assert status == WRONG and f"this name is not Unicode: {mend}" in said and said.count("\n") == 1


def test_a_process_terminates_itself_on_windows(monkeypatch):
    """Check that the handler of SIGTERM is called, which writes a checkpoint: Windows' `os.kill` would call none."""
    heard = []
    before = process.signal.signal(process.signal.SIGTERM, lambda *_: heard.append(1))
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("ends the process at once"))
    try:
        process.terminate()
    finally:
        process.signal.signal(process.signal.SIGTERM, before)
    assert heard == [1]
