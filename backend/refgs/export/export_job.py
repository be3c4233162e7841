"""Export a run's textured mesh or its splats.

Importing torch takes seconds. So all checks that do not need torch come first.
"""

import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from refgs.errors import InputError, InputWarning
from refgs.events import Report
from refgs.lock import RunLock
from refgs.memory import shortage_named
from refgs.paths import disk_errors_named, make_folders
from refgs.run_folder import check_finished

DISPLAY = (".ply", ".glb", ".spz", ".usdc")  # of display splats
THEIRS = (".ply", ".spz")  # of splats by other programs
LESS = "close other programs, or export less: a smaller --texture, or train with a smaller mesh.resolution"
# Per cent of a mesh's time after which each step is done, as measured on a can with 70 photos.
FUSED, SIMPLIFIED, FITTED, BAKING, WRITING = 19, 22, 39, 54, 91

if TYPE_CHECKING:
    from collections.abc import Callable

    from refgs.formats.mesh import Mesh, UnwrappedMesh
    from refgs.formats.splats import Splats
    from refgs.run import Run


def export(
    folder: Path,
    mesh_file: Path | None,
    texture: int | None,
    splats_file: Path | None,
    display_file: Path | None,
    overwrite: bool,
    report: Report,
) -> list[Path]:
    """Export the textured mesh of a run, its splats, or both. Returns the files written.

    - folder: a run folder (the result of a training), or a file of splats, .ply or .spz, which has no mesh to export
    - mesh_file: a .glb or .obj file. If all three files are None, the mesh is written to mesh.glb in the run folder.
    - texture: the side of the textures in texels; None means the side in the run's settings
    - splats_file: a .ply file for the splats with their materials
    - display_file: a .ply, .glb, .spz or .usdc file for splats that viewers without lighting show
    - overwrite: replace files that exist. If it is false and a file exists, InputError is raised.
    - report: a function that is called with each step, the progress and warnings
    """
    splats = [file for file in (splats_file, display_file) if file is not None]
    is_run = folder.is_dir() or folder.suffix.lower() not in THEIRS
    if not is_run and (mesh_file or not splats):
        raise InputError(
            f"{folder} is no run folder, so there is no mesh: add --splats FILE.ply or --display-splats FILE.ply"
        )
    if is_run:
        check_finished(folder)
    target = mesh_file if mesh_file or splats else folder / "mesh.glb"
    _check_names(target, splats_file, display_file)
    _check_absent([*splats, *_mesh_files(target)], overwrite)
    run, source = _read_source(folder, is_run, report)
    folders = [file.parent for file in [*splats, target] if file]
    make_folders(folders)
    with shortage_named(LESS), disk_errors_named(folders, "export again"):
        _write_splats(run, source, splats_file, display_file, report)
        if run is None or target is None:
            return splats
        with RunLock(folder) if target.parent == folder else nullcontext():
            _write_mesh(run, target, texture, report)
    return [*splats, target]


def _check_names(target: Path | None, ours: Path | None, display: Path | None) -> None:
    if target is not None and target.suffix.lower() not in (".glb", ".obj"):
        raise InputError(f"{target}: a mesh is written as .glb or .obj; give it a name that ends so")
    if ours is not None and ours.suffix.lower() != ".ply":
        raise InputError(f"{ours}: splats with materials are written as .ply; give it a name that ends so")
    if display is not None and display.suffix.lower() not in DISPLAY:
        raise InputError(
            f"{display}: display splats are written as .ply, .glb, .spz or .usdc; give it a name that ends so"
        )
    if display is not None and display in (target, ours):
        raise InputError(f"{display} is named twice: give each export a file of its own")


def _mesh_files(target: Path | None) -> list[Path]:
    """List the paths written for the mesh file `target`: mesh, textures and MTL."""
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
    """Read a run (None for a file of splats) and its splats, sending warnings to `report`."""
    from refgs.export.turned import turned
    from refgs.formats.mesh import Y_UP
    from refgs.formats.splats import read_splats
    from refgs.formats.spz import read_spz
    from refgs.run import open_run

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        run = open_run(folder) if is_run else None
        if run is not None:
            splats = run.splats
        elif folder.suffix.lower() == ".spz":
            splats = turned(read_spz(folder), Y_UP.T)
        else:
            splats = read_splats(folder)
    for warning in caught:
        report("warning", {"what": str(warning.message)})
    return run, splats


def _write_splats(run: "Run | None", source: "Splats", ours: Path | None, display: Path | None, report: Report) -> None:
    from refgs.export.display import displayed
    from refgs.export.turned import turned
    from refgs.formats.mesh import Y_UP
    from refgs.formats.splats import write_display_splats, write_splats
    from refgs.formats.splats_gltf import write_splats_glb
    from refgs.formats.splats_usd import write_splats_usd
    from refgs.formats.spz import write_spz

    def learned(done: int, total: int) -> None:
        if done % 10 == 0:
            report("progress", {"stage": "colours", "done": done, "total": total})

    if ours is not None:
        write_splats(ours, source)
    if display is None:
        return
    if run is not None:  # others' splats have their colours by direction
        report("stage", {"what": "learning colours by direction"})
        source = displayed(run, learned)
    match display.suffix.lower():
        case ".glb":
            write_splats_glb(display, turned(source, Y_UP))
        case ".spz":
            write_spz(display, turned(source, Y_UP))
        case ".usdc":
            write_splats_usd(display, source)
        case _:
            write_display_splats(display, source)


def _write_mesh(run: "Run", target: Path, texture: int | None, report: Report) -> None:
    """Make the run's mesh, bake its textures, and write both."""
    from refgs.export.bake import bake
    from refgs.formats.gltf import write_glb
    from refgs.formats.obj import write_obj

    def progress(percent: float) -> None:
        report("progress", {"stage": "mesh", "done": round(percent), "total": 100})

    mesh = _make_mesh(run, report, progress)

    def baked(done: int, total: int) -> None:
        progress(BAKING + (WRITING - BAKING) * done / total)

    textures = bake(mesh, _baked_splats(run, mesh), texture or run.settings.mesh.texture, baked)
    progress(WRITING)
    report("stage", {"what": "writing"})
    write = write_obj if target.suffix.lower() == ".obj" else write_glb
    write(target, mesh, textures)


def _make_mesh(run: "Run", report: Report, progress: "Callable[[float], None]") -> "UnwrappedMesh":
    """Make the run's mesh with uv, fused, simplified and fitted to its outlines. `progress` is called with the per cent that are done."""
    from refgs.export.outline import fit_to_outlines
    from refgs.export.unwrap import layout, unwrap
    from refgs.geometry.mesh import clean, is_crumbs
    from refgs.render.extract import extract

    settings, cameras = run.settings.mesh, run.training_cameras()
    progress(0)
    mesh, voxel = extract(run.surfels(), cameras, run.near, run.centre, run.radius, settings.resolution)
    progress(FUSED)
    report("stage", {"what": f"fused {len(mesh.faces):,} triangles"})
    mesh = clean(mesh, settings.triangles)
    progress(SIMPLIFIED)
    report("stage", {"what": f"simplified to {len(mesh.faces):,} triangles; fitting it to the outlines"})
    mesh = fit_to_outlines(mesh, run.render, cameras, voxel)
    progress(FITTED)
    report("stage", {"what": "unwrapping"})
    if is_crumbs(mesh):
        message = "the mesh is in pieces, none of them half of it: the photos do not agree on a surface"
        report("warning", {"what": f"{message}; give them masks of the object, or take more of them"})
    mesh = unwrap(mesh)
    charts = layout(mesh)
    density = " to ".join(f"{value:.2f}" for value in charts.density)
    progress(BAKING)
    message = f"{charts.used:.0%} of the texture used, density {density}, angles bent by {charts.bend:.1f}°; baking"
    report("stage", {"what": message})
    return mesh


def _baked_splats(run: "Run", mesh: "Mesh") -> "Splats":
    """Return the run's splats for baking, without shadows in their base colours."""
    # They have shadows if the training computed none and the light did not move relative to the object.
    from refgs.export.unshadowed import unshadowed
    from refgs.render.baselines import method_of

    light = run.environment
    if light is None or light.reference is not None or run.occluder is not None:
        return run.splats
    if method_of(run.settings.render).light.display:
        return run.splats
    return unshadowed(run.splats, run.surfels(), mesh, light)
