"""Train and export, and report progress: what the command line (`commands`) and the job protocol (`worker`) share.

Importing torch takes seconds. It is imported only once everything that can be wrong without it has been checked.
"""

import errno
import json
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refgs.capture import Capture, read_capture
from refgs.errors import InputError, InputWarning
from refgs.lock import RunLock
from refgs.paths import write_text
from refgs.run_folder import check_finished, check_free, read_run_facts
from refgs.settings import Settings, load_settings
from refgs.train.plan import Plan

if TYPE_CHECKING:
    from refgs.formats.splats import Splats
    from refgs.run import Run
    from refgs.train.state import State
    from refgs.train.trainer import Trainer

Report = Callable[[str, dict[str, Any]], None]
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EACCES)


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

    `minutes` limits the whole job, pauses not counted; without a preset all settings are then planned for that time. Without
    `minutes` the preset is `standard`. `attend` is called before each iteration: True stops the training with a checkpoint, which
    `resume` starts from. Another process can stop it too (`refgs.lock`). Returns the state, whose `ended` tells a finished
    training from a stopped one, and the mean PSNR of the held-out views if it has ended and there are any.
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
            held.enter_context(_disk_errors_named([out], "resume with --resume"))
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


def _read_capture(folder: Path, settings: Settings, out: Path, facts: dict | None) -> Capture:
    capture = read_capture(folder, settings.region)
    if facts is not None and capture.fingerprint() != facts["fingerprint"]:
        raise InputError(f"{folder} is not the capture that {out} was trained on, or it was changed since")
    return capture


def _start(
    capture: Capture,
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
    with _disk_errors_named([out], "train again"):
        effective = trainer.state.effective
        create_run(out, capture, effective.settings, preset or "standard", device, effective.chosen())
        record_changes(out, effective.rows())
    return trainer


def _resume(capture: Capture, settings: Settings, out: Path, plan: Plan, device: str, report: Report) -> "Trainer":
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
    """Raise InputError, with the line `what`, where the card's memory does not suffice."""
    import torch

    from refgs.train.densify import full_card

    try:
        yield
    except torch.OutOfMemoryError:
        raise (InputError(what) if what else full_card()) from None


@contextmanager
def _logged(out: Path) -> Iterator[None]:
    """Write the traceback of an error that is not the user's to log.txt."""
    try:
        yield
    except InputError:
        raise
    except Exception:
        with suppress(OSError):
            (out / "log.txt").write_text(traceback.format_exc(), encoding="utf-8")
        raise


@contextmanager
def _disk_errors_named(folders: list[Path], again: str) -> Iterator[None]:
    """Raise InputError if the disk of these folders is full, read-only or gone."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if gone := next((folder for folder in folders if not folder.is_dir()), None):
            raise InputError(f"{gone} is no longer there: put its disk back, then {again}") from error
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            why = f"{error.filename or folders[0]} cannot be written ({error.strerror})"
            raise InputError(f"{why}: mend that, then {again}; files written before are complete") from error
        raise


def export(
    folder: Path,
    mesh_file: Path | None,
    texture: int | None,
    splats_file: Path | None,
    display_file: Path | None,
    overwrite: bool,
    report: Report,
) -> list[Path]:
    """Export the textured mesh of a run, or its splats; return the files written.

    Where a splats file is named, the mesh is written only if its file is named too. `folder` may be a PLY file of splats
    instead of a run: it has no mesh.
    """
    splats = [file for file in (splats_file, display_file) if file is not None]
    is_run = folder.is_dir() or folder.suffix.lower() != ".ply"
    if not is_run and (mesh_file or not splats):
        raise InputError(
            f"{folder} is no run folder, so there is no mesh: add --splats FILE.ply or --display-splats FILE.ply"
        )
    if is_run:
        check_finished(folder)
    target = mesh_file if mesh_file or splats else folder / "mesh.glb"
    _check_names(target, splats)
    _check_absent([*splats, *_mesh_files(target)], overwrite)
    run, source = _read_source(folder, is_run, report)
    folders = [file.parent for file in [*splats, target] if file]
    _make_folders(folders)
    with _disk_errors_named(folders, "export again"):
        _write_splats(run, source, splats_file, display_file, report)
        if target is None:
            return splats
        with RunLock(folder) if target.parent == folder else nullcontext():
            _write_mesh(run, target, texture, report)
    return [*splats, target]


def _check_names(target: Path | None, splats: list[Path]) -> None:
    if target is not None and target.suffix.lower() not in (".glb", ".obj"):
        raise InputError(f"{target}: a mesh is written as .glb or .obj; give it a name that ends so")
    for file in splats:
        if file.suffix.lower() != ".ply" or splats.count(file) > 1:
            raise InputError(f"{file}: splats are written as .ply, each to a file of its own")


def _mesh_files(target: Path | None) -> list[Path]:
    """Return the mesh's file and what is written beside it."""
    from refgs.formats.textures import FOLDER

    if target is None:
        return []
    materials = [target.with_suffix(".mtl")] if target.suffix.lower() == ".obj" else []
    return [target, target.parent / FOLDER, *materials]


def _check_absent(files: list[Path], overwrite: bool) -> None:
    for file in files:
        if file.exists() and not overwrite:
            raise InputError(f"{file} exists: add --overwrite to replace it, or name another file")


def _read_source(folder: Path, is_run: bool, report: Report) -> "tuple[Run | None, Splats]":
    """Open the run, or read the PLY file of splats; report what was left out of it."""
    from refgs.formats.splats import read_splats
    from refgs.run import open_run

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        run = open_run(folder) if is_run else None
        splats = run.splats if run else read_splats(folder)
    for warning in caught:
        report("warning", {"what": str(warning.message)})
    return run, splats


def _make_folders(folders: list[Path]) -> None:
    try:
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: the folder cannot be made ({error.strerror}): choose another") from None


def _write_splats(run: "Run | None", source: "Splats", ours: Path | None, display: Path | None, report: Report) -> None:
    from refgs.export.display import displayed
    from refgs.formats.splats import write_display_splats, write_splats

    def learned(done: int, total: int) -> None:
        if done % 10 == 0:
            report("progress", {"stage": "colours", "done": done, "total": total})

    if ours is not None:
        write_splats(ours, source)
    if display is not None and run is None:
        write_display_splats(display, source)  # a foreign PLY has its colours by direction
    elif display is not None:
        report("stage", {"what": "learning colours by direction"})
        write_display_splats(display, displayed(run, learned))


def _write_mesh(run: "Run", target: Path, texture: int | None, report: Report) -> None:
    """Fuse, simplify, unwrap and bake the mesh, and write it with its textures."""
    from refgs.export.bake import bake
    from refgs.formats.gltf import write_glb
    from refgs.formats.obj import write_obj

    mesh = _make_mesh(run, report)

    def baked(done: int, total: int) -> None:
        report("progress", {"stage": "baking", "done": done, "total": total})

    textures = bake(mesh, _baked_splats(run, mesh), texture or run.settings.mesh.texture, baked)
    report("stage", {"what": "writing"})
    write = write_obj if target.suffix.lower() == ".obj" else write_glb
    write(target, mesh, textures)


def _make_mesh(run: "Run", report: Report) -> Any:
    """Return the simplified mesh with texture coordinates."""
    from refgs.export.outline import fit_to_outlines
    from refgs.export.unwrap import layout, unwrap
    from refgs.geometry.mesh import clean, is_crumbs
    from refgs.render.extract import extract

    settings, cameras = run.settings.mesh, run.training_cameras()
    mesh, voxel = extract(run.surfels(), cameras, run.near, run.centre, run.radius, settings.resolution)
    report("stage", {"what": f"fused {len(mesh.faces):,} triangles"})
    mesh = clean(mesh, settings.triangles)
    report("stage", {"what": f"simplified to {len(mesh.faces):,} triangles; fitting it to the outlines"})
    mesh = fit_to_outlines(mesh, run.render, cameras, voxel)
    report("stage", {"what": "unwrapping"})
    if is_crumbs(mesh):
        what = "the mesh is in pieces, none of them half of it: the photos do not agree on a surface"
        report("warning", {"what": f"{what}; give them masks of the object, or take more of them"})
    mesh = unwrap(mesh)
    charts = layout(mesh)
    density = " to ".join(f"{value:.2f}" for value in charts.density)
    what = f"{charts.used:.0%} of the texture used, density {density}, angles bent by {charts.bend:.1f}°; baking"
    report("stage", {"what": what})
    return mesh


def _baked_splats(run: "Run", mesh: Any) -> "Splats":
    """Return the splats to bake: shadows are taken out where the recovered light cannot have accounted for them."""
    from refgs.export.unshadowed import unshadowed
    from refgs.render.baselines import method_of

    light = run.environment
    stands = light is not None and light.reference is None
    if stands and run.occluder is None and not method_of(run.settings.render).light.display:
        return unshadowed(run.splats, run.surfels(), mesh, light)
    return run.splats


def update_metrics(folder: Path, facts: dict[str, Any]) -> None:
    """Merge figures into a run's metrics.json; one of the same name, at any depth, is replaced."""

    def merged(known: dict, new: dict) -> dict:
        both = {key: merged(known[key], new[key]) for key in new if isinstance(known.get(key), dict)}
        return known | new | both

    file = folder / "metrics.json"
    known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    write_text(file, json.dumps(merged(known, facts), indent=1))


def peak_memory(children: bool = False) -> int | None:
    """Return the peak memory of this process, or of its children that have ended, in bytes; None on Windows, which keeps no such count."""
    try:
        import resource
    except ModuleNotFoundError:
        return None
    most = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
