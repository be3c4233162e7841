"""Install the trainer into a Python environment of its own, or remove it. This module needs no bpy.

Blender also runs this file as a separate process. That process reads one command, `install` or `remove`, from stdin, and prints events to
stdout (docs/job-protocol.md). When Blender ends, stdin closes: the process then kills the program that it has started, and exits.

The installed packages are those of the release: the add-on's zip has lock files with the version and the SHA-256 of every package.

An interrupted installation does no harm. The last step writes a marker file, and without that file the trainer counts as not installed.
Finished downloads stay in uv's cache for the next installation.
"""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

WHEELS = (
    Path(__file__).resolve().parents[1] / "wheels"
)  # in a release's zip: the wheels of the trainer and of uv for this platform, and the locks
PYTHONS = ">=3.11,<3.14"  # as in pyproject.toml
GB = 1e9
NEEDED, NEEDED_WITH_CARD = 2 * GB, 7 * GB  # torch's CUDA builds include CUDA's libraries

# ---- Called by Blender


def wheel(name: str) -> Path | None:
    """Return the add-on's bundled wheel of the package `name`, or None if there is none."""
    return next(WHEELS.glob(f"{name}-*.whl"), None)


def bundled_version() -> str:
    """Return the version of the trainer that comes with the add-on, or "" if none."""
    file = wheel("refgs") if wheel("uv") else None
    return file.name.split("-")[1] if file else ""


def installed(home: Path) -> str:
    """Return the version of the trainer installed in the folder `home`, or "" if none."""
    try:
        return _marker(home).read_text(encoding="utf-8")
    except OSError:
        return ""


def origin(home: Path) -> str:
    """Return the sentence on where the installed packages came from, or "" if none."""
    try:
        return (home / "origin").read_text(encoding="utf-8")
    except OSError:
        return ""


def interrupted(home: Path) -> bool:
    """Check whether an installation into the folder `home` was stopped halfway."""
    return not installed(home) and (home / "cache").is_dir()


def python(home: Path) -> Path:
    """Return the path of Python in the environment of the trainer installed in `home`."""
    return home / "env" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def needed_bytes() -> float:
    """Estimate the disk space in bytes that the trainer needs. It needs more with torch's CUDA build.

    The CUDA build is expected in two cases:
    - The machine has nvidia-smi.
    - On Linux, the add-on has lock files (lists of exact package versions), but none for torch's CPU build. Then torch comes from the
      package index, which has only the CUDA build for Linux.
    """
    locked = sys.platform == "linux" and (WHEELS / "lock.txt").is_file() and not (WHEELS / "lock-cpu.txt").is_file()
    return NEEDED_WITH_CARD if locked or shutil.which("nvidia-smi") else NEEDED


def free_bytes(home: Path) -> float:
    """Return the free bytes on the disk of a folder that may not exist yet."""
    return shutil.disk_usage(next(folder for folder in (home, *home.parents) if folder.is_dir())).free


def space_line(home: Path) -> str:
    """Describe the needed and the free disk space as part of a sentence."""
    return f"it needs about {needed_bytes() / GB:.0f} GB; {free_bytes(home) / GB:.0f} GB are free"


def disk_full_line(home: Path) -> str:
    """Return an error message if the disk lacks space to complete the installation, else ""."""
    if installed(home) or free_bytes(home) + folder_bytes(home) >= needed_bytes():
        return ""
    return f"too little space on the disk of {home} ({space_line(home)}): free some, or choose a Python that has the trainer"


def folder_bytes(folder: Path) -> int:
    """Add up the bytes of the files in a folder and its subfolders."""
    total = 0
    for path, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # uv may have renamed the file
                total += os.lstat(os.path.join(path, name)).st_size
    return total


def _marker(home: Path) -> Path:
    return home / "installed"


# ---- The process

_emitting = threading.Lock()
_starting = threading.Lock()
_child: subprocess.Popen | None = None


class _Failed(Exception):
    """End the command with an error, whose text is shown to the artist."""


def main() -> None:
    """Read one command from stdin, run it, and print its events to stdout."""
    command = json.loads(sys.stdin.readline() or "null")
    if command is None:
        return
    threading.Thread(target=_exit_with_stdin, daemon=True).start()
    job = command.pop("command")
    _emit("started", job=job)
    try:
        with _locked(Path(command["home"])):
            {"install": _install, "remove": _remove}[job](**{key: Path(path) for key, path in command.items()})
    except _Failed as error:
        _emit("failed", job=job, what=str(error))
    except OSError as error:
        where = command["home"]
        _emit(
            "failed",
            job=job,
            what=explain_uv_error(f"os error {error.errno}", where) or f"{where}: {error}: see the log",
        )
    else:
        _emit("done", job=job)


def _emit(event: str, **facts) -> None:
    with _emitting:
        print(json.dumps({"event": event} | facts), flush=True)


def _exit_with_stdin() -> None:
    """Wait for the end of stdin, then kill the child process and exit."""
    sys.stdin.read()
    with _starting:  # no child is started after this
        if _child is not None:
            _child.kill()
        os._exit(1)


@contextlib.contextmanager
def _locked(home: Path) -> Iterator[None]:
    """Lock the installation against other processes, or raise _Failed if one has locked it."""
    home.parent.mkdir(parents=True, exist_ok=True)
    with open(home.with_name(f"{home.name}.lock"), "ab") as file:
        try:
            if sys.platform == "win32":
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            raise _Failed("another Blender installs or removes the trainer: wait until it has finished") from None
        except OSError:  # a file system without locks
            pass
        yield


def _install(home: Path, uv: Path, trainer: Path) -> None:
    was = installed(home)
    _marker(home).unlink(missing_ok=True)
    home.mkdir(parents=True, exist_ok=True)
    program = _unpack(uv, home)
    variables = _uv_environment(home)
    if not was:  # update an environment in place; start an interrupted one anew, as it may be broken
        _emit("stage", what="Making a Python environment")
        _delete(home / "env")
        _run_uv(program, variables, home, "venv", "--python", PYTHONS, str(home / "env"))
    _emit("stage", what="Resolving the trainer's dependencies")
    # --no-build: the artist's machine may have no compiler.
    install = ["pip", "install", "--no-build", "--python", str(python(home))]
    if trainer.with_name("lock.txt").is_file():
        lock = _choose_lock(program, variables, home, trainer.parent)
        # --no-deps: the lock is complete, and leaves out packages that others only declare (see pyproject.toml).
        _run_uv(program, variables, home, *install, "--no-deps", "--require-hashes", "--requirements", str(lock))
        _run_uv(program, variables, home, *install, "--no-deps", str(trainer))
        said = _describe_origin(_resolve(program, variables, home, lock))
    else:
        said = "This add-on has no lock of a release: the packages were not checked"
        _run_uv(program, variables, home, *install, f"{trainer}[farm]")
    _emit("stage", what=said, part=0.99)
    print(said, file=sys.stderr, flush=True)  # the log
    _emit("stage", what="Starting the trainer for the first time", part=0.99)
    _start_trainer(python(home))
    (home / "origin").write_text(said, encoding="utf-8")
    _marker(home).write_text(trainer.name.split("-")[1], encoding="utf-8")
    with contextlib.suppress(OSError):  # Windows removes no open file: the trainer is installed all the same
        program.unlink()
        _delete(home / "cache")


def _choose_lock(program: Path, variables: dict[str, str], home: Path, locks: Path) -> Path:
    """Choose this machine's lock file in `locks`, and change UV_TORCH_BACKEND in `variables` to match."""
    lock, wanted = locks / "lock.txt", home / "torch.txt"
    if "UV_TORCH_BACKEND" not in variables or not (pinned := re.search(r"^torch==\S+", lock.read_text(), re.M)):
        return lock
    wanted.write_text(pinned[0], encoding="utf-8")
    try:
        version, _ = _resolve(program, variables, home, wanted)["torch"]
    finally:
        wanted.unlink()
    build = version.partition("+")[2]
    if build and (locks / f"lock-{build}.txt").is_file():
        variables["UV_TORCH_BACKEND"] = build
        return locks / f"lock-{build}.txt"
    del variables["UV_TORCH_BACKEND"]
    if build:
        what = f"torch's build {build} is not in the release's lock: taking torch from the package index"
        _emit("stage", what=what)
        print(what, file=sys.stderr, flush=True)  # the log
    return lock


def _resolve(program: Path, variables: dict[str, str], home: Path, requirements: Path) -> dict[str, tuple[str, str]]:
    """Ask uv for the (version, package index) of each package that the file `requirements` names."""
    how = ["--no-deps", "--no-header", "--no-annotate", "--emit-index-annotation", "--python", str(python(home))]
    said = _run_uv(program, variables, home, "pip", "compile", *how, str(requirements))
    return {name: (version, index) for name, version, index in re.findall(r"(?m)^(\S+)==(\S+)\n +# from (.+)$", said)}


def _describe_origin(packages: dict[str, tuple[str, str]]) -> str:
    """Describe for the artist how many of `_resolve`'s packages came from which host."""
    hosts: dict[str, list[str]] = {}
    for name, (version, index) in packages.items():
        hosts.setdefault(urlsplit(index).hostname or index, []).append(f"{name} {version}")
    torch = next((named for names in hosts.values() for named in names if named.startswith("torch ")), "")
    listed = ", ".join(
        f"{len(names)} from {host}{f' ({torch})' if torch in names else ''}" for host, names in hosts.items()
    )
    return f"All packages are those of the release, by their hashes: {listed}"


def _remove(home: Path) -> None:
    _marker(home).unlink(missing_ok=True)
    _delete(home)


def _unpack(uv: Path, home: Path) -> Path:
    """Unpack uv's program from its wheel, and make it executable."""
    name = "uv.exe" if sys.platform == "win32" else "uv"
    program = home / name
    with zipfile.ZipFile(uv) as archive:
        inside = next(inside for inside in archive.namelist() if inside.endswith(f".data/scripts/{name}"))
        with archive.open(inside) as source, open(program, "wb") as target:
            shutil.copyfileobj(source, target)
    program.chmod(0o755)
    return program


def _uv_environment(home: Path) -> dict[str, str]:
    """Return the environment variables for uv; those that the user has set keep their values."""
    # "auto" lets uv choose the build of torch for this machine's GPU. With some package mirrors torch must come from the package index:
    # then the user sets UV_TORCH_BACKEND to "". Blender's Python or the system's would not do, because an update may replace it.
    set_here = {"UV_TORCH_BACKEND": "auto", "UV_PYTHON_INSTALL_DIR": str(home / "python")}
    if not os.environ.keys() & {
        "UV_PYTHON_PREFERENCE",
        "UV_MANAGED_PYTHON",
        "UV_NO_MANAGED_PYTHON",
    }:  # mutually exclusive
        set_here["UV_PYTHON_PREFERENCE"] = "only-managed"
    variables = {key: value for key, value in (set_here | os.environ).items() if not key.startswith("PYTHON")}
    if not variables["UV_TORCH_BACKEND"]:
        del variables["UV_TORCH_BACKEND"]
    return variables


def _start(words: list[str], **how) -> subprocess.Popen:
    global _child
    with _starting:
        _child = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, **how)
    return _child


def _run_uv(program: Path, variables: dict[str, str], home: Path, *arguments: str) -> str:
    """Run uv, report its progress and return its output, or raise _Failed if it fails."""
    options = ["--color", "never", "--cache-dir", str(home / "cache")]
    process = _start([str(program), *options, *arguments], stderr=subprocess.STDOUT, env=variables, cwd=home)
    fetching: dict[str, str] = {}  # size by package
    ended = threading.Event()
    threading.Thread(target=_report_download, args=(home, fetching, ended), daemon=True).start()
    said = []
    for line in process.stdout:
        said.append(line.decode(errors="replace").rstrip())
        print(said[-1], file=sys.stderr, flush=True)  # the log
        match said[-1].split():
            case ["Downloading", name, amount]:
                fetching[name] = amount.strip("()")
            case ["Downloaded", name]:
                fetching.pop(name, None)
            case ["Prepared", *_]:
                fetching.clear()
                _emit("stage", what="Installing the packages", part=0.98)
    status = process.wait()
    ended.set()
    text = "\n".join(said)
    if status != 0:
        first = next((line for line in said if line.startswith("error: ")), f"error: uv ended with status {status}")
        raise _Failed(explain_uv_error(text, str(home)) or f"{first.removeprefix('error: ')}: see the log")
    return text


def _report_download(home: Path, fetching: dict[str, str], ended: threading.Event) -> None:
    """Report the progress of the downloads in `fetching` every two seconds until `ended` is set."""
    # uv prints nothing while it downloads torch, which takes minutes: the progress is the size of its cache.
    while not ended.wait(2):
        now = list(fetching.items())
        if now:
            name, amount = now[0]
            others = f" and {len(now) - 1} more" if len(now) > 1 else ""
            have, expected = folder_bytes(home / "cache"), needed_bytes()
            of = (
                f" of about {expected / GB:.0f}" if have < expected else ""
            )  # a mirror may have only torch's largest build
            what = f"Fetching {name} ({amount}){others}: {have / GB:.1f}{of} GB"
            if fetching:  # may have ended meanwhile
                _emit("stage", what=what, part=min(have / expected, 0.97))


def _start_trainer(python: Path) -> None:
    """Start the trainer once to print its version and GPU, or raise _Failed."""
    process = _start([str(python), "-E", "-P", "-m", "refgs.cli", "worker"])
    heard = process.communicate()[0].splitlines()
    event = json.loads(heard[0]) if process.returncode == 0 and heard else {}
    if event.get("event") != "ready":
        raise _Failed("the trainer is installed but does not start on this machine: see the log")
    _emit(**event)


def explain_uv_error(text: str, home: str) -> str:
    """Turn uv's output into an error message for the artist, or "" if unknown."""
    lower = text.lower()
    if wrong := re.search(r"Hash mismatch for `([^`]+)`", text):
        what = f"{wrong[1]}: the file that was fetched is not the one that was released (its SHA-256 is another)"
        return f"{what}: resume to fetch it again, and ask whoever runs the package mirror if this repeats"
    if re.search(r"no space left|os error (28|112|122)\b", lower):
        return f"the disk of {home} is full: free some space and resume"
    if re.search(r"permission denied|access is denied|os error (5|13|30|32)\b", lower):
        return f"cannot write to {home}: close programs that use it or fix its permissions, and resume"
    if "no solution found" in lower:
        return "a package of the trainer does not exist for this machine: see the log"
    if re.search(r"failed to (fetch|download)|request failed|error sending request|timed? ?out", lower):
        host = re.search(r"https?://([^/:\s`]+)", text)
        what = f"{host[1]} cannot be reached" if host else "the network cannot be reached"
        return f"{what}: check the connection and the firewall, and resume"
    return ""


def _delete(folder: Path) -> None:
    if sys.platform == "win32":
        folder = Path(f"\\\\?\\{folder.resolve()}")  # lifts Windows' limit on path length, which torch exceeds
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(folder)


if __name__ == "__main__":
    sys.stdin.reconfigure(encoding="utf-8")
    main()
