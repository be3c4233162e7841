"""Compile the C++ kernels with the compiler in the `ziglang` wheel: one shared library a platform and instruction set."""

import hashlib
import importlib.metadata
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from refgs.errors import InputError

HERE = Path(__file__).parent
SOURCES = (
    "activate.cpp",
    "adam.cpp",
    "blend.cpp",
    "carve.cpp",
    "harmonics.cpp",
    "losses.cpp",
    "motion.cpp",
    "normals.cpp",
    "peak.cpp",
    "project.cpp",
    "shade.cpp",
    "sparse.cpp",
    "ssim.cpp",
    "stack.cpp",
)
HEADERS = (
    "blended.h",
    "device.h",
    "lane.h",
    "library.h",
    "light.h",
    "pixels.h",
    "project.h",
    "raster.h",
    "rows.h",
    "splat.h",
    "sums.h",
    "vector.h",
)
# -ffp-contract=on: fused within an expression, never across, so that a formula rounds the same wherever it is inlined.
FLAGS = ["-shared", "-s", "-O3", "-std=c++20", "-fno-exceptions", "-fno-rtti", "-nostdlib", "-fvisibility=hidden"]
FLAGS += ["-fno-builtin", "-ffp-contract=on", "-fno-math-errno", "-mprefer-vector-width=512"]


@dataclass(frozen=True)
class Target:
    """What a library is compiled for: Zig's names of the platform and of the processor."""

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
    """The target of `sys.platform`, a machine ("x86_64" or "aarch64") and "sse4", "avx2", "avx512" or "neon"."""
    platform, extension, processors = TARGETS[system, machine]
    return Target(platform, processors[isa], extension)


def cache_folder() -> Path:
    """Where compiled kernels are kept: the environment variable REFGS_CACHE, else the user's cache."""
    return Path(os.environ.get("REFGS_CACHE") or platformdirs.user_cache_dir("refgs", appauthor=False))


def _fingerprint(target: Target) -> str:
    digest = hashlib.sha256(repr((target, FLAGS, importlib.metadata.version("ziglang"))).encode())
    for name in SOURCES + HEADERS:
        digest.update((HERE / name).read_bytes())
    return digest.hexdigest()[:16]


def unwritable(cache: Path, error: OSError) -> InputError:
    """What to say where compiled kernels cannot be kept."""
    return InputError(
        f"cannot write compiled kernels to {cache}: {error.strerror}; set REFGS_CACHE to a folder that can be written"
    )


def build(target: Target, cache: Path) -> Path:
    """The library for a target, compiled into `cache` if it isn't there yet. Safe when several processes want it at once.

    Raises InputError where `cache` can't be written.
    """
    library = cache / f"refgs-{_fingerprint(target)}.{target.extension}"
    if library.exists():
        return library
    try:
        cache.mkdir(parents=True, exist_ok=True)
        scratch = tempfile.TemporaryDirectory(prefix="build-", dir=cache)
    except OSError as error:
        raise unwritable(cache, error) from None
    with scratch:
        made = Path(scratch.name) / library.name
        command = [
            sys.executable,
            "-m",
            "ziglang",
            "c++",
            *FLAGS,
            "-target",
            target.platform,
            f"-mcpu={target.processor}",
        ]
        if target.extension != "dll":
            command.append("-fPIC")
        # Zig's own cache goes with the scratch folder: tens of megabytes that save nothing the next time.
        environment = os.environ | {"ZIG_LOCAL_CACHE_DIR": scratch.name, "ZIG_GLOBAL_CACHE_DIR": scratch.name}
        done = subprocess.run(
            [*command, *SOURCES, "-o", str(made)], cwd=HERE, env=environment, capture_output=True, text=True
        )
        if done.returncode != 0:
            raise RuntimeError(f"compiling the kernels for {target} failed:\n{done.stderr}")
        os.replace(made, library)
    return library
