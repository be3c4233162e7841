"""Demonstrate RefGS: render a capture of a test scene, train on it, export a mesh, and relight it in Blender."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from refgs import commands, train_job
from refgs.asked import Asked
from refgs.compare import metrics
from refgs.compare.truth import read_relit
from refgs.errors import InputError
from refgs.paths import clone_environment, clone_root
from refgs.report.page import write_report
from refgs.run_folder import update_metrics

SCENE = "jar"
HDRIS = ("studio", "courtyard")  # shipped with Blender; the capture is lit by another one
VIEWS = ("test_002", "test_004")


def run(out: Path) -> None:
    """Run the demo. Write the capture, the trained run, the mesh, a .blend file, preview images and a report to the folder `out`.

    Steps that were done by an earlier call are skipped.
    """
    started = time.perf_counter()
    root, out = clone_root(), out.resolve()
    capture, folder = out / "capture", out / "run"
    _check_blender(root)
    if (folder / "report.html").exists():
        raise InputError(
            f"{out} holds a finished demo: see {folder / 'report.html'}, or choose another folder with --out"
        )
    out.mkdir(parents=True, exist_ok=True)

    def stage(what: str) -> None:
        commands.console.print(f"[{time.perf_counter() - started:4.0f} s] {what}")

    if not capture.exists():
        stage("rendering a capture with Cycles: 80 photos of a jar of gold, copper and glazed ceramic")
        _child(root, "rendering", "scripts.demo", SCENE, "--out", capture, "--relight", *HDRIS)
    if not (folder / "splats.ply").exists():
        stage("training surfels, materials and light")
        commands.train(Asked(capture, folder, "quick", resume=(folder / "run.toml").exists()))
    if not (folder / "mesh.glb").exists():
        stage("fusing and baking the mesh")
        commands.export(folder)
    stage("measuring against the ground truth")
    commands.evaluate(folder, "test", capture / "ground_truth")
    stage("importing into Blender and relighting in Eevee")
    previews = folder / "previews"
    hdris = [capture / "ground_truth" / "relight" / f"{name}.exr" for name in HDRIS]
    blend = folder / f"{SCENE}.blend"
    _child(
        root, "relighting", "refgs_addon.preview", folder,
        *(word for hdri in hdris for word in ("--hdri", hdri)), "--views", *VIEWS, "--out", previews, "--blend", blend,
    )  # fmt: skip
    _compare(folder, capture / "ground_truth" / "relight", previews)
    _record(folder, time.perf_counter() - started)
    write_report([folder], folder / "report.html")
    stage("done")
    names = ("splats.ply", "environment.exr", "mesh.glb", blend.name, "previews", "report.html")
    for name in names:
        commands.console.print(f"  {os.path.relpath(folder / name)}")


def _check_blender(root: Path) -> None:
    """Raise InputError if Blender's Python module cannot be loaded."""
    check = "from refgs_addon.preview import check_libraries; check_libraries()"
    done = subprocess.run(
        [sys.executable, "-c", check], cwd=root, env=clone_environment(), capture_output=True, text=True
    )
    if done.returncode:
        raise InputError(done.stderr.strip().splitlines()[-1].partition(": ")[2])


def _child(root: Path, what: str, module: str, *arguments: object) -> None:
    """Run a Python module in a child process, with a progress bar. Raises InputError."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        with (
            subprocess.Popen(
                command, cwd=root, env=clone_environment(), stdout=subprocess.PIPE, stderr=errors, text=True
            ) as process,
            commands.progress_bar(what, 1) as bar,
        ):
            for line in process.stdout or ():
                if line.startswith("{"):
                    event = json.loads(line)
                    if event["event"] == "progress":
                        bar(event["done"], event["what"], event["total"])
        if process.returncode:
            errors.seek(0)
            said = errors.read().strip().splitlines() or ["it said nothing"]
            if process.returncode == 2:
                raise InputError(said[-1])
            raise RuntimeError(f"{module} ended with status {process.returncode}:\n" + "\n".join(said[-30:]))


def _compare(folder: Path, truth: Path, previews: Path) -> None:
    """Compare previews with Cycles' images, add the metrics, and copy the previews for the report."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    pictures = folder / "pictures" / "relight"
    for hdri in HDRIS:
        for kind in ("splats", "mesh"):
            files = []
            for view in VIEWS:
                preview = previews / f"{hdri}_{kind}_{view}"
                files.append((preview.with_suffix(".exr"), truth / hdri / f"{view}.exr"))
                (pictures / kind).mkdir(parents=True, exist_ok=True)
                shutil.copyfile(preview.with_suffix(".png"), pictures / kind / f"{hdri}_{view}.png")
            pairs = [(read_relit(image), read_relit(true)) for image, true in files]
            result.setdefault(hdri, {})[kind] = metrics.relit(lambda pairs=pairs: pairs)
    update_metrics(folder, {"relight": result})


def _record(folder: Path, seconds: float) -> None:
    """Write the demo's run time and peak memory to metrics.json."""
    facts, known = {"seconds": seconds}, (train_job.peak_memory(children) for children in (False, True))
    if largest := [most for most in known if most is not None]:
        facts["peak_memory_bytes"] = max(largest)
    update_metrics(folder, facts)
