"""Test the choice of the device, the warning if the chosen device is not the requested one, and a card whose memory is full."""

import warnings

import pytest
import torch

from refgs import train_job
from refgs.capture import read_capture
from refgs.errors import InputError
from refgs.kernels import cuda
from refgs.settings import load_settings
from refgs.train.trainer import Trainer


def chosen(device: str) -> tuple[str, list[str]]:
    """Choose a device. Return its name and the warnings."""
    said = []
    return train_job.choose_device(device, lambda event, facts: said.append(facts["what"])), said


def card(monkeypatch, capability: tuple[int, int], driver: str | None = None) -> None:
    """Make torch report a card of this compute capability. If `driver` is given, loading kernels fails with the message `driver`."""

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
    card(monkeypatch, (7, 5))
    assert [chosen(d) for d in ("auto", "cuda", "cpu")] == [("cuda", []), ("cuda", []), ("cpu", [])]


def test_no_card(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert chosen("auto") == ("cpu", [])
    device, said = chosen("cuda")
    assert device == "cpu" and len(said) == 1 and "no NVIDIA card, or no driver" in said[0]


def test_a_driver_that_is_too_old_for_torch(monkeypatch):
    def available() -> bool:
        warnings.warn("The NVIDIA driver on your system is too old", stacklevel=1)
        return False

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", available)
    device, said = chosen("auto")
    assert device == "cpu" and len(said) == 1 and "driver is too old" in said[0]


@pytest.mark.parametrize("asked", ["auto", "cuda"])
def test_a_card_that_is_too_old(monkeypatch, asked):
    card(monkeypatch, (6, 1))
    device, said = chosen(asked)
    assert device == "cpu" and len(said) == 1
    assert "GeForce is too old: its compute capability is 6.1, 7.5" in said[0]


def test_a_driver_that_refuses(monkeypatch):
    card(monkeypatch, (8, 6), driver="adam.cpp: CUDA_ERROR_INVALID_IMAGE\nand more")
    device, said = chosen("auto")
    assert (
        device == "cpu"
        and len(said) == 1
        and said[0].endswith("(adam.cpp: CUDA_ERROR_INVALID_IMAGE): a newer driver may do")
    )


def small_trainer(ball_capture, folder, reports: list, start: int) -> Trainer:
    changes = [
        f"surfels.start={start}",
        "train.iterations=12",
        "surfels.hull=48",
        "surfels.inside=0.0",
        "surfels.opacity=0.73",
    ]
    settings = load_settings("quick", changes)
    (folder / "checkpoints").mkdir(parents=True)
    return Trainer(read_capture(ball_capture), settings, folder, lambda *event: reports.append(event))


def test_full_memory_lowers_the_budget_and_goes_on(ball_capture, tmp_path, monkeypatch):
    reports = []
    trainer = small_trainer(ball_capture, tmp_path, reports, start=2000)
    whole, step = 1800, trainer.step

    def limited() -> dict:
        if len(trainer.state.parameters["position"]) > whole:
            raise torch.OutOfMemoryError
        return step()

    faintest = trainer.state.parameters["opacity"][:400]
    with torch.no_grad():
        faintest -= 1
    monkeypatch.setattr(trainer, "step", limited)
    assert trainer.run()
    warnings = [facts["what"] for event, facts in reports if event == "warning"]
    assert len(warnings) == 1 and "1,600 surfels" in warnings[0]
    assert trainer.state.settings.surfels.budget == len(trainer.state.parameters["position"]) == 1600
    assert trainer.state.parameters["opacity"].min() > 0


def test_memory_that_is_far_too_small(ball_capture, tmp_path, monkeypatch):
    trainer = small_trainer(ball_capture, tmp_path, [], start=1200)
    monkeypatch.setattr(trainer, "step", lambda: (_ for _ in ()).throw(torch.OutOfMemoryError()))
    with pytest.raises(InputError, match="memory is too small"):
        trainer.run()
