"""Find the program's own files. Write files so that a failed write leaves no half-written file."""

import errno
import hashlib
import os
import re
import secrets
import shlex
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path

from refgs.errors import InputError, TryAgain

# Bytes of a text file, or of another that is read as a whole. Python takes up to 20 times as much memory for what it holds.
LARGEST = 64 << 20
PACKAGE = Path(__file__).resolve().parent
ROOT = PACKAGE.parents[1]
PRESETS = PACKAGE / "presets" if (PACKAGE / "presets").is_dir() else ROOT / "presets"  # in a wheel, in a clone
# A disk is full, read-only or broken, or a path leads nowhere that can be written.
DISK_ERRORS = tuple(
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EFBIG", "EIO", "EROFS", "EACCES", "EPERM", "ESTALE", "ENODEV"),
        *("ENOTDIR", "EISDIR", "ENAMETOOLONG", "ELOOP", "EBUSY"),
    )
    if hasattr(errno, name)
)
# A file system has no locks. Any other error means that a lock may be held: by another user, say.
_NO_LOCKS = "ENOLCK", "ENOSYS", "ENOTSUP", "EOPNOTSUPP"
NO_LOCKS = tuple(getattr(errno, name) for name in _NO_LOCKS if hasattr(errno, name))
PAUSES = (0.05, 0.15, 0.3, 0.5)  # seconds between attempts to rename a file
_TEMPORARY = re.compile(r"\.refgs-[0-9a-f]{16}\.tmp")


@contextmanager
def whole(path: str | os.PathLike, durable: bool = True) -> Iterator[Path]:
    """Write a file completely or not at all.

    Yields the path of an empty temporary file in the same folder, to write to. The file is renamed to `path` at the end of the `with`
    block, or deleted if the block raises an error. A killed process leaves it behind: see `remove_leftovers`.

    The file is on the disk when the block ends, so that it outlives a power failure. `durable=False` saves the milliseconds that this
    takes, for files that nobody needs after a power failure.
    """
    path = Path(path)
    temporary = path.with_name(f".refgs-{secrets.token_hex(8)}.tmp")
    try:
        # Create it here: no other writer has this name, and a link that somebody put there is not followed.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0), 0o666))
        yield temporary
        if durable:
            _sync(temporary, os.O_RDWR)  # Windows refuses to sync what is open for reading
        _replace(temporary, path)
        if durable and os.name == "posix":  # nowhere else can a folder be opened
            with suppress(OSError):  # some network file systems sync no folder
                _sync(path.parent, os.O_RDONLY)
    except OSError as error:
        if str(error.filename) == str(temporary):  # a name that tells the user nothing
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _replace(source: Path, target: Path) -> None:
    """Rename `source` to `target`, retrying while Windows refuses to replace it."""
    for pause in PAUSES:
        try:
            return os.replace(source, target)
        except PermissionError:
            time.sleep(pause)
    os.replace(source, target)


def remove_leftovers(folder: Path) -> None:
    """Remove killed processes' temporary files of `whole` below a folder that nobody writes to."""
    for file in folder.rglob("*.tmp"):
        if is_leftover(file):
            with suppress(OSError):
                file.unlink()


def is_leftover(file: Path) -> bool:
    """Return True if a file's name is that of a temporary file that `whole` makes."""
    return _TEMPORARY.fullmatch(file.name) is not None


def _sync(path: Path, flags: int) -> None:
    opened = os.open(path, flags)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def write_text(file: Path, text: str, durable: bool = True) -> None:
    """Write a UTF-8 text file completely or not at all (see `whole`)."""
    with whole(file, durable) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_text(file: Path, again: str) -> str:
    """Read a text file. Raises InputError if it is missing, not UTF-8 text, or larger than LARGEST bytes.

    `again` is a sentence for the user at the end of the error's message, such as "Train again.".
    """
    try:
        with open_file(file) as source:
            data = source.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise InputError(f"{file}: larger than such a file can be. {again}")
        return data.decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{file}: there is no such file. {again}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: cannot be read as text, which must be UTF-8 ({error.reason}). {again}") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}). {again}") from None


def open_file(file: str | os.PathLike) -> BufferedReader:
    """Open a regular file to read its bytes.

    Raises OSError if it cannot be read, or if it is a folder, a pipe, a socket or a device, which may have no end.
    """
    _check_kind(os.stat(file), file)  # first: opening is what starts some devices
    # Another may have taken its place since. A pipe without a writer is not waited for.
    opened = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check_kind(os.fstat(opened), file)
        return open(opened, "rb")
    except BaseException:
        os.close(opened)
        raise


def check_file(file: str | os.PathLike) -> None:
    """Raise OSError unless a path leads to a regular file that is not empty. Call this before a library opens the path.

    Linux's /proc has regular files whose size is 0, but which may have no end.
    """
    facts = os.stat(file)
    _check_kind(facts, file)
    if not facts.st_size:
        raise OSError(errno.EINVAL, "the file is empty", str(file))


def _check_kind(facts: os.stat_result, file: str | os.PathLike) -> None:
    if not stat.S_ISREG(facts.st_mode):
        raise OSError(errno.EINVAL, "this is not a file", str(file))


def hash_file(file: Path, kind: Callable = hashlib.blake2b) -> "hashlib._Hash":
    """Hash the content of a file with the hash function `kind`. Returns hashlib's object, which can be updated further.

    Raises OSError if the file cannot be read, or if it is a folder, a pipe or a device.
    """
    with open_file(file) as opened:
        return hashlib.file_digest(opened, kind)


def read_bytes(file: Path) -> bytes:
    """Read a file. Raises OSError if it cannot be opened or exceeds LARGEST bytes."""
    with open_file(file) as opened:
        data = opened.read(LARGEST + 1)
    if len(data) > LARGEST:
        raise OSError(errno.EINVAL, "larger than such a file can be", str(file))
    return data


@contextmanager
def disk_errors_named(folders: list[Path], again: str) -> Iterator[None]:
    """Raise TryAgain for disk errors in a `with` block. The message names the folder whose disk is full, read-only or gone.

    The block writes to `folders`, which must exist. If `folders` is empty, the message says that the disk "cannot be read or written". The
    message contains `again`, which tells the user how to continue when the disk works again.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if gone := next((folder for folder in folders if not folder.is_dir()), None):
            raise TryAgain(f"{gone} is no longer there: put its disk back, then {again}") from error
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            where = error.filename or next(iter(folders), "the disk")
            why = f"{where} cannot be {'written' if folders else 'read or written'} ({error.strerror})"
            raise TryAgain(f"{why}: mend that, then {again}; files written before are complete") from error
        raise


def make_folders(folders: list[Path]) -> None:
    """Make folders that are missing, and their parents. Raise InputError if that fails."""
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: the folder cannot be made ({error.strerror}): choose another") from None


def check_room(folder: Path) -> None:
    """Raise OSError if a file of eight megabytes cannot be written to a folder."""
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(8 << 20))


def check_folder(folder: Path) -> None:
    """Raise InputError if a capture's folder is missing, a file or a run folder, or its path is not Unicode."""
    if folder.is_file():
        raise InputError(f"{folder}: this is a file. Name the folder that holds it; refgs frames makes one of a film.")
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder. Name the folder that holds the capture.")
    if (folder / "run.toml").is_file():  # its textures would be taken for photos
        raise InputError(f"{folder} is a run, not a capture: name the folder of the photos that it was trained on.")
    check_unicode(folder)


def check_unicode(path: Path) -> None:
    """Raise InputError if a path is not Unicode."""
    # JSON, TOML and HTML cannot hold such a name.
    try:
        str(path.resolve()).encode()
    except UnicodeEncodeError:
        raise InputError(f"{path.resolve()}: this name is not Unicode: rename the file or folder") from None


def command_line(*words: object) -> str:
    """Return a command quoted for the user's shell."""
    join = subprocess.list2cmdline if sys.platform == "win32" else shlex.join
    return join([str(word) for word in words])


def clone_environment() -> dict[str, str]:
    """Return environment variables that let Python import modules from its current folder."""
    return os.environ | {"PYTHONSAFEPATH": ""}


def clone_root() -> Path:
    """Return the root of the repository. Raise InputError if the program was installed without it.

    The benchmark scenes and the Blender extension are in the repository, but not in the installed package.
    """
    if not (ROOT / "blender_manifest.toml").exists():
        raise InputError("this needs the whole repository: clone it and install with `pip install -e .` from there")
    return ROOT
