"""Training and export, saying how they go: what the terminal (`commands`) and the job protocol (`worker`) have in common."""

import errno
import json
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import torch

from refgs.capture import read_capture
from refgs.errors import InputError, InputWarning
from refgs.export.splats import read_splats, write_display_splats, write_splats
from refgs.kernels import cuda
from refgs.lock import RunLock
from refgs.run import Run, check_free, create_run, open_run, read_run_facts, record_changes, write_text
from refgs.settings import load_settings
from refgs.train.measures import held_out_psnr
from refgs.train.memory import full_card
from refgs.train.plan import Plan
from refgs.train.state import Report, State
from refgs.train.trainer import Trainer

DISKS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EIO,
    errno.EROFS,
    errno.EACCES,
)  # errors that are the disk's, not the program's


def choose_device(device: str, report: Report) -> str:
    """What to train on, "cpu" or "cuda". Warns where a card was asked for, or is there, and cannot be used."""
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {device}: take auto, cpu or cuda")
    if device == "cpu":
        return "cpu"
    why = cuda.unusable()
    if why is None:
        return "cuda"
    if device == "cuda" or why != cuda.NO_CARD:
        report("warning", {"what": f"training on the CPU: {why}"})
    return "cpu"


def train(
    capture_folder: Path,
    out: Path,
    preset: str | None,
    device: str,
    minutes: float | None,
    changes: list[str],
    resume: bool,
    report: Report,
    attend: Callable[[State], bool],
) -> tuple[State, float | None]:
    """Train a capture into a run folder; its asset is written when the training has ended.

    Where `minutes` are given it makes as many iterations as fit, and all is written by then; what it is paused for is not counted. Without
    a preset everything else is chosen for that time, too; without either it is the standard one.
    `attend` is called before each iteration and stops it by True, as another process can (`refgs.lock`); the checkpoint then written
    is what `resume` goes on from. The state that is returned says by `ended` which it was. With it comes the mean PSNR of the
    held-out views, if there are any and the training has ended.
    """
    from refgs.train.ambiguity import ambiguities
    from refgs.train.asset import write_asset
    from refgs.train.fit import fitting

    plan, planned = Plan(minutes), preset is None and minutes is not None and not resume
    preset = preset or "standard"
    device = choose_device(device, report)
    lock = RunLock(out)
    if resume:
        facts, settings = read_run_facts(out)
        if changes:
            raise InputError("--set cannot change a run that is resumed: train into a new folder")
    else:
        settings = load_settings(preset, changes)
        check_free(out)
    with ExitStack() as held:
        if resume:
            held.enter_context(lock)
            if (out / "splats.ply").exists():
                raise InputError(f"{out}: this training has ended; there is nothing to resume")
        capture = read_capture(capture_folder, settings.region)
        if resume and capture.fingerprint() != facts["fingerprint"]:
            raise InputError(f"{capture_folder} is not the capture that {out} was trained on, or it was changed since")
        try:
            if planned:
                trainer, preset = fitting(capture, changes, out, plan, device, report), f"{minutes:g} minutes"
            else:
                trainer = Trainer(capture, settings, out, report, plan, device)
            state = trainer.state
            if resume:
                trainer.resume()
                report("stage", {"what": f"going on from iteration {state.iteration}"})
            else:
                with _on_disk([out], "train again"):
                    create_run(out, capture, state.settings, preset, device, state.effective.chosen())
                    record_changes(out, state.effective.rows())
                held.enter_context(lock)
            held.enter_context(_on_disk([out], "go on with --resume"))
            trainer.run(lambda: attend(state) or lock.attend(state.iteration, state.total, state.seconds))
        except torch.OutOfMemoryError:
            raise full_card() from None
        except InputError:
            raise
        except Exception:
            with suppress(OSError):
                (out / "log.txt").write_text(traceback.format_exc(), encoding="utf-8")
            raise
        if not state.ended:
            return state, None
        facts = {"training_seconds": state.seconds, "processor_seconds": state.processor_seconds}
        facts["steps_left_out"] = trainer.guard.left_out
        if peak := peak_memory():
            facts["peak_memory_bytes"] = peak
        if device == "cuda":
            facts["peak_card_memory_bytes"] = torch.cuda.max_memory_allocated()
        update_metrics(out, facts)
        try:
            write_asset(state)
            record_changes(out, state.effective.rows())
            quality = held_out_psnr(state, most=len(state.test))
            trades = ambiguities(state)
        except torch.OutOfMemoryError:
            again = f"refgs train {capture_folder} --out {out} --resume --device cpu"
            raise InputError(f"the card's memory is full; nothing is lost, go on with: {again}") from None
        update_metrics(out, {"ambiguities": trades, "total_seconds": plan.spent})
        for facts in trades.values():
            if "what" in facts:
                report("stage", {"what": facts["what"]})
        return state, quality


@contextmanager
def _on_disk(folders: list[Path], again: str) -> Iterator[None]:
    """Raise InputError where it is the disk that failed which the folders are on: full, not to be written, or taken out."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if gone := next((folder for folder in folders if not folder.is_dir()), None):
            raise InputError(f"{gone} is no longer there: put its disk back, then {again}") from error
        if isinstance(error, OSError) and error.errno in DISKS:
            why = f"{error.filename or folders[0]} cannot be written ({error.strerror})"
            raise InputError(f"{why}: mend that, then {again}; what was written before is whole") from error
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
    """Fuse, clean, unwrap, bake; write the mesh and its textures. Where splats are asked for, they alone, unless the mesh's file is named
    too. Of a PLY file in a run's place, splats only. Returns what was written."""
    from refgs.export.display import displayed
    from refgs.export.mesh import FOLDER

    alone = folder.suffix.lower() == ".ply" and not folder.is_dir()
    if alone and (mesh_file or not (splats_file or display_file)):
        raise InputError(
            f"{folder} is no run folder, so there is no mesh: add --splats FILE.ply or --display-splats FILE.ply"
        )
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", InputWarning)
        run = None if alone else open_run(folder)
        source = read_splats(folder) if run is None else run.splats
    for warning in said:
        report("warning", {"what": str(warning.message)})
    splats = [file for file in (splats_file, display_file) if file is not None]
    target = mesh_file if mesh_file or splats else folder / "mesh.glb"
    if target is not None and target.suffix.lower() not in (".glb", ".obj"):
        raise InputError(f"{target}: a mesh is written as .glb or .obj; give it a name that ends so")
    for file in splats:
        if file.suffix.lower() != ".ply" or splats.count(file) > 1:
            raise InputError(f"{file}: splats are written as .ply, each to a file of its own")
    beside = [target, target.parent / FOLDER] if target else []
    if target is not None and target.suffix.lower() == ".obj":
        beside.append(target.with_suffix(".mtl"))
    for file in [*splats, *beside]:
        if file.exists() and not overwrite:
            raise InputError(f"{file} exists: add --overwrite to replace it, or name another file")
    folders = [file.parent for file in [*splats, *beside[:1]]]
    try:
        for out in folders:
            out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: the folder cannot be made ({error.strerror}): choose another") from None
    with _on_disk(folders, "export again"):
        if splats_file is not None:
            write_splats(splats_file, source)
        if display_file is not None and run is None:
            write_display_splats(display_file, source)  # their colours are there already
        elif display_file is not None:
            report("stage", {"what": "learning colours by direction"})

            def learned(done: int, total: int) -> None:
                if done % 10 == 0:
                    report("progress", {"stage": "colours", "done": done, "total": total})

            write_display_splats(display_file, displayed(run, learned))
        if target is None:
            return splats
        with RunLock(folder) if target.parent == folder else nullcontext():
            _write_mesh(run, target, texture, report)
    return [*splats, target]


def _write_mesh(run: Run, target: Path, texture: int | None, report: Report) -> None:
    from refgs.export.bake import bake
    from refgs.export.mesh import write_glb, write_obj
    from refgs.export.outline import bring_out
    from refgs.export.unshadowed import unshadowed
    from refgs.export.unwrap import layout, unwrap
    from refgs.geometry.extract import extract
    from refgs.geometry.mesh import clean, is_crumbs

    settings, cameras = run.settings.mesh, run.training_cameras()
    mesh, voxel = extract(run.surfels(), cameras, run.near, run.centre, run.radius, settings.resolution)
    report("stage", {"what": f"fused {len(mesh.faces):,} triangles"})
    mesh = clean(mesh, settings.triangles)
    report("stage", {"what": f"simplified to {len(mesh.faces):,} triangles; bringing it out to its outlines"})
    mesh = bring_out(mesh, run.render, cameras, voxel)
    report("stage", {"what": "unwrapping"})
    if is_crumbs(mesh):
        what = (
            "the mesh is in pieces, none of them half of it: the photos do not agree on a surface; "
            "give them masks of the object, or take more of them"
        )
        report("warning", {"what": what})
    mesh = unwrap(mesh)
    charts = layout(mesh)
    density = " to ".join(f"{value:.2f}" for value in charts.density)
    what = f"{charts.used:.0%} of the texture used, density {density}, angles bent by {charts.bend:.1f}°; baking"
    report("stage", {"what": what})

    def baked(done: int, total: int) -> None:
        report("progress", {"stage": "baking", "done": done, "total": total})

    splats, light = run.splats, run.environment
    stands = light is not None and light.reference is None
    if stands and run.occluder is None and run.settings.render.color_space == "linear":
        splats = unshadowed(splats, run.surfels(), mesh, light)
    textures = bake(mesh, splats, texture or settings.texture, baked)
    report("stage", {"what": "writing"})
    write = write_obj if target.suffix.lower() == ".obj" else write_glb
    write(target, mesh, textures)


def update_metrics(folder: Path, facts: dict[str, Any]) -> None:
    """Put figures into a run's metrics.json beside those that are there, replacing the ones of the same name at every depth."""

    def merged(known: dict, new: dict) -> dict:
        both = {key: merged(known[key], new[key]) for key in new if isinstance(known.get(key), dict)}
        return known | new | both

    file = folder / "metrics.json"
    known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    write_text(file, json.dumps(merged(known, facts), indent=1))


def peak_memory(children: bool = False) -> int | None:
    """The most memory that this process has held, or any of its children that have ended, in bytes; None where the system, which is
    Windows, does not keep it so."""
    try:
        import resource
    except ModuleNotFoundError:
        return None
    most = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
