"""Train on a capture, for the command line (`commands`) and for the Blender extension (`worker`).

Importing torch takes seconds. So the arguments are checked before it is imported, where possible.
"""

import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from refgs.asked import Asked
from refgs.effective import Effective
from refgs.errors import InputError, TryAgain
from refgs.events import Report, event_line
from refgs.formats.run_toml import Trained
from refgs.lock import RunLock, remove_stale_lock
from refgs.memory import shortage_named, trim
from refgs.paths import check_folder, command_line, disk_errors_named
from refgs.run_folder import (
    CHECKPOINTS,
    LOG,
    PHOTOS,
    SPLATS,
    check_asked,
    check_finished,
    check_free,
    clear,
    read_run_facts,
    update_metrics,
)
from refgs.settings import Settings
from refgs.train.plan import TRADES, Plan

if TYPE_CHECKING:
    from refgs.capture import Capture, CaptureFiles
    from refgs.formats.hints import Hint
    from refgs.train.state import State
    from refgs.train.trainer import Trainer


class _Known(NamedTuple):
    """Hold what is known of a training before its capture is read.

    `preset` is the preset's name, which is recorded in run.toml. `run` is the folder of an earlier run: the one to resume, or the one to
    continue with `hints`. It is None for a new training. `facts` is the table [run] of that run's run.toml.
    """

    settings: Settings
    preset: str
    run: Path | None = None
    facts: Trained | None = None
    hints: "Sequence[Hint]" = ()


class _Log:
    """Pass events on to the function `report`, and add their lines to log.txt in the run folder `out`.

    The first lines wait until the run folder is created, so that a training which cannot start leaves no folder.
    """

    def __init__(self, out: Path, report: Report) -> None:
        self._out, self._report, self._waiting = out, report, ""

    def __call__(self, event: str, facts: dict[str, Any]) -> None:
        if "what" in facts:
            self._waiting += f"{event_line(event, facts)}\n"
            if (self._out / "run.toml").exists():
                self.write()
        self._report(event, facts)

    def write(self, more: str = "") -> None:
        """Write the waiting lines, and then the text `more`. Ignore write errors: no training ends because its log cannot be written."""
        with suppress(OSError), open(self._out / LOG, "a", encoding="utf-8") as file:
            file.write(self._waiting + more)
        self._waiting = ""


def train(asked: Asked, report: Report, attend: "Callable[[State], bool]") -> "tuple[State, float | None]":
    """Train on a capture and write a run folder, or resume the training in it. At the end write the results and measure their quality.

    - `report(event, facts)` is called for progress and warnings. The lines of all events are also added to log.txt in the run folder.
    - `attend(state)` is called before each iteration. If it returns True, the training stops with a checkpoint, and can be resumed. Another
      process can stop it too (`refgs.lock`).
    - With hints, most of a finished run's training is repeated. The hinted parts of the surface stay metal or paint (`train/hints.py`).

    Returns the training's state and the mean PSNR of the held-out views. `state.ended` is False if the training was stopped. The PSNR is
    None then, or if there are no held-out views.
    """
    plan, out, lock, report = Plan(asked.minutes), asked.out, RunLock(asked.out), _Log(asked.out, report)
    known = _known(asked)
    with ExitStack() as held:
        held.enter_context(_removed_if_empty(out))
        held.enter_context(shortage_named(_less(known.settings)))
        held.enter_context(lock)
        if asked.resume:
            _check_unfinished(out)
        else:
            clear(out)
        capture, effective = _read_capture(asked.capture, known, report)
        device = choose_device(asked.device, report)
        held.enter_context(_logged(report))
        with _card_memory():
            trainer = _trainer(asked, known, capture, effective, plan, device, report)
        report.write()
        held.enter_context(disk_errors_named([out], "resume with --resume"))
        state = trainer.state
        trainer.run(lambda: attend(state) or lock.attend(state.iteration, state.total, state.seconds))
        if not state.ended:
            return state, None  # its reduced photos stay, for it may be resumed
        return state, _finish(trainer)


def unfinished(asked: Asked) -> bool | None:
    """Tell whether `refgs train --once` must start a training, resume it, or do nothing.

    Returns False to start it, True to resume it, None if it has ended. Raises InputError if the run folder holds a training with other
    settings than those asked for. Raises TryAgain if another process works in this folder.
    """
    out = asked.out
    if not (out / "run.toml").exists():
        return False
    check_asked(asked)
    if (out / SPLATS).exists():
        remove_stale_lock(out)
        return None
    with RunLock(out):
        return True


def choose_device(device: str, report: Report) -> str:
    """Return the device to train on: "cpu" or "cuda". `device` may also be "auto".

    If a GPU was asked for or found but cannot be used, report a warning and return "cpu".
    """
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
    """Advise which settings to lower, with their present values, if main memory is full."""
    side, budget = settings.image.max_side, settings.surfels.budget
    parts = f"smaller photos (image.max_side, now {side}) or fewer surfels (surfels.budget, now {budget})"
    return f"close other programs and resume, or train into a new folder with {parts}"


def _known(asked: Asked) -> _Known:
    """Read the settings and check the run folders without importing torch, or raise InputError."""
    if asked.resume:
        facts, settings = read_run_facts(asked.out)
        return _Known(settings, facts.preset, asked.out, facts)
    if asked.run is None:
        settings = asked.settings()
        check_free(asked.out)
        return _Known(settings, asked.preset_name)
    from refgs.formats.hints import read_hints

    facts, settings = check_finished(asked.run)
    if not any((asked.run / CHECKPOINTS).glob("*.toml")):
        raise InputError(
            f"{asked.run} has no checkpoint to continue from: name the run that was trained, not an edited copy"
        )
    check_free(asked.out)
    return _Known(settings, facts.preset, asked.run, facts, read_hints(asked.hints))


def _check_unfinished(out: Path) -> None:
    if (out / SPLATS).exists():
        raise InputError(f"{out}: this training has ended; there is nothing to resume")


def _read_capture(folder: Path, known: _Known, report: Report) -> "tuple[Capture, Effective]":
    """Read the capture, and make masks for a new training if the capture has none. Return the capture, and the settings to train with.

    Raises InputError if the run `known.run` was trained on another capture, or if files of the capture have changed since.
    """
    check_folder(folder)  # before numpy is imported
    from refgs.capture import read_files, to_run_frame

    effective, files = Effective.of(known.settings), read_files(folder)
    capture = to_run_frame(files, known.settings.region)
    if known.facts is not None:
        capture.check_unchanged(known.run, known.facts.fingerprint)
    elif known.settings.image.masks == "auto" and not any(view.masked for view in capture.views):
        files, effective = _with_masks(files, capture, effective, report)
        capture = to_run_frame(files, effective.settings.region)
    for what in capture.warnings:
        report("warning", {"what": what})
    return capture, effective


def _with_masks(
    files: "CaptureFiles", capture: "Capture", effective: Effective, report: Report
) -> "tuple[CaptureFiles, Effective]":
    """Make masks of a capture that has none, so that the object is trained alone.

    Return the capture's files with their masks, and the settings. New masks may change the coordinate frame of the training: a region box
    in the settings is then converted to the new frame. If no object is found, report a warning, and return files and settings unchanged.
    Raises InputError if the masks cannot be written: without them, the object would be trained together with its surroundings.
    """
    from refgs.capture.masks import ReadOnlyError, masks_folder, moved_region, with_masks

    try:
        files, found = with_masks(files, effective.asked.region, report)
    except ReadOnlyError as error:
        raise InputError(f"{error} Or train on all that the photos show: --set image.masks=off") from None
    except (InputError, OSError) as error:
        report("warning", {"what": f"training on all that the photos show, for no masks were made: {error}"})
        return files, effective
    where = masks_folder(capture)
    what = f"made {found['made']} masks of the object, in {where}: look at them"
    report("masks", found | {"capture": str(files.folder.resolve()), "what": what})
    why = f"no photo had a mask; {found['made']} are in {where} now"
    effective = effective.noted("image.masks", "made", "photos", why)
    if capture.box is None:
        return files, effective
    region, why = moved_region(effective.asked.region, found["moved"]), "the masks moved the capture's frame"
    box = f"region.centre={_rounded(region.centre)} region.size={_rounded(region.size)}"
    report("stage", {"what": f"{why}: the box is {box} in it"})
    return files, effective.moved_to(effective.asked.model_copy(update={"region": region}), "photos", why)


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(value, 4) + 0.0 for value in values]


def _trainer(
    asked: Asked, known: _Known, capture: "Capture", effective: Effective, plan: Plan, device: str, report: Report
) -> "Trainer":
    """Make the trainer: resumed from its last checkpoint, or in a new run folder."""
    from refgs.train.fit import fitting
    from refgs.train.hints import continue_with_hints
    from refgs.train.trainer import Trainer

    make = partial(Trainer, capture, effective, asked.out, report, plan, device)
    if asked.resume:
        return _resumed(make())
    with _no_photos_left(asked.out):
        if asked.planned:
            quick = asked.settings("quick")
            # Masks may have moved the box; all presets have the same.
            moved = quick.model_copy(update={"region": effective.settings.region})
            rehearsed = replace(effective, asked=quick, settings=moved)
            trainer = fitting(capture, rehearsed, effective.settings, asked.out, plan, device, report)
        else:
            trainer = make()
        if known.hints:
            continue_with_hints(trainer.state, known.run, known.hints)
    if known.hints:
        _save_with_hints(trainer, known)
    _create_run(trainer.state, known.preset, device)
    return trainer


def _save_with_hints(trainer: "Trainer", known: _Known) -> None:
    """Save a first checkpoint, which a run with hints must have, then the hints."""
    from refgs.formats.hints import FILE, write_hints

    out = trainer.state.folder
    with disk_errors_named([out], "train again"):
        out.mkdir(parents=True, exist_ok=True)
        trainer.save()
        write_hints(out / FILE, known.run, known.hints)


@contextmanager
def _removed_if_empty(out: Path) -> Iterator[None]:
    """Remove the folder `out` after a `with` block that created it and left it empty."""
    new = not out.exists()
    try:
        yield
    finally:
        if new:
            with suppress(OSError):  # it is not empty
                out.rmdir()


@contextmanager
def _no_photos_left(out: Path) -> Iterator[None]:
    """Delete the cached reduced photos in `out` if the `with` block raises."""
    # The run does not exist yet, so no training can be resumed that would need them.
    try:
        yield
    except BaseException as error:
        traceback.clear_frames(error.__traceback__)  # they refer to mapped photos
        _remove_photos(out)
        raise


def _create_run(state: "State", preset: str, device: str) -> None:
    """Create the run folder of a training that is ready to start."""
    from refgs.run import create_run

    effective = state.effective
    facts = effective.settings, preset, device, effective.chosen(), effective.rows()
    with disk_errors_named([state.folder], "train again"):
        create_run(state.folder, state.capture, *facts)


def _resumed(trainer: "Trainer") -> "Trainer":
    """Load the last checkpoint, if any; a run with hints but without one raises InputError."""
    from refgs.formats.hints import FILE

    trainer.resume()
    state = trainer.state
    what = f"resumed at iteration {state.iteration}"
    if state.iteration == 0:
        if (state.folder / FILE).exists():
            raise InputError(
                f"{state.folder} has no checkpoint left: train again with --from and --hints, into a new folder"
            )
        what = "there is no checkpoint to resume from: starting over"
    state.report("stage", {"what": what})
    return trainer


def _finish(trainer: "Trainer") -> float | None:
    """Write the results and metrics.json; return the mean held-out PSNR, None without held-out views."""
    # splats.ply is written last, because a run that has it counts as finished: a training that is killed here is resumed, and this runs
    # again.
    from refgs.run import record_changes
    from refgs.train.keep.ambiguity import ambiguities
    from refgs.train.keep.asset import write_asset
    from refgs.train.keep.measures import held_out_psnr

    state, out, quality = trainer.state, trainer.state.folder, None
    again = command_line("refgs", "train", state.capture.folder, "--out", out, "--resume", "--device", "cpu")

    def measure() -> None:
        nonlocal quality
        record_changes(out, state.effective.rows())
        trim()
        quality = held_out_psnr(state, most=len(state.test))
        trim()
        what = "what light and materials can make up for"
        trades = ambiguities(state) if state.plan.pays_at_end(what, TRADES) else {}
        update_metrics(out, _most_memory() | {"ambiguities": trades, "total_seconds": state.plan.spent})
        for facts in trades.values():
            if "what" in facts:
                state.report("stage", {"what": facts["what"], "detail": True})
        if (out / PHOTOS).exists():
            trainer.release_photos()
            _remove_photos(out)

    update_metrics(out, _costs(trainer))
    with _card_memory(f"the card's memory is full; nothing is lost, resume with: {again}"):
        write_asset(state, measure)
    return quality


def _remove_photos(out: Path) -> None:
    """Remove the reduced photos from a run folder, after all references to them are dropped."""
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
    """Raise TryAgain if the GPU fails or its memory is full (with the message `what`)."""
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
def _logged(log: _Log) -> Iterator[None]:
    """Write the traceback of a `with` block's unexpected error (no InputError) to the log."""
    try:
        yield
    except InputError:
        raise
    except Exception:
        log.write(traceback.format_exc())
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
