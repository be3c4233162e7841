"""Compile the C++ kernels to a shared library, with the compiler in the `ziglang` wheel.

Each platform and instruction set has its own library.
"""

import hashlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import platformdirs
from filelock import FileLock

from refgs.errors import InputError
from refgs.paths import NO_LOCKS

HERE = Path(__file__).parent
WITH_PARENT = str(HERE / "with_parent.py")  # runs a program that ends with this process
SOURCES, HEADERS = (sorted(file.name for file in HERE.glob(pattern)) for pattern in ("*.cpp", "*.h"))
# -ffp-contract=on fuses a product and a sum within an expression, never across: a formula rounds the same wherever it is inlined.
FLAGS = ["-shared", "-s", "-O3", "-std=c++20", "-fno-exceptions", "-fno-rtti", "-nostdlib", "-fvisibility=hidden"]
FLAGS += ["-fno-builtin", "-ffp-contract=on", "-fno-math-errno", "-mprefer-vector-width=512"]


@dataclass(frozen=True)
class Target:
    """Describe what a library is compiled for: Zig's platform and processor, and a file extension."""

    platform: str
    processor: str
    extension: str


X86 = {"sse4": "x86_64_v2", "avx2": "x86_64_v3", "avx512": "x86_64_v4"}
ARM = {"neon": "baseline"}
TARGETS = {
    ("linux", "x86_64"): ("x86_64-linux-gnu.2.17", "so", X86),
    ("linux", "aarch64"): ("aarch64-linux-gnu.2.17", "so", ARM),
    ("win32", "x86_64"): ("x86_64-windows-gnu", "dll", X86),
    ("darwin", "aarch64"): ("aarch64-macos.11.0", "dylib", ARM),
}


def target(system: str, machine: str, isa: str) -> Target:
    """Return the compiler's target for a platform, a machine and an instruction set.

    `system` is `sys.platform`, `machine` is "x86_64" or "aarch64", `isa` is "sse4", "avx2", "avx512" or "neon". Raises InputError for a
    platform without kernels.
    """
    if (system, machine) not in TARGETS:
        known = ", ".join(" ".join(one) for one in TARGETS)
        raise InputError(f"there are no kernels for {system} {machine}: train on one of {known}")
    platform, extension, processors = TARGETS[system, machine]
    return Target(platform, processors[isa], extension)


def cache_folder() -> Path:
    """Return the folder for compiled kernels: REFGS_CACHE, or one in the user's cache."""
    return Path(os.environ.get("REFGS_CACHE") or platformdirs.user_cache_dir("refgs", appauthor=False))


def _fingerprint(target: Target) -> str:
    digest = hashlib.sha256(repr((target, FLAGS, importlib.metadata.version("ziglang"))).encode())
    for name in (*SOURCES, *HEADERS):
        digest.update((HERE / name).read_bytes())
    return digest.hexdigest()[:16]


def sizes() -> dict[str, int]:
    """Return the number of integer arguments of each C++ function that returns one integer, by the function's name.

    Such a function returns a buffer's size, for example. Python needs the number of arguments to declare and call the function.
    """
    text = "".join((HERE / source).read_text(encoding="utf-8") for source in SOURCES)
    found = re.findall(r"^EXPORT int64_t (\w+)\((.*?)\)", text, re.MULTILINE)
    return {name: parameters.count("int64_t") for name, parameters in found}


def unwritable(cache: Path, error: OSError) -> InputError:
    """Return an InputError that says why `cache` cannot be written, and what to do."""
    return InputError(
        f"cannot write compiled kernels to {cache}: {error.strerror}; set REFGS_CACHE to a folder that can be written"
    )


def build(target: Target, cache: Path) -> Path:
    """Compile the kernels for a target to a library in `cache`, unless it is already there. Returns the library's path.

    Several processes may call this at the same time. Raises InputError if `cache` cannot be written.
    """
    library = cache / f"refgs-{_fingerprint(target)}.{target.extension}"
    if library.exists():
        return library
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with _sole_build(cache):
            if not library.exists():  # another process may have made it meanwhile
                _compile(target, library)
    except OSError as error:
        raise unwritable(cache, error) from None
    return library


@contextmanager
def _sole_build(cache: Path) -> Iterator[None]:
    """Lock `cache` for one build, and remove remains of killed ones; may raise OSError."""
    file = cache / "build.lock"
    lock = FileLock(file)
    try:
        lock.acquire()
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        yield
        return
    try:
        for left in cache.glob("build-*"):
            shutil.rmtree(left, ignore_errors=True)
        yield
    finally:
        with suppress(OSError):  # Windows deletes no open file: there filelock deletes it
            file.unlink()
        lock.release()


def _compile(target: Target, library: Path) -> None:
    """Compile the kernels beside the file `library`, then move the result there."""
    with tempfile.TemporaryDirectory(prefix="build-", dir=library.parent, ignore_cleanup_errors=True) as scratch:
        made = Path(scratch) / library.name
        command = [sys.executable, "-P", "-m", "ziglang", "c++", *FLAGS]
        command += ["-target", target.platform, f"-mcpu={target.processor}"]
        if target.extension != "dll":
            command.append("-fPIC")
        if target.extension == "so":
            command.append("-Wl,-z,defs")  # every symbol is defined here, as elsewhere without being asked
        # Zig's own cache is deleted with the scratch folder: it takes tens of megabytes and saves nothing the next time.
        environment = os.environ | {"ZIG_LOCAL_CACHE_DIR": scratch, "ZIG_GLOBAL_CACHE_DIR": scratch}
        with subprocess.Popen(
            [sys.executable, "-P", WITH_PARENT, *command, *SOURCES, "-o", str(made)],
            cwd=HERE,
            env=environment,
            stdin=subprocess.PIPE,  # closed when this process ends
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        ) as compiler:
            said = "".join(compiler.stdout or ())
        if compiler.returncode != 0:
            raise RuntimeError(f"compiling the kernels for {target} failed:\n{said}")
        os.replace(made, library)
