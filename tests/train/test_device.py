"""Test the choice of the device, the warning if the requested device cannot be used, and a GPU that runs out of memory."""

import warnings

import pytest
import torch

from refgs import train_job
from refgs.errors import InputError
from refgs.kernels import cuda
from refgs.train.trainer import Trainer
from tests.makers.training import trainer


def chosen(device: str) -> tuple[str, list[str]]:
    """Choose the device for a training. Return its name and the warnings."""
    said = []
    return train_job.choose_device(device, lambda event, facts: said.append(facts["what"])), said


def fake_gpu(monkeypatch, capability: tuple[int, int], driver: str | None = None) -> None:
    """Make torch report a GPU of this compute capability. If `driver` is given, loading a kernel fails with this message."""

    def module(source: str, device: int) -> int:
        if driver:
            raise RuntimeError(driver)
        return 1

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "GeForce")
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(cuda, "_module", module)


def test_a_card_is_taken(monkeypatch):
    fake_gpu(monkeypatch, (7, 5))
    assert [chosen(d) for d in ("auto", "cuda", "cpu")] == [("cuda", []), ("cuda", []), ("cpu", [])]


def test_no_card(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert chosen("auto") == ("cpu", [])
    device, (line,) = chosen("cuda")
    assert device == "cpu" and "no NVIDIA card, or no driver" in line


def test_a_driver_that_is_too_old_for_torch(monkeypatch):
    def available() -> bool:
        warnings.warn("The NVIDIA driver on your system is too old", stacklevel=1)
        return False

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", available)
    device, (line,) = chosen("auto")
    assert device == "cpu" and "driver is too old" in line


@pytest.mark.parametrize("asked", ["auto", "cuda"])
def test_a_card_that_is_too_old(monkeypatch, asked):
    fake_gpu(monkeypatch, (6, 1))
    device, (line,) = chosen(asked)
    assert device == "cpu" and "GeForce is too old: its compute capability is 6.1, 7.5" in line


def test_a_driver_that_refuses(monkeypatch):
    fake_gpu(monkeypatch, (8, 6), driver="adam.cpp: CUDA_ERROR_INVALID_IMAGE\nand more")
    device, (line,) = chosen("auto")
    assert device == "cpu" and line.endswith("(adam.cpp: CUDA_ERROR_INVALID_IMAGE): a newer driver may do")


def trainer_from(capture, folder, start: int, report=lambda *event: None) -> Trainer:
    """Make a trainer that begins with `start` surfels. Its budget is 24,000 surfels."""
    changes = f"surfels.start={start}", "surfels.budget=24000", "surfels.inside=0.0", "surfels.opacity=0.73"
    return trainer(capture, folder / "run", "surfels.hull=48", *changes, total=12, report=report)


def test_full_memory_lowers_the_budget_and_goes_on(ball_capture, tmp_path, monkeypatch):
    reports = []
    made = trainer_from(ball_capture, tmp_path, 2000, lambda *event: reports.append(event))
    step = made.step

    def limited() -> dict:
        if made.state.learned.count > 1800:
            raise torch.OutOfMemoryError
        return step()

    with torch.no_grad():
        made.state.learned["opacity"][:400] -= 1
    monkeypatch.setattr(made, "step", limited)
    assert made.run()
    (warning,) = [facts["what"] for event, facts in reports if event == "warning"]
    assert "1,600 surfels" in warning
    assert made.state.settings.surfels.budget == made.state.learned.count == 1600
    assert made.state.learned["opacity"].min() > 0


def test_memory_that_is_far_too_small(ball_capture, tmp_path, monkeypatch):
    made = trainer_from(ball_capture, tmp_path, 1200)
    monkeypatch.setattr(made, "step", lambda: (_ for _ in ()).throw(torch.OutOfMemoryError()))
    with pytest.raises(InputError, match="memory is too small"):
        made.run()
