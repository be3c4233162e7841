"""Run the commands of the command line. There is one function for each command."""

import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from refgs import train_job
from refgs.asked import Asked, check_device
from refgs.errors import TRY_AGAIN, InputError
from refgs.events import event_line
from refgs.export.export_job import export as export_run
from refgs.lock import remove_stale_lock
from refgs.paths import clone_root, command_line, disk_errors_named, make_folders
from refgs.process import terminate
from refgs.run_folder import check_finished, run_metrics, update_metrics

console = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)  # paths are printed as they are
CHECKPOINT_BY, END_BY = 7.0, 9.5  # seconds after SIGTERM: give up the checkpoint, give up everything
BATCH_END_BY = 25.0  # the same for a batch: its commands need END_BY, and then it writes the page
PASSES = ("color", "normal", "albedo", "roughness", "metallic", "depth", "alpha", "visibility")


@contextmanager
def progress_bar(what: str, total: int):
    """Show a progress bar with the estimated time left during a `with` block.

    Yields a function update(done, note, total) that moves the bar and shows the text `note`.
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(what, total=total, note="")
        yield lambda done, note="", total=total: progress.update(task, completed=done, note=note, total=total)


@contextmanager
def job_report(what: str):
    """Show the events of a long-running job: progress as a bar with the label `what`, other events as lines.

    Yields the function report(event, facts) that the job must call.
    """
    with progress_bar(what, 1) as bar:

        def report(event: str, facts: dict) -> None:
            if event == "progress":
                bar(facts["done"], facts["stage"], facts["total"])
            else:
                console.print(event_line(event, facts))

        yield report


def frames(video: Path, out: Path, count: int) -> None:
    """Choose up to `count` photos from a video and write them to OUT/images."""
    from refgs.capture.video import extract_photos

    with progress_bar("reading frames", 1) as bar:

        def report(event: str, facts: dict) -> None:
            bar(facts["done"], f"{facts['kept']} kept, {facts['blurred']} blurred", facts["total"])

        found = extract_photos(video, out, count, report)
    console.print(
        f"{found['frames']} frames read, {found['photos']} photos kept, {found['blurred']} left out as blurred, "
        f"{found['duplicates']} as duplicates: {out / 'images'}"
    )


def poses(folder: Path, once: bool = False) -> None:
    """Find the cameras of the photos in a folder. If the search is interrupted, running the command again resumes it.

    With `once`, a folder that has cameras is left as it is.
    """
    from refgs.capture import find_layout
    from refgs.capture.motion import find_cameras

    if once and find_layout(folder) is not None:
        console.print(f"done before: {folder} has cameras")
        return
    with job_report("finding cameras") as report:
        found = find_cameras(folder, report)
    console.print(
        f"{found['placed']} of {found['photos']} photos placed, to {found['error']:.2f} pixels: {folder / 'sparse' / '0'}"
    )
    if found["learned"]:
        console.print("Learned features were used, because SIFT placed fewer photos or placed them less exactly.")
    if found["inside"]:
        console.print("The object turned in front of still surroundings: only the pixels inside the masks were used.")


def masks(folder: Path, changes: list[str], model: Path | None = None, once: bool = False) -> None:
    """Make masks of a capture's photos, and write them to its folder `masks`.

    `changes` are settings of a box around the object, such as `region.size=[1,1,2]`. `model` is an ONNX file that finds the object's
    pixels; without it, colours are used. With `once`, nothing is done if any photo has a mask already.
    """
    from refgs.capture import read_capture
    from refgs.capture.masks import make_masks
    from refgs.settings import load_settings

    if once and any(view.masked for view in read_capture(folder).views):
        console.print(f"done before: {folder} has masks")
        return
    with job_report("making masks") as report:
        found = make_masks(folder, load_settings("standard", changes).region, report, model)
    kept = f", {found['kept']} of yours kept" if found["kept"] else ""
    console.print(f"{found['made']} masks made{kept}: {folder / 'masks'}")
    console.print(f"the object's box: {' '.join(found['region'])}")


def train(asked: Asked, once: bool = False, verbose: bool = False) -> None:
    """Train on a capture and write a run folder, or resume the training in it.

    Ctrl-C ends the training with a checkpoint, from which it can be resumed. A second Ctrl-C ends it at once. SIGTERM also ends it with a
    checkpoint. If this checkpoint is not complete CHECKPOINT_BY seconds after SIGTERM, the training ends without it. The training can then
    be resumed from the previous checkpoint.

    With `once`, a training that has ended is left as it is; any other is started or resumed. Each call must have the same settings as the
    first one. With `verbose`, details are printed, too, which are in log.txt otherwise (see `events.Report`).
    """
    if once:
        left = train_job.unfinished(asked)
        if left is None:
            console.print(f"done before: {asked.out}")
            return
        if left:
            asked = asked.resumed()
    with progress_bar("training", 1) as bar, _signals_to_stop() as stopped:

        def report(event: str, facts: dict) -> None:
            if event == "progress" and "stage" in facts:  # of masks
                if stopped:
                    _end(stopped)
                bar(facts["done"], f"making masks: {facts['stage']}", facts["total"])
            elif event == "progress":
                note = f"loss {facts['loss']:.4f}  {facts['psnr']:.2f} dB  {facts['splats']:,} surfels"
                bar(facts["iteration"], note, facts["total"])
            elif event != "measured" and (verbose or not facts.get("detail")):
                console.print(event_line(event, facts))

        state, quality = train_job.train(asked, report, lambda _: bool(stopped))
    if not state.ended:
        again = command_line("refgs", "train", asked.capture, "--out", asked.out, "--resume")
        console.print(f"stopped at iteration {state.iteration}; resume with: {again}")
        _end(stopped)
    held_out = "" if quality is None else f", {quality:.2f} dB on {len(state.capture.test_views)} held-out views"
    console.print(f"trained {state.iteration} iterations in {state.seconds:.0f} s{held_out}: {asked.out}")


@contextmanager
def _signals_to_stop(repeat: float | None = CHECKPOINT_BY, end: float = END_BY) -> Iterator[list[int]]:
    """Yield an empty list to a `with` block. The first SIGINT or SIGTERM is appended to this list. A second signal ends the block at once.

    After a first SIGTERM, the process sends itself another one `repeat` seconds later, unless `repeat` is None. It exits `end` seconds
    after the first SIGTERM, even if it is busy.
    """
    stopped, timers = [], []

    def stop(number: int, _) -> None:
        if stopped:
            _end([number])
        stopped.append(number)  # the training ends after this iteration, with a checkpoint
        if number == signal.SIGTERM:
            if repeat is not None:
                after(repeat, terminate)
            after(end, lambda: os._exit(TRY_AGAIN))

    def after(seconds: float, what: Callable[[], None]) -> None:
        timers.append(threading.Timer(seconds, what))
        timers[-1].daemon = True
        timers[-1].start()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for timer in timers:
            timer.cancel()


def _end(signals: list[int]) -> None:
    """End the process: with the status TRY_AGAIN if the first signal was SIGTERM, else by raising KeyboardInterrupt, as Ctrl-C does."""
    if signals and signals[0] == signal.SIGTERM:
        sys.exit(TRY_AGAIN)
    raise KeyboardInterrupt


def render(folder: Path, cameras: Path, out: Path, passes: list[str], hdri: Path | None, format: str) -> None:
    """Render images of a trained run: for each camera and each pass, write OUT/PASS/NAME.png or .exr."""
    for name in passes:
        if name not in PASSES:
            raise InputError(f"--passes {name}: take some of {', '.join(PASSES)}")
    if format not in ("png", "exr"):
        raise InputError(f"--format {format}: take png or exr")
    check_finished(folder)  # before torch is imported
    import numpy as np

    from refgs.capture import read_cameras
    from refgs.capture.poses import in_frame
    from refgs.compare.pictures import color_picture, maps, picture, write_png
    from refgs.formats.exr import write_exr
    from refgs.run import open_run

    run = open_run(folder)
    _check_passes(run, passes, format)
    light = None if hdri is None else _relight(run, hdri)
    to_run = np.linalg.inv(run.to_capture)
    views = [in_frame(camera, to_run) for camera in read_cameras(cameras)]
    background = np.array(run.settings.image.background)
    make_folders([out])
    with disk_errors_named([out], "render again"), progress_bar("rendering", len(views)) as bar:
        for done, camera in enumerate(views):
            rendering = run.render(camera, light)
            images = maps(rendering)
            for name in passes:
                path = out / name / f"{camera.name}.{format}"
                if format == "exr":
                    path.parent.mkdir(parents=True, exist_ok=True)
                    write_exr(path, images[name])
                elif name == "color":
                    write_png(path, color_picture(rendering, background))
                else:
                    write_png(path, picture(name, images[name], images["alpha"]))
            bar(done + 1)
    console.print(f"{len(views)} views, {', '.join(passes)}: {out}")


def _check_passes(run, passes: list[str], format: str) -> None:
    """Raise InputError if the run cannot give a requested pass, such as "albedo", in this file format."""
    without = {"albedo", "roughness", "metallic"} if run.environment is None else set()
    without |= {"visibility"} if run.occluder is None else set()
    if missing := [name for name in passes if name in without]:
        raise InputError(f"--passes {missing[0]}: this run has {', '.join(p for p in PASSES if p not in without)}")
    if format == "exr" and "color" in passes and run.environment is None:
        raise InputError("--format exr: a run with shading = sh has no linear radiance; take png")


def _relight(run, hdri: Path):
    """Load a panorama and return it as a light for the run.

    If the run has inter-reflection, also compute the object's reflections of itself under this light. This traces rays and shows a progress
    bar. The run caches the result for rendering. Raises InputError if the run has no materials.
    """
    from refgs.formats.panorama import read_environment

    if run.environment is None:
        raise InputError("--hdri: a run with shading = sh has no materials to relight")
    light = run.light(read_environment(hdri))
    if run.occluder is not None:
        with progress_bar("tracing light", len(run.splats)) as bar:
            run.relit(light, lambda done, total: bar(done))
    return light


def evaluate(folder: Path, split: str, ground_truth: Path | None, once: bool = False) -> None:
    """Compare renderings with held-out photos, and with ground truth if it is given or if the photos' data set has it.

    Writes metrics.json and the folder pictures. With `once`, a run that has been evaluated is left as it is.
    """
    if split not in ("test", "train"):
        raise InputError(f"--split {split}: take test or train")
    check_finished(folder)  # before torch is imported
    if once and run_metrics(folder).get("split") == split:
        console.print(f"done before: {folder} has the metrics of its {split} views")
        return
    from refgs.capture import read_capture
    from refgs.compare.published import published_truth
    from refgs.compare.truth import GroundTruth
    from refgs.report.evaluate import evaluate as measure
    from refgs.report.figures import DETAILS, HEADLINE, in_words, relit_in_words
    from refgs.run import open_run

    run = open_run(folder)
    capture = read_capture(run.capture_folder, run.settings.region)
    capture.check_unchanged(folder, run.fingerprint)
    views = capture.test_views if split == "test" else capture.train_views
    if not views:
        raise InputError(f"{run.capture_folder} has no {split} views")
    if ground_truth:
        truth = GroundTruth(ground_truth, run.to_capture)
    else:
        truth = published_truth(capture, run.to_capture) if split == "test" else None
    with disk_errors_named([folder], "evaluate again"):
        with progress_bar("evaluating", len(views)) as bar:
            figures = measure(run, split, views, truth, bar)
        update_metrics(folder, figures)
    console.print(f"{len(views)} {split} views: {', '.join(in_words(figures, HEADLINE))}")
    for line in [*in_words(figures, DETAILS), *relit_in_words(figures)]:
        console.print(f"  {line}")


def export(
    folder: Path,
    mesh_file: Path | None = None,
    texture: int | None = None,
    splats_file: Path | None = None,
    display_file: Path | None = None,
    overwrite: bool = False,
    once: bool = False,
) -> None:
    """Export a run as a textured mesh or as splats, and print the files written. With `once`, nothing is written if all files exist."""
    if once:
        files = [file for file in (mesh_file, splats_file, display_file) if file] or [folder / "mesh.glb"]
        if all(file.exists() for file in files):  # textures, written before the mesh, may be those of a killed process
            remove_stale_lock(folder)
            console.print(f"done before: {', '.join(map(str, files))}")
            return
        overwrite = True
    with job_report("exporting") as report:
        files = export_run(folder, mesh_file, texture, splats_file, display_file, overwrite, report)
    for file in files:
        console.print(f"wrote {file}")


def batch(
    source: Path,
    out: Path,
    preset: str | None,
    minutes: float | None,
    changes: list[str],
    device: str,
    cores: int | None,
    workers: int | None,
    address: str | None,
) -> None:
    """Train many captures, on this machine or on a cluster, and write a page about them.

    Ctrl-C and SIGTERM end the whole batch. Trainings end with a checkpoint. The same command resumes the batch.
    """
    from refgs.batch.batch import ready
    from refgs.batch.listing import Ask
    from refgs.batch.page import PAGE

    check_device(device)
    ask = Ask(preset=preset, minutes=minutes, set=changes)
    with (
        _batch_bars() as report,
        _signals_to_stop(None, BATCH_END_BY) as stopped,  # also while Ray starts and ends
        ready(source, out, ask, device, report, cores, workers, address) as run,
    ):
        status = run(lambda: bool(stopped))
    console.print(f"the page about all runs: {out / PAGE}")
    if stopped and status:
        # One that comes now, while Python ends, must not change the status.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        _end(stopped)
    sys.exit(status)


@contextmanager
def _batch_bars() -> Iterator[Callable[[str, dict], None]]:
    """Show progress bars during a `with` block: one for the whole batch, and one for each step that runs.

    Yields the function report(event, facts) that the batch must call.
    """
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}")
    with Progress(*columns, console=console, transient=True) as progress:
        whole, bars = progress.add_task("all", total=None, note=""), {}

        def report(event: str, facts: dict) -> None:
            if event != "progress":
                console.print(event_line(event, facts))
                return
            note = f"{facts['failed']} failed" if facts["failed"] else ""
            progress.update(whole, completed=facts["done"], total=facts["total"], note=note)
            working = {f"{one['run']} {one['step']}": one for one in facts["working"]}
            for name in bars.keys() - working.keys():
                progress.remove_task(bars.pop(name))
            for name, one in working.items():
                if name not in bars:
                    bars[name] = progress.add_task(name, total=None, note="")
                progress.update(bars[name], completed=one["done"], total=one["total"] or None)

        yield report


def bench(what: str, options: list[str]) -> None:
    """Run the benchmark `what` from the repository. `options` are its own command-line options."""
    _run_module("benchmarks", [what, *options])


def stability(only: str) -> None:
    """Run the repository's tests of extreme inputs. `only` selects tests by name or group."""
    _run_module("benchmarks.stability", ["--only", only])


def _run_module(name: str, options: list[str]) -> None:
    """Run a Python module of the repository as a program, as `python -m NAME OPTIONS` does."""
    sys.path.insert(0, str(clone_root()))
    sys.argv[1:] = options
    runpy.run_module(name, run_name="__main__")
