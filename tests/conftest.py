import os

if (
    "PYTEST_XDIST_WORKER" in os.environ
):  # two processes share the cores: of more threads some would wait for others' ends
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch._dynamo  # its Triton brings an LLVM that crashes when it is loaded after Mesa's, which Eevee draws with

from benchmarks.scenes.analytic import write_ball_capture
from refgs.kernels import load
from tests.makers.emulate import emulate

NO_CARD = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA card here")


CARDS = ["emulated", pytest.param("cuda", marks=NO_CARD)]


@pytest.fixture(scope="session", autouse=True)
def no_package_of_the_clone() -> None:
    """pytest takes the root for a package, for it has an __init__.py, Blender's, and has put its parent on the path by now: in a clone
    named refgs, processes that tests spawn would find that where they look for the trainer."""
    parent = str(Path(__file__).parents[2])
    sys.path[:] = [folder for folder in sys.path if folder != parent]


@pytest.fixture(params=CARDS)
def card(request, monkeypatch) -> torch.device:
    """A CUDA card, emulated and real: for what the CPU does otherwise."""
    if request.param == "emulated":
        emulate(monkeypatch)
    return torch.device("cuda" if request.param == "cuda" else "cpu")


@pytest.fixture(params=[*load.supported(), *CARDS])
def device(request, monkeypatch) -> torch.device:
    """Everything that runs kernels, one after another: where a test has to put its tensors. "emulated" are CUDA's kernels
    on this processor."""
    if request.param == "emulated":
        emulate(monkeypatch)
    elif request.param != "cuda":
        monkeypatch.setenv("REFGS_ISA", request.param)
    return torch.device("cuda" if request.param == "cuda" else "cpu")


@pytest.fixture(scope="session")
def ball_capture(tmp_path_factory):
    """A small capture with a known answer: a metal ball at 64 pixels."""
    folder = tmp_path_factory.mktemp("ball")
    write_ball_capture(folder, 64)
    return folder


@pytest.fixture
def python(tmp_path):
    """A Python that has a trainer in it which only speaks as one, and nothing else."""
    from refgs_addon import jobs

    if sys.platform == "win32":
        pytest.skip("the fake trainer is a script that Windows does not start")
    file, fake = tmp_path / "the Python", Path(__file__).parent / "makers" / "fake_worker.py"
    file.write_text(f"#!{sys.executable}\nimport runpy\nrunpy.run_path({str(fake)!r})\n")
    file.chmod(0o755)
    yield file
    jobs.stop_all()


@pytest.fixture
def small_disk(tmp_path):
    """A real file system of four megabytes; needs root to mount."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if os.name != "posix" or not shutil.which("mount") or os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)], capture_output=True).returncode:
        pytest.skip("this system does not let us mount a file system")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


_status = 0


def pytest_sessionfinish(exitstatus):
    global _status
    _status = exitstatus


@pytest.hookimpl(trylast=True)
def pytest_unconfigure():
    """Leave at once where Blender was loaded: its own clean-up at the end of a process has been seen to hang."""
    if "bpy" in sys.modules:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_status)
