"""Parse the command line. Each command imports its own modules, so that help and wrong arguments are answered at once."""

import os
import signal
import sys
import threading
import traceback
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Annotated, NoReturn

import typer

import refgs
from refgs.asked import Asked
from refgs.errors import TRY_AGAIN, InputError, InputWarning, TryAgain, one_line
from refgs.memory import check_limit, shortage_named
from refgs.paths import command_line, disk_errors_named
from refgs.process import check_arguments, check_current_folder, open_streams, terminate

STATUSES = (
    "Exit status: 0 done; 1 a fault of the program; 2 the input is wrong, a retry is useless; "
    "75 try again: full disk or memory, card that fails, run in use, SIGTERM; 130 Ctrl-C."
)
app = typer.Typer(
    help=refgs.__doc__,
    epilog=STATUSES,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
RunFolder = Annotated[Path, typer.Argument(help="run folder, made by `refgs train`")]
Once = Annotated[
    bool,
    typer.Option("--once", help="do only what is left to do, if anything: a scheduler can repeat the command"),
]


@app.command()
def check(capture: Annotated[Path, typer.Argument(help="folder with photos and cameras")]) -> None:
    """Check a capture: read all of its files, list what it contains, and warn of likely mistakes."""
    from refgs.capture import read_capture
    from refgs.capture.check import describe

    for line in describe(read_capture(capture)):
        print(line)


@app.command()
def frames(
    video: Annotated[Path, typer.Argument(help="video by a phone or camera: MP4, MOV …")],
    out: Annotated[Path, typer.Option(help="folder for the photos: OUT/images/frame_0001.jpg …")],
    count: Annotated[int, typer.Option(min=3, max=1000, help="number of photos, less those that are left out")] = 100,
) -> None:
    """Choose sharp photos from a video, evenly over its time. Leave out blurred photos, and repeats taken while the camera stood still."""
    from refgs import commands

    commands.frames(video, out, count)


@app.command()
def poses(
    photos: Annotated[Path, typer.Argument(help="folder with photos, in it or in its folder images")],
    once: Once = False,
) -> None:
    """Find the cameras of the photos in a folder, and write them to PHOTOS/sparse/0. Then the folder is a capture."""
    from refgs import commands

    commands.poses(photos, once)


@app.command()
def masks(
    capture: Annotated[Path, typer.Argument(help="folder with photos and cameras")],
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", help="region.key=value, a box about the object, e.g. region.size=[1,1,2]"),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="your own model of salient-object segmentation, an ONNX file")
    ] = None,
    once: Once = False,
) -> None:
    """Make masks of the photos and write them to CAPTURE/masks. Strokes in CAPTURE/strokes correct them; your own masks are kept."""
    from refgs import commands

    commands.masks(capture, changes or [], model, once)


@app.command()
def train(
    capture: Annotated[Path, typer.Argument(help="folder with photos and cameras")],
    out: Annotated[Path, typer.Option(help="run folder to create")],
    preset: Annotated[
        str | None,
        typer.Option(help="quick, standard, paper, or a TOML file", show_default="standard, or planned for --minutes"),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda")] = "auto",
    minutes: Annotated[
        float | None,
        typer.Option(min=0.05, help="limit for the whole command, in minutes"),
    ] = None,
    changes: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value, e.g. train.iterations=2000")
    ] = None,
    resume: Annotated[bool, typer.Option(help="resume the run in --out")] = False,
    run: Annotated[Path | None, typer.Option("--from", help="finished run to continue in --out, with --hints")] = None,
    hints: Annotated[Path | None, typer.Option(help="JSON file: which parts of that run are metal or paint")] = None,
    once: Annotated[
        bool,
        typer.Option("--once", help="start, or resume, or do nothing where it is done: a scheduler can repeat it"),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="print all lines of RUN/log.txt, also those for developers")
    ] = False,
) -> None:
    """Train surfels, materials and light from a capture."""
    asked = Asked(capture, out, preset, device, minutes, tuple(changes or ()), resume, run, hints)
    from refgs import commands

    commands.train(asked, once, verbose)
    if not (out / "mesh.glb").exists():
        print(f"next, make its mesh and textures: {command_line('refgs', 'export', out)}")


@app.command()
def render(
    run: RunFolder,
    cameras: Annotated[Path, typer.Option(help="NeRF-Blender or nerfstudio JSON, in the capture's frame")],
    out: Annotated[Path, typer.Option(help="folder for the images: OUT/PASS/NAME.png")],
    passes: Annotated[
        str, typer.Option(help="some of color,normal,albedo,roughness,metallic,depth,alpha,visibility")
    ] = "color",
    hdri: Annotated[Path | None, typer.Option(help="panorama to relight with, .exr or .hdr")] = None,
    format: Annotated[str, typer.Option(help="png or exr")] = "png",
) -> None:
    """Render images of a trained run, from the cameras in a JSON file."""
    from refgs import commands

    commands.render(run, cameras, out, passes.split(","), hdri, format)


@app.command()
def evaluate(
    run: RunFolder,
    split: Annotated[str, typer.Option(help="test or train")] = "test",
    ground_truth: Annotated[
        Path | None,
        typer.Option(help="folder with light.exr, mesh.ply, relight/, and normal/, albedo/ … of the views, as EXR"),
    ] = None,
    once: Once = False,
) -> None:
    """Compare renderings with held-out photos; write metrics.json and pictures/."""
    from refgs import commands

    commands.evaluate(run, split, ground_truth, once)


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="run folder, or file of splats by any program, .ply or .spz")],
    mesh: Annotated[Path | None, typer.Option(help="mesh file, .glb or .obj (default: RUN/mesh.glb)")] = None,
    texture: Annotated[int | None, typer.Option(min=64, max=8192, help="side of the textures, in pixels")] = None,
    splats: Annotated[Path | None, typer.Option(help="write the splats to this file")] = None,
    display_splats: Annotated[
        Path | None,
        typer.Option(
            help="write splats for viewers of 3D Gaussians, .ply, .glb, .spz or .usdc, with the light baked into their colours"
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="replace files that exist")] = False,
    once: Once = False,
) -> None:
    """Export the textured mesh: fuse depth, simplify, unwrap, bake. With a splats option, export a mesh only if --mesh is given too."""
    from refgs import commands

    commands.export(run, mesh, texture, splats, display_splats, overwrite, once)


@app.command()
def report(
    runs: Annotated[list[Path], typer.Argument(help="run folders; several are shown side by side")],
    out: Annotated[Path | None, typer.Option(help="file of the page (default: RUN/report.html)")] = None,
) -> None:
    """Write one self-contained HTML page about runs: pictures, error measures, and charts of error against run time."""
    from refgs.report.page import write_report

    target = out or runs[0] / "report.html"
    write_report(runs, target)
    print(target)


@app.command()
def batch(
    source: Annotated[Path, typer.Argument(help="list of captures, a TOML file, or a folder of captures")],
    out: Annotated[Path, typer.Option(help="folder for the runs, and for the page about them, index.html")],
    preset: Annotated[str | None, typer.Option(help="as for train, where the list does not say")] = None,
    minutes: Annotated[float | None, typer.Option(min=0.05, help="as for train, where the list does not say")] = None,
    changes: Annotated[list[str] | None, typer.Option("--set", help="as for train; the list's come after")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda")] = "auto",
    cores: Annotated[int | None, typer.Option(min=1, help="cores of each step", show_default="as fit")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="steps at once on this machine", show_default="as fit")
    ] = None,
    address: Annotated[
        str | None, typer.Option(help="HOST:PORT of a Ray cluster's head", show_default="this machine")
    ] = None,
) -> None:
    """Train many captures: find cameras, make masks, train, evaluate and export each. Run it again to resume, or to add captures."""
    from refgs import commands

    commands.batch(source, out, preset, minutes, changes or [], device, cores, workers, address)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="folder for all results")] = Path("demo"),
) -> None:
    """Demonstrate all steps: render a small capture, train on it, export a mesh, relight it in Blender's Eevee, and write a report."""
    from refgs import demo

    demo.run(out)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def bench(
    context: typer.Context,
    what: Annotated[
        str,
        typer.Argument(
            help="kernels, truth, real, cameras, paper, needs, poses, minutes, look, gpu, many, farm or page; another word lists them"
        ),
    ] = "kernels",
) -> None:
    """Run a benchmark: time the program's parts in milliseconds, or train on scenes and measure errors. `--csv FILE` writes the results."""
    from refgs import commands

    commands.bench(what, context.args)


@app.command()
def stability(
    only: Annotated[str, typer.Option(help="run only cases whose name holds this word, or this group")] = "",
) -> None:
    """Test extreme inputs in every kernel and in training, and print a table. Exit status 1 if a test fails."""
    from refgs import commands

    commands.stability(only)


@app.command()
def worker() -> None:
    """Speak the job protocol of the Blender extension on stdin and stdout."""
    from refgs import worker

    worker.work()


def _terminate(*_) -> None:
    """Handle SIGTERM: end with the status TRY_AGAIN. `commands.train` has a handler of its own, which writes a checkpoint first."""
    with suppress(OSError):
        os.write(2, b"refgs: terminated: run the command again\n")  # print may be at work already
    sys.exit(TRY_AGAIN)


def _end_with_input() -> None:
    """End this process by SIGTERM when its standard input closes, which means that the process that started it has died."""
    while os.read(0, 1024):
        pass
    terminate()


def _one_line(show):
    """Make a replacement for `warnings.showwarning`. It prints an InputWarning as one line and passes other warnings to `show`."""

    def shown(message, category, *where) -> None:
        if issubclass(category, InputWarning):
            print(f"refgs: warning: {one_line(message)}", file=sys.stderr)
        else:
            show(message, category, *where)

    return shown


def main() -> None:
    """Run the command that the arguments name, and exit with one of STATUSES.

    An error in the input is printed as one line. A bug of the program is printed as a traceback.

    If the environment has REFGS_END_WITH_INPUT, the command also ends when its standard input closes. `refgs batch` sets it for the
    commands that it starts.
    """
    output = open_streams()
    warnings.showwarning = _one_line(warnings.showwarning)
    signal.signal(signal.SIGTERM, _terminate)
    os.environ["PYTHONSAFEPATH"] = "1"  # for children: multiprocessing's would import what lies in the current folder
    if "REFGS_END_WITH_INPUT" in os.environ:
        threading.Thread(target=_end_with_input, daemon=True).start()
    try:
        with shortage_named(), disk_errors_named([], "run the command again"):
            check_arguments()
            check_current_folder()
            check_limit()
            app(standalone_mode=True)
    except SystemExit as ended:
        sys.stdout.flush()
        if not ended.code and output.error:
            why = f"what was printed cannot be written ({output.error.strerror})"
            _end(TRY_AGAIN, f"refgs: {why}: mend that, and run the command again\n")
        raise
    except InputError as error:
        _end(TRY_AGAIN if isinstance(error, TryAgain) else 2, f"refgs: {one_line(error)}\n")
    except KeyboardInterrupt:
        _end(130, "refgs: interrupted\n")
    except Exception as error:
        what = f"refgs: a fault of ours: {type(error).__name__}: {one_line(error)}\n"
        _end(1, traceback.format_exc() + what)


def _end(status: int, said: str) -> NoReturn:
    """Print a message to the standard error, and exit with `status`, even if printing fails because a log's disk is full."""
    with suppress(OSError):
        sys.stderr.write(said)
        sys.stderr.flush()
    sys.exit(status)


if __name__ == "__main__":
    main()
