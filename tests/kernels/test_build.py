"""Test compiling and caching the CPU kernels. Test the error for an unknown instruction set."""

import os
import signal
import struct
import subprocess
import sys

import pytest

from refgs.errors import InputError
from refgs.kernels import load
from refgs.kernels.build import FLAGS, SOURCES, TARGETS, build, target
from tests.makers.layouts import asserted
from tests.makers.processes import commands
from tests.makers.waiting import until

# A usual test run compiles only macOS's library, whose linker is the one that does not refuse undefined symbols: each takes 20 seconds on
# one core. Of the others it checks syntax and layouts.
EVERY = [
    pytest.param(system, machine, isa, marks=[] if system == "darwin" else pytest.mark.slow)
    for (system, machine), (_, _, isas) in TARGETS.items()
    for isa in isas
]
# Symbols that macOS's own library defines. Linux's linker refuses undefined ones (-z defs), and Windows' always does.
MACOS = {"_bzero", "_memcpy", "_memset", "dyld_stub_binder"}
MAGIC = {"so": b"\x7fELF", "dll": b"MZ", "dylib": b"\xcf\xfa\xed\xfe"}


def undefined(library: bytes) -> set[str]:
    """List the undefined symbols of a Mach-O file of 64 bits."""
    at = 32
    while (command := struct.unpack_from("<II", library, at))[0] != 2:  # LC_SYMTAB
        at += command[1]
    symbols, count, names = struct.unpack_from("<III", library, at + 8)
    found = set()
    for n in range(count):
        name, kind = struct.unpack_from("<IB", library, symbols + 16 * n)
        if kind & 0x0E == 0:  # N_UNDF
            found.add(library[names + name :].partition(b"\0")[0].decode())
    return found


@pytest.mark.parametrize(("system", "machine", "isa"), EVERY)
def test_compiles_for_every_platform_with_the_layouts_of_python(system, machine, isa, tmp_path, monkeypatch):
    monkeypatch.setattr("refgs.kernels.build.HERE", asserted(tmp_path / "sources"))
    wanted, cache = target(system, machine, isa), tmp_path / "cache"
    library = build(wanted, cache)
    content = library.read_bytes()
    assert content.startswith(MAGIC[wanted.extension])
    for name in (b"refgs_forward", b"refgs_backward", b"refgs_ssim_backward"):
        assert name in content
    if wanted.extension == "dylib":
        assert undefined(content) <= MACOS
    assert [p.name for p in cache.iterdir()] == [library.name]  # no temporary files are left
    made = library.stat().st_mtime_ns
    assert build(wanted, cache) == library and library.stat().st_mtime_ns == made


@pytest.mark.parametrize(("system", "machine"), [platform for platform in TARGETS if platform[0] != "darwin"])
def test_layouts_are_those_of_python_on_every_platform(system, machine, tmp_path):
    wanted = target(system, machine, [*TARGETS[system, machine][2]][-1])
    command = [sys.executable, "-P", "-m", "ziglang", "c++", "-fsyntax-only", *FLAGS, *SOURCES]
    command += ["-target", wanted.platform, f"-mcpu={wanted.processor}"]
    environment = os.environ | {"ZIG_LOCAL_CACHE_DIR": str(tmp_path), "ZIG_GLOBAL_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        command, cwd=asserted(tmp_path / "sources"), env=environment, capture_output=True, text=True, timeout=300
    )
    errors = [line for line in done.stderr.splitlines() if ": error: " in line]
    missed = {line.partition(":")[0] for line in errors if line.endswith("error: FileNotFound")}
    assert len(errors) == len(missed) and missed == {*SOURCES}, done.stderr  # Zig misses objects, which are not written


def test_first_uses_at_the_same_time(tmp_path):
    program = """
from refgs.kernels import build
build.SOURCES = ("stack.cpp",)  # one that compiles fast
print(build.build(build.target("linux", "x86_64", "sse4"), build.cache_folder()))
"""
    environment = {"REFGS_CACHE": str(tmp_path), "PATH": "", "HOME": str(tmp_path)}
    command = [sys.executable, "-c", program]
    both = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    names = [p.communicate(timeout=120)[0].strip() for p in both]
    assert [p.returncode for p in both] == [0, 0]
    assert names[0] == names[1] and [str(p) for p in tmp_path.iterdir()] == names[:1]


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGINT])
def test_a_build_that_is_killed(tmp_path, kind):
    """Check that the compilers end with the process that builds, and that the next build removes the files that they left."""
    program = """
import sys
from refgs.kernels import build
build.SOURCES = sys.argv[1:] or build.SOURCES
build.build(build.target("linux", "x86_64", "sse4"), build.cache_folder())
"""
    command, environment = [sys.executable, "-c", program], os.environ | {"REFGS_CACHE": str(tmp_path)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as builder:
        until(lambda: commands(str(tmp_path)), 100)
        builder.send_signal(kind)
    until(lambda: not commands(str(tmp_path)), 100)
    subprocess.run([*command, "stack.cpp"], env=environment, check=True)
    assert {file.suffix for file in tmp_path.iterdir()} == {".so"}  # two, if the signal came just too late


def test_cache_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="REFGS_CACHE"):
        build(target("linux", "x86_64", "sse4"), tmp_path / "file" / "cache")


@pytest.mark.parametrize(
    ("system", "machine", "said"),
    [
        ("darwin", "x86_64", "darwin x86_64"),
        ("win32", "ARM64", "win32 aarch64"),
        ("linux", "riscv64", "linux riscv64"),
        ("win32", "x86", "win32 x86"),
        ("freebsd14", "amd64", "freebsd14 x86_64"),
    ],
)
def test_platforms_without_kernels(monkeypatch, system, machine, said):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(load.platform, "machine", lambda: machine)
    load.supported.cache_clear()
    try:
        with pytest.raises(InputError, match=f"^there are no kernels for {said}: train on one of linux x86_64, "):
            load._load.__wrapped__(load.supported()[0])
    finally:
        load.supported.cache_clear()


def test_unknown_instruction_set(monkeypatch):
    monkeypatch.setenv("REFGS_ISA", "mmx")
    with pytest.raises(InputError, match="REFGS_ISA=mmx"):
        load.kernels()
