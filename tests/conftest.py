import os

# Several test processes share the cores: more threads would only wait for each other.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch._dynamo  # load Triton's LLVM before Mesa's, which Eevee uses: the other order crashes

from benchmarks.scenes.analytic import write_ball_capture
from refgs.capture import salience
from refgs.geometry import field
from refgs.kernels import load
from tests.makers.emulate import emulate
from tests.makers.foreign import use_foreign

NO_CARD = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA card here")
FOREIGN = [pytest.param(name, marks=pytest.mark.slow) for name in ("wine", "qemu")]
CARDS = ["emulated", pytest.param("cuda", marks=NO_CARD)]


@pytest.fixture(scope="session", autouse=True)
def no_package_of_the_clone() -> None:
    """Remove the parent folder of this clone from sys.path. Pytest has added it.

    The clone has an __init__.py for Blender, so pytest takes it for a package. If the clone's folder is named refgs, programs that tests
    start would import that folder in place of the trainer.
    """
    parent = str(Path(__file__).parents[2])
    sys.path[:] = [folder for folder in sys.path if folder != parent]


@pytest.fixture(autouse=True)
def no_model(monkeypatch) -> None:
    """Let masks be made by colours, as where the segmentation model is not installed: it takes seconds for a photo."""
    monkeypatch.setattr(salience, "MODEL", Path("no model"))


@pytest.fixture(params=CARDS)
def card(request, monkeypatch) -> torch.device:
    """Run the test with CUDA kernels emulated on the CPU, and again on a CUDA card if there is one. Returns the torch device.

    It is for tests of code that differs between CPU and CUDA.
    """
    if request.param == "emulated":
        emulate(monkeypatch)
    return torch.device("cuda" if request.param == "cuda" else "cpu")


@pytest.fixture(params=[*load.supported(), *CARDS, *FOREIGN])
def device(request, monkeypatch) -> torch.device:
    """Run the test once for each build of the kernels. Returns the torch device.

    The builds are: one for each instruction set of this CPU, CUDA kernels emulated on the CPU, and CUDA kernels on a card if there is one.
    Slow tests add Windows' library under Wine, and ARM's under QEMU.
    """
    if request.param == "emulated":
        emulate(monkeypatch)
    elif request.param in ("wine", "qemu"):
        use_foreign(request.param, monkeypatch)
    elif request.param != "cuda":
        monkeypatch.setenv("REFGS_ISA", request.param)
    return torch.device("cuda" if request.param == "cuda" else "cpu")


@pytest.fixture(scope="session", autouse=True)
def coarse_hollows() -> None:
    """Look for hollows on a grid of half the side: each training takes a second less. Tests of hollows have grids of their own."""
    field.SIDE //= 2


@pytest.fixture(scope="session")
def ball_capture(tmp_path_factory):
    """Write a small data set of a metal ball: photos of 32 × 32 pixels, cameras, and exact ground truth. Return its folder."""
    folder = tmp_path_factory.mktemp("ball")
    write_ball_capture(folder, 32)
    return folder


@pytest.fixture(scope="session")
def sharp_ball(tmp_path_factory):
    """Write the capture of the same ball with photos of 64 × 64 pixels."""
    folder = tmp_path_factory.mktemp("sharp ball")
    write_ball_capture(folder, 64)
    return folder


@pytest.fixture(scope="session")
def large_ball(tmp_path_factory):
    """Write a capture whose photos have several pixels for each surfel."""
    folder = tmp_path_factory.mktemp("large ball")
    write_ball_capture(folder, 96, samples=1)
    return folder


@pytest.fixture
def python(tmp_path):
    """Return a fake Python executable. It always runs fake_worker.py, which imitates the trainer but does not train."""
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
    """Mount a file system of four megabytes and return its folder; mounting needs root."""
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
    """End the process at once if Blender was loaded, because Blender's clean-up sometimes hangs."""
    if "bpy" in sys.modules:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_status)
