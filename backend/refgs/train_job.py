"""Train on a capture, for the command line (`commands`) and for the Blender extension (`worker`).

Importing torch takes seconds. So the arguments are checked before it is imported, where possible.
"""

import math
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from refgs.errors import InputError, TryAgain
from refgs.events import Report
from refgs.formats.run_toml import Trained
from refgs.lock import RunLock, remove_stale_lock
from refgs.memory import shortage_named, trim
from refgs.paths import check_folder, command_line, disk_errors_named
from refgs.run_folder import (
    CHECKPOINTS,
    PHOTOS,
    SPLATS,
    check_asked,
    check_finished,
    check_free,
    clear,
    read_run_facts,
    update_metrics,
)
from refgs.settings import Settings, load_settings
from refgs.train.effective import Change
from refgs.train.plan import Plan

if TYPE_CHECKING:
    from refgs.capture import Capture
    from refgs.formats.hints import Hint
    from refgs.train.state import State
    from refgs.train.trainer import Trainer


class Hinted(NamedTuple):
    """Name a finished `run` whose training is continued in a new folder, and the `file` of hints about its parts."""

    run: Path
    file: Path


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
    hinted: Hinted | None = None,
) -> "tuple[State, float | None]":
    """Train on a capture and write a run folder, or resume the training in it. At the end write the results and measure their quality.

    - `minutes` limits the whole job; pauses do not count. Without a preset, all settings are chosen to fit into that time. Without both,
      the preset is `standard`.
    - `changes` are settings to change, `section.key=value`.
    - `report(event, facts)` is called for progress and warnings.
    - `attend(state)` is called before each iteration. If it returns True, the training stops with a checkpoint; `resume` continues it.
      Another process can stop it too (`refgs.lock`).
    - With `hinted`, most of that run's training is repeated, with its settings, while the hinted parts are held (`train/hints.py`).

    Returns the training's state and the mean PSNR of the held-out views. `state.ended` is False if the training was stopped. The PSNR is
    None then, or if there are no held-out views.
    """
    plan, lock = Plan(minutes), RunLock(out)
    check_device(device)
    if minutes is not None and not math.isfinite(minutes):
        raise InputError(f"--minutes {minutes}: take a number of minutes, e.g. 5")
    hints: list[Hint] = []
    if resume:
        facts, settings = _resumed_settings(out, changes)
    elif hinted is not None:
        facts, settings, hints = _hinted_settings(hinted, out, preset, changes)
    else:
        facts, settings = _new_settings(out, preset, changes)
    with ExitStack() as held:
        held.enter_context(_removed_if_empty(out))
        held.enter_context(shortage_named(_less(settings)))
        held.enter_context(lock)
        if resume:
            _check_unfinished(out)
        else:
            clear(out)
        capture = _read_capture(capture_folder, settings, hinted.run if hinted else out, facts)
        masked: dict[str, Change] = {}
        if facts is None and settings.image.masks == "auto" and not any(view.masked for view in capture.views):
            capture, settings, changes, masked = _with_masks(capture, settings, preset, changes, report)
        for what in capture.warnings:
            report("warning", {"what": what})
        device = choose_device(device, report)
        held.enter_context(_logged(out))
        with _card_memory():
            if resume:
                trainer = _resume(capture, settings, out, plan, device, report)
            elif hinted is not None:
                trainer = _start_hinted(capture, settings, facts.preset, hinted.run, hints, out, plan, device, report)
            else:
                trainer = _start(capture, settings, preset, changes, masked, out, plan, device, report)
            held.enter_context(disk_errors_named([out], "resume with --resume"))
            state = trainer.state
            trainer.run(lambda: attend(state) or lock.attend(state.iteration, state.total, state.seconds))
        if not state.ended:
            return state, None  # its reduced photos stay, for it may be resumed
        return state, _finish(trainer, out, plan, report)


def hinted(run: Path | None, file: Path | None, resume: bool) -> Hinted | None:
    """Return the run to continue and the file of hints, if both were given; None if neither. Raises InputError otherwise."""
    if run is None and file is None:
        return None
    if run is None or file is None:
        raise InputError("--from and --hints go together: a finished run, and a file that says what its parts are")
    if resume:
        raise InputError("--resume continues the run in --out, which knows its hints: leave out --from and --hints")
    return Hinted(run, file)


def unfinished(out: Path, preset: str | None, minutes: float | None, changes: list[str]) -> bool | None:
    """Say what is left of a training that may have been started before: for `refgs train --once`.

    Returns False if it must be started, True if it must be resumed, None if it has ended. Raises InputError if `out` holds a training with
    other settings than those asked for, and TryAgain if another process works in it.
    """
    if not (out / "run.toml").exists():
        return False
    check_asked(out, preset, minutes, changes)
    if (out / "splats.ply").exists():
        remove_stale_lock(out)
        return None
    with RunLock(out):
        return True


def choose_device(device: str, report: Report) -> str:
    """Return the device to train on: "cpu" or "cuda". `device` may also be "auto".

    If a GPU was asked for or found but cannot be used, report a warning and return "cpu".
    """
    check_device(device)
    if device == "cpu":
        return "cpu"
    from refgs.kernels import cuda

    why = cuda.unusable()
    if why is None:
        return "cuda"
    if device == "cuda" or why != cuda.NO_CARD:
        report("warning", {"what": f"training on the CPU: {why}"})
    return "cpu"


def _less(settings: Settings) -> str:
    """Say what to lower if main memory is full."""
    side, budget = settings.image.max_side, settings.surfels.budget
    parts = f"smaller photos (image.max_side, now {side}) or fewer surfels (surfels.budget, now {budget})"
    return f"close other programs and resume, or train into a new folder with {parts}"


def check_device(device: str) -> None:
    """Raise InputError unless `device` is one that `--device` takes."""
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {device}: take auto, cpu or cuda")


def _new_settings(out: Path, preset: str | None, changes: list[str]) -> tuple[None, Settings]:
    settings = load_settings(preset or "standard", changes)
    check_free(out)
    return None, settings


def _resumed_settings(out: Path, changes: list[str]) -> tuple[Trained, Settings]:
    facts, settings = read_run_facts(out)
    if changes:
        raise InputError("--set cannot change a run that is resumed: train into a new folder")
    return facts, settings


def _hinted_settings(
    hinted: Hinted, out: Path, preset: str | None, changes: list[str]
) -> "tuple[Trained, Settings, list[Hint]]":
    from refgs.formats.hints import read_hints

    facts, settings = check_finished(hinted.run)
    if changes or preset:
        raise InputError("--set and --preset cannot change a run that is continued with hints: it keeps its settings")
    if not any((hinted.run / CHECKPOINTS).glob("*.toml")):
        raise InputError(
            f"{hinted.run} has no checkpoint to continue from: name the run that was trained, not an edited copy"
        )
    check_free(out)
    return facts, settings, read_hints(hinted.file)


def _check_unfinished(out: Path) -> None:
    if (out / SPLATS).exists():
        raise InputError(f"{out}: this training has ended; there is nothing to resume")


def _read_capture(folder: Path, settings: Settings, out: Path, facts: Trained | None) -> "Capture":
    check_folder(folder)  # before numpy is imported
    from refgs.capture import read_capture

    capture = read_capture(folder, settings.region)
    if facts is not None:
        capture.check_unchanged(out, facts.fingerprint)
    return capture


def _with_masks(
    capture: "Capture", settings: Settings, preset: str | None, changes: list[str], report: Report
) -> "tuple[Capture, Settings, list[str], dict[str, Change]]":
    """Make masks of a capture that has none, so that the object is trained alone.

    Return the capture with its masks, the settings, the changes that lead to them, and records of what was changed. A box in the settings
    is moved with the capture's frame. If no object is found, report a warning and return what was given. Raises InputError if masks cannot
    be written: learnt with its surroundings, the object would be worth little.
    """
    from refgs.capture import read_capture
    from refgs.capture.masks import ReadOnlyError, make_masks, masks_folder

    try:
        found = make_masks(capture.folder, settings.region, report)
    except ReadOnlyError as error:
        raise InputError(f"{error} Or train on all that the photos show: --set image.masks=off") from None
    except (InputError, OSError) as error:
        report("warning", {"what": f"training on all that the photos show, for no masks were made: {error}"})
        return capture, settings, changes, {}
    where = masks_folder(capture)
    what = f"made {found['made']} masks of the object, in {where}: look at them"
    report("masks", found | {"capture": str(capture.folder.resolve()), "what": what})
    records = {
        "image.masks": Change("auto", "made", "photos", f"no photo had a mask; {found['made']} are in {where} now")
    }
    if capture.box is not None:
        moved, why = found["moved"], "the masks moved the capture's frame"
        scale = sum(row[0] ** 2 for row in moved[:3]) ** 0.5
        centre = [sum(a * b for a, b in zip(row, (*settings.region.centre, 1.0), strict=True)) for row in moved[:3]]
        box = {"region.centre": centre, "region.size": [scale * edge for edge in settings.region.size]}
        changes = [*changes, *(f"{key}={value}" for key, value in box.items())]
        asked = {"region.centre": list(settings.region.centre), "region.size": list(settings.region.size)}
        records |= {key: Change(asked[key], value, "photos", why) for key, value in box.items()}
        settings = load_settings(preset or "standard", changes)
        report("stage", {"what": f"{why}: the box is {' '.join(f'{k}={_rounded(v)}' for k, v in box.items())} in it"})
    return read_capture(capture.folder, settings.region), settings, changes, records


def _rounded(values: list[float]) -> list[float]:
    return [round(value, 4) + 0.0 for value in values]


def _start(
    capture: "Capture",
    settings: Settings,
    preset: str | None,
    changes: list[str],
    masked: dict[str, Change],
    out: Path,
    plan: Plan,
    device: str,
    report: Report,
) -> "Trainer":
    """Make the trainer of a new training, create its run folder, and return the trainer.

    `masked` are changes that are recorded with those of the training: what the making of masks changed.
    """
    from refgs.train.fit import fitting
    from refgs.train.trainer import Trainer

    with _no_photos_left(out):
        if preset is None and plan.minutes is not None:
            trainer, preset = fitting(capture, changes, out, plan, device, report), f"{plan.minutes:g} minutes"
        else:
            trainer = Trainer(capture, settings, out, report, plan, device)
    state = trainer.state
    state.effective = replace(state.effective, changes=masked | state.effective.changes)
    _create_run(state, preset or "standard", device)
    return trainer


def _start_hinted(
    capture: "Capture",
    settings: Settings,
    preset: str,
    run: Path,
    hints: "list[Hint]",
    out: Path,
    plan: Plan,
    device: str,
    report: Report,
) -> "Trainer":
    """Make the trainer that continues a finished run with hints, create its run folder with a first checkpoint, and return the trainer."""
    from refgs.formats.hints import FILE, write_hints
    from refgs.train.hints import continue_with_hints
    from refgs.train.trainer import Trainer

    with _no_photos_left(out):
        trainer = Trainer(capture, settings, out, report, plan, device)
        continue_with_hints(trainer.state, run, hints)
    with disk_errors_named([out], "train again"):
        out.mkdir(parents=True, exist_ok=True)
        trainer.save()  # before run.toml, so that a run with hints always has a checkpoint: it cannot start over without them
        write_hints(out / FILE, run, hints)
    _create_run(trainer.state, preset, device)
    return trainer


@contextmanager
def _removed_if_empty(out: Path) -> Iterator[None]:
    """Remove a folder after a `with` block that has made it if nothing is in it."""
    new = not out.exists()
    try:
        yield
    finally:
        if new:
            with suppress(OSError):  # it is not empty
                out.rmdir()


@contextmanager
def _no_photos_left(out: Path) -> Iterator[None]:
    """Remove the reduced photos from a folder if a `with` block raises: there is no run yet that could be resumed."""
    try:
        yield
    except BaseException:
        _remove_photos(out)
        raise


def _create_run(state: "State", preset: str, device: str) -> None:
    """Create the run folder of a training that is ready to start."""
    from refgs.run import create_run

    effective = state.effective
    facts = effective.settings, preset, device, effective.chosen(), effective.rows()
    with disk_errors_named([state.folder], "train again"):
        create_run(state.folder, state.capture, *facts)


def _resume(capture: "Capture", settings: Settings, out: Path, plan: Plan, device: str, report: Report) -> "Trainer":
    """Return the trainer of an interrupted training, with its last checkpoint loaded, or ready to start over if there is none."""
    from refgs.formats.hints import FILE
    from refgs.train.trainer import Trainer

    trainer = Trainer(capture, settings, out, report, plan, device)
    trainer.resume()
    what = f"resumed at iteration {trainer.state.iteration}"
    if trainer.state.iteration == 0:
        if (out / FILE).exists():
            raise InputError(f"{out} has no checkpoint left: train again with --from and --hints, into a new folder")
        what = "there is no checkpoint to resume from: starting over"
    report("stage", {"what": what})
    return trainer


def _finish(trainer: "Trainer", out: Path, plan: Plan, report: Report) -> float | None:
    """Write the results and metrics.json. Return the mean PSNR of the held-out views, None without such views.

    All comes before splats.ply, by which a run has ended. So a training that is killed here is resumed, and does it again.
    """
    from refgs.run import record_changes
    from refgs.train.keep.ambiguity import ambiguities
    from refgs.train.keep.asset import write_asset
    from refgs.train.keep.measures import held_out_psnr

    state, quality = trainer.state, None
    again = command_line("refgs", "train", state.capture.folder, "--out", out, "--resume", "--device", "cpu")

    def measure() -> None:
        nonlocal quality
        record_changes(out, state.effective.rows())
        trim()
        quality = held_out_psnr(state, most=len(state.test))
        trim()
        trades = ambiguities(state)
        update_metrics(out, _most_memory() | {"ambiguities": trades, "total_seconds": plan.spent})
        for facts in trades.values():
            if "what" in facts:
                report("stage", {"what": facts["what"]})
        if (out / PHOTOS).exists():
            trainer.release_photos()
            _remove_photos(out)

    update_metrics(out, _costs(trainer))
    with _card_memory(f"the card's memory is full; nothing is lost, resume with: {again}"):
        write_asset(state, measure)
    return quality


def _remove_photos(out: Path) -> None:
    """Remove the reduced photos from a run folder."""
    from refgs.capture import remove_cached

    remove_cached(out / PHOTOS)


def _costs(trainer: "Trainer") -> dict[str, Any]:
    import torch

    state = trainer.state
    costs = {"training_seconds": state.seconds, "processor_seconds": state.clock.processor}
    costs["steps_left_out"] = trainer.guard.left_out
    costs |= _most_memory()
    if state.device.type == "cuda":
        costs["peak_card_memory_bytes"] = torch.cuda.max_memory_allocated()
    return costs


def _most_memory() -> dict[str, int]:
    peak = peak_memory()
    return {"peak_memory_bytes": peak} if peak else {}


@contextmanager
def _card_memory(what: str | None = None) -> Iterator[None]:
    """Raise TryAgain if a `with` block runs out of GPU memory, or if the card fails.

    `what` is the message about the memory; None is the usual message.
    """
    import torch

    from refgs.kernels.cuda import CardError
    from refgs.train.learn.densify import full_card

    try:
        yield
    except torch.OutOfMemoryError:
        raise (TryAgain(what) if what else full_card()) from None
    except (CardError, torch.AcceleratorError) as error:
        why = str(error).splitlines()[0]
        raise TryAgain(f"the card failed ({why}): resume with --resume, or with --device cpu too") from error


@contextmanager
def _logged(out: Path) -> Iterator[None]:
    """Write the traceback of an unexpected error in a `with` block to log.txt. InputErrors are not logged."""
    try:
        yield
    except InputError:
        raise
    except Exception:
        with suppress(OSError):
            (out / "log.txt").write_text(traceback.format_exc(), encoding="utf-8")
        raise


def peak_memory(children: bool = False) -> int | None:
    """Return the peak memory of this process in bytes.

    With `children`, return the peak memory of one child process instead: the largest among those that have ended.
    Return None on Windows, where this cannot be read.
    """
    try:
        import resource
    except ModuleNotFoundError:
        return None
    most = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
