"""The trainer's own Python environment: where it is, what it takes, and the process that makes it. Nothing here needs bpy.

Run as a program, this file speaks as the trainer's process does (docs/job-protocol.md): one command comes in, `install` or `remove`.
It ends, with what it has started, when its input does, so when Blender does, however that ends. Nothing is broken by that:
an environment counts once the file that says so has been written, last of all; what was fetched by then is still in uv's cache, and
the next installation goes on with it.
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

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

WHEELS = Path(__file__).resolve().parents[1] / "wheels"  # in a release's zip: the trainer's, and uv's for this platform
PYTHONS = ">=3.11,<3.14"  # as in pyproject.toml
GB = 1e9
NEEDED, NEEDED_WITH_CARD = 2 * GB, 7 * GB  # torch's builds for CUDA bring CUDA's libraries

# ---- What Blender asks


def wheel(name: str) -> Path | None:
    """A package that this copy of the add-on brings; None in a clone, which brings none."""
    return next(WHEELS.glob(f"{name}-*.whl"), None)


def brought() -> str:
    """The version of the trainer that this copy of the add-on brings, or ""."""
    file = wheel("refgs") if wheel("uv") else None
    return file.name.split("-")[1] if file else ""


def installed(home: Path) -> str:
    """The version of the trainer that is installed there, or ""."""
    try:
        return _mark(home).read_text(encoding="utf-8")
    except OSError:
        return ""


def begun(home: Path) -> bool:
    """Whether an installation was stopped halfway."""
    return not installed(home) and (home / "cache").is_dir()


def python(home: Path) -> Path:
    """The environment's Python."""
    return home / "env" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def needed() -> float:
    """How many bytes an installation takes, about. uv finds out more exactly which card there is; its own last way is this."""
    return NEEDED_WITH_CARD if shutil.which("nvidia-smi") else NEEDED


def free(home: Path) -> float:
    """How many bytes are free there."""
    return shutil.disk_usage(next(folder for folder in (home, *home.parents) if folder.is_dir())).free


def room(home: Path) -> str:
    """What an installation takes, and what there is."""
    return f"it needs about {needed() / GB:.0f} GB; {free(home) / GB:.0f} GB are free"


def too_full(home: Path) -> str:
    """A line for the artist where the disk has no room for what is still missing, or ""."""
    if installed(home) or free(home) + size(home) >= needed():
        return ""
    return f"the disk that {home} is on is too full ({room(home)}): free some of it, or choose a Python that has the trainer"


def size(folder: Path) -> int:
    """Bytes of the files in a folder."""
    total = 0
    for path, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # uv renames what it has unpacked
                total += os.lstat(os.path.join(path, name)).st_size
    return total


def _mark(home: Path) -> Path:
    return home / "installed"


# ---- The process

_saying = threading.Lock()
_starting = threading.Lock()
_child: subprocess.Popen | None = None


class _Failed(Exception):
    """One line for the artist."""


def work() -> None:
    """Read one command, do it, and say how it went."""
    command = json.loads(sys.stdin.readline() or "null")
    if command is None:
        return
    threading.Thread(target=end_with_input, daemon=True).start()
    job = command.pop("command")
    _say("started", job=job)
    try:
        with _alone(Path(command["home"])):
            {"install": _install, "remove": _remove}[job](**{key: Path(path) for key, path in command.items()})
    except _Failed as error:
        _say("failed", job=job, what=str(error))
    except OSError as error:
        where = command["home"]
        _say(
            "failed", job=job, what=explain(f"os error {error.errno}", where) or f"{where}: {error}: the log says more"
        )
    else:
        _say("done", job=job)


def _say(event: str, **facts) -> None:
    with _saying:
        print(json.dumps({"event": event} | facts), flush=True)


def end_with_input() -> None:
    """End this process, with what it has started, when its input does: for a thread of its own."""
    sys.stdin.read()
    with _starting:  # nothing more is started after this
        if _child is not None:
            _child.kill()
        os._exit(1)


@contextlib.contextmanager
def _alone(home: Path) -> Iterator[None]:
    """While no other Blender installs there. The lock is the system's: it goes with this process, however that ends."""
    home.parent.mkdir(parents=True, exist_ok=True)
    with open(home.with_name(f"{home.name}.lock"), "ab") as file:
        try:
            if sys.platform == "win32":
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            raise _Failed("another Blender installs the trainer, or removes it: wait until it has done so") from None
        except OSError:  # a file system without locks
            pass
        yield


def _install(home: Path, uv: Path, trainer: Path) -> None:
    was = installed(home)
    _mark(home).unlink(missing_ok=True)
    home.mkdir(parents=True, exist_ok=True)
    program = _unpack(uv, home)
    variables = _variables(home)
    if not was:  # a newer release goes into what is there; what was left halfway cannot be told from what is whole
        _say("stage", what="Making a Python environment")
        _delete(home / "env")
        _uv(program, variables, home, "venv", "--python", PYTHONS, str(home / "env"))
    _say("stage", what="Looking up what the trainer needs")
    # --no-build: nothing is compiled on the artist's machine, where there may be no compiler.
    _uv(program, variables, home, "pip", "install", "--no-build", "--python", str(python(home)), str(trainer))
    _say("stage", what="Starting the trainer for the first time", part=0.99)
    _ask(python(home))
    _mark(home).write_text(trainer.name.split("-")[1], encoding="utf-8")
    program.unlink()
    _delete(home / "cache")


def _remove(home: Path) -> None:
    _mark(home).unlink(missing_ok=True)
    _delete(home)


def _unpack(uv: Path, home: Path) -> Path:
    """uv itself. Blender unpacks a wheel's modules where they are found, but leaves its programs where they are not, and not executable."""
    name = "uv.exe" if sys.platform == "win32" else "uv"
    program = home / name
    with zipfile.ZipFile(uv) as archive:
        inside = next(inside for inside in archive.namelist() if inside.endswith(f".data/scripts/{name}"))
        with archive.open(inside) as source, open(program, "wb") as target:
            shutil.copyfileobj(source, target)
    program.chmod(0o755)
    return program


def _variables(home: Path) -> dict[str, str]:
    """uv's environment. What the artist's studio has set, such as a mirror, goes before what is said here.

    The Python is one that uv fetches: Blender's own is gone with the next Blender, and a system's changes with its updates. The build of
    torch is the one for this machine's card or for none; an empty UV_TORCH_BACKEND takes the index's own, as mirrors have it.
    """
    set_here = {"UV_TORCH_BACKEND": "auto", "UV_PYTHON_INSTALL_DIR": str(home / "python")}
    if not os.environ.keys() & {
        "UV_PYTHON_PREFERENCE",
        "UV_MANAGED_PYTHON",
        "UV_NO_MANAGED_PYTHON",
    }:  # they exclude each other
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


def _uv(program: Path, variables: dict[str, str], home: Path, *words: str) -> None:
    """Run uv, and say what it is at. Raises _Failed with what is wrong and what to do."""
    options = ["--color", "never", "--cache-dir", str(home / "cache")]
    process = _start([str(program), *options, *words], stderr=subprocess.STDOUT, env=variables, cwd=home)
    fetching: dict[str, str] = {}  # sizes by names
    ended = threading.Event()
    threading.Thread(target=_say_size, args=(home, fetching, ended), daemon=True).start()
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
                _say("stage", what="Putting everything in its place", part=0.98)
    status = process.wait()
    ended.set()
    if status != 0:
        text = "\n".join(said)
        first = next((line for line in said if line.startswith("error: ")), f"error: uv ended with status {status}")
        raise _Failed(explain(text, str(home)) or f"{first.removeprefix('error: ')}: the log says more")


def _say_size(home: Path, fetching: dict[str, str], ended: threading.Event) -> None:
    """Say every other second what is being fetched and how much is here: torch alone takes minutes, of which uv says nothing."""
    while not ended.wait(2):
        now = list(fetching.items())
        if now:
            name, amount = now[0]
            others = f" and {len(now) - 1} more" if len(now) > 1 else ""
            have, all_ = size(home / "cache"), needed()
            of = f" of about {all_ / GB:.0f}" if have < all_ else ""  # a mirror may have torch's largest build alone
            what = f"Fetching {name} ({amount}){others}: {have / GB:.1f}{of} GB"
            if fetching:  # still
                _say("stage", what=what, part=min(have / all_, 0.97))


def _ask(python: Path) -> None:
    """Have the trainer say that it is ready: only what answers has been installed."""
    process = _start([str(python), "-E", "-m", "refgs.cli", "worker"])
    heard = process.communicate()[0].splitlines()
    event = json.loads(heard[0]) if process.returncode == 0 and heard else {}
    if event.get("event") != "ready":
        raise _Failed("all is installed, but the trainer does not start on this machine: the log says why")
    _say(**event)


def explain(text: str, home: str) -> str:
    """What uv's errors mean for the artist: one line, or "" where it is none of those that can be mended from here."""
    lower = text.lower()
    if re.search(r"no space left|os error (28|112|122)\b", lower):
        return f"the disk that {home} is on is full: free some of it and go on"
    if re.search(r"permission denied|access is denied|os error (5|13|30|32)\b", lower):
        return f"{home} cannot be written to: end what uses it, or see to its permissions, and go on"
    if "no solution found" in lower:
        return "the trainer needs a package that there is none of for this machine: the log says which"
    if re.search(r"failed to (fetch|download)|request failed|error sending request|timed? ?out", lower):
        host = re.search(r"https?://([^/:\s`]+)", text)
        what = f"{host[1]} cannot be reached" if host else "the network cannot be reached"
        return f"{what}: see to the connection, or have the firewall allow it, and go on"
    return ""


def _delete(folder: Path) -> None:
    if sys.platform == "win32":
        folder = Path(f"\\\\?\\{folder.resolve()}")  # torch's paths may be longer than Windows takes otherwise
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(folder)


if __name__ == "__main__":
    sys.stdin.reconfigure(encoding="utf-8")
    work()
