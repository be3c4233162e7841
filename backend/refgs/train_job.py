"""Train a capture and report progress, for the command line (`commands`) and the job protocol (`worker`).

Importing torch takes seconds. So everything that does not need torch is checked first.
"""

import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refgs.errors import InputError
from refgs.events import Report
from refgs.lock import RunLock
from refgs.paths import check_folder, disk_errors_named
from refgs.run_folder import check_free, read_run_facts, update_metrics
from refgs.settings import Settings, load_settings
from refgs.train.plan import Plan

if TYPE_CHECKING:
    from refgs.capture import Capture
    from refgs.train.state import State
    from refgs.train.trainer import Trainer


def train(
    capture_folder: Path,
    out: Path,
    preset: str | None,
    device: str,
    minutes: float | None,
    changes: list[str],
    resume: bool,
    report: Report,
    attend: "Callable[[State], bool]",
) -> "tuple[State, float | None]":
    """Train a capture into a run folder, or resume the training in it. When it ends, write the asset and measure it.

    `minutes` limits the whole job, pauses not counted. If `minutes` is given without a preset, all settings are planned for that time. If
    neither is given, the preset is `standard`. `attend` is called before each iteration: True stops the training with a checkpoint, which
    `resume` starts from. Another process can stop it too (`refgs.lock`). Returns the state, whose `ended` tells a finished training from a
    stopped one, and the mean PSNR of the held-out views if it has ended and there are any.
    """
    plan, lock = Plan(minutes), RunLock(out)
    _check_device(device)
    facts, settings = _resumed_settings(out, changes) if resume else _new_settings(out, preset, changes)
    with ExitStack() as held:
        if resume:
            held.enter_context(lock)
            _check_unfinished(out)
        capture = _read_capture(capture_folder, settings, out, facts)
        device = choose_device(device, report)
        held.enter_context(_logged(out))
        with _card_memory():
            if resume:
                trainer = _resume(capture, settings, out, plan, device, report)
            else:
                trainer = _start(capture, settings, preset, changes, out, plan, device, report)
                held.enter_context(lock)  # its folder exists only now
            held.enter_context(disk_errors_named([out], "resume with --resume"))
            state = trainer.state
            trainer.run(lambda: attend(state) or lock.attend(state.iteration, state.total, state.seconds))
        return state, _finish(trainer, out, plan, report) if state.ended else None


def choose_device(device: str, report: Report) -> str:
    """Choose "cpu" or "cuda". Warn if a card was asked for, or is there, and cannot be used."""
    _check_device(device)
    if device == "cpu":
        return "cpu"
    from refgs.kernels import cuda

    why = cuda.unusable()
    if why is None:
        return "cuda"
    if device == "cuda" or why != cuda.NO_CARD:
        report("warning", {"what": f"training on the CPU: {why}"})
    return "cpu"


def _check_device(device: str) -> None:
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {device}: take auto, cpu or cuda")


def _new_settings(out: Path, preset: str | None, changes: list[str]) -> tuple[None, Settings]:
    settings = load_settings(preset or "standard", changes)
    check_free(out)
    return None, settings


def _resumed_settings(out: Path, changes: list[str]) -> tuple[dict, Settings]:
    facts, settings = read_run_facts(out)
    if changes:
        raise InputError("--set cannot change a run that is resumed: train into a new folder")
    return facts, settings


def _check_unfinished(out: Path) -> None:
    if (out / "splats.ply").exists():
        raise InputError(f"{out}: this training has ended; there is nothing to resume")


def _read_capture(folder: Path, settings: Settings, out: Path, facts: dict | None) -> "Capture":
    check_folder(folder)  # before numpy is imported
    from refgs.capture import read_capture

    capture = read_capture(folder, settings.region)
    if facts is not None and capture.fingerprint() != facts["fingerprint"]:
        raise InputError(f"{folder} is not the capture that {out} was trained on, or it was changed since")
    return capture


def _start(
    capture: "Capture",
    settings: Settings,
    preset: str | None,
    changes: list[str],
    out: Path,
    plan: Plan,
    device: str,
    report: Report,
) -> "Trainer":
    """Make the trainer of a new run, and the run's folder."""
    from refgs.run import create_run, record_changes
    from refgs.train.fit import fitting
    from refgs.train.trainer import Trainer

    if preset is None and plan.minutes is not None:
        trainer, preset = fitting(capture, changes, out, plan, device, report), f"{plan.minutes:g} minutes"
    else:
        trainer = Trainer(capture, settings, out, report, plan, device)
    with disk_errors_named([out], "train again"):
        effective = trainer.state.effective
        create_run(out, capture, effective.settings, preset or "standard", device, effective.chosen())
        record_changes(out, effective.rows())
    return trainer


def _resume(capture: "Capture", settings: Settings, out: Path, plan: Plan, device: str, report: Report) -> "Trainer":
    """Make the trainer of a run and load its last checkpoint."""
    from refgs.train.trainer import Trainer

    trainer = Trainer(capture, settings, out, report, plan, device)
    trainer.resume()
    report("stage", {"what": f"resumed at iteration {trainer.state.iteration}"})
    return trainer


def _finish(trainer: "Trainer", out: Path, plan: Plan, report: Report) -> float | None:
    """Write the asset and metrics.json; return the mean PSNR of the held-out views."""
    from refgs.run import record_changes
    from refgs.train.ambiguity import ambiguities
    from refgs.train.asset import write_asset
    from refgs.train.measures import held_out_psnr

    state = trainer.state
    update_metrics(out, _costs(trainer))
    again = f"refgs train {state.capture.folder} --out {out} --resume --device cpu"
    with _card_memory(f"the card's memory is full; nothing is lost, resume with: {again}"):
        write_asset(state)
        record_changes(out, state.effective.rows())
        quality = held_out_psnr(state, most=len(state.test))
        trades = ambiguities(state)
    update_metrics(out, {"ambiguities": trades, "total_seconds": plan.spent})
    for facts in trades.values():
        if "what" in facts:
            report("stage", {"what": facts["what"]})
    return quality


def _costs(trainer: "Trainer") -> dict[str, Any]:
    import torch

    state = trainer.state
    costs = {"training_seconds": state.seconds, "processor_seconds": state.processor_seconds}
    costs["steps_left_out"] = trainer.guard.left_out
    if peak := peak_memory():
        costs["peak_memory_bytes"] = peak
    if state.device.type == "cuda":
        costs["peak_card_memory_bytes"] = torch.cuda.max_memory_allocated()
    return costs


@contextmanager
def _card_memory(what: str | None = None) -> Iterator[None]:
    """Raise InputError with the message `what` if the card runs out of memory."""
    import torch

    from refgs.train.densify import full_card

    try:
        yield
    except torch.OutOfMemoryError:
        raise (InputError(what) if what else full_card()) from None


@contextmanager
def _logged(out: Path) -> Iterator[None]:
    """Write the traceback of an internal error to log.txt. Errors of the user's input pass through."""
    try:
        yield
    except InputError:
        raise
    except Exception:
        with suppress(OSError):
            (out / "log.txt").write_text(traceback.format_exc(), encoding="utf-8")
        raise


def peak_memory(children: bool = False) -> int | None:
    """Return the peak memory of this process, or of its children that have ended, in bytes; None on Windows, which keeps no such count."""
    try:
        import resource
    except ModuleNotFoundError:
        return None
    most = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
