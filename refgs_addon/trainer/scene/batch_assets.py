"""Turn the finished runs of a batch into an asset library. A batch trains all captures of a folder (`scene.many`)."""

from pathlib import Path

from ... import jobs
from ...errors import InputError
from ...scene.asset_library import LIBRARY, add_library, asset_file, library_name
from .batch_table import Row, read_rows


def missing_assets(folder: Path) -> list[Row]:
    """List the finished runs in a batch's folder that have no asset yet."""
    return [row for row in read_rows(folder) if row.state == "done" and not asset_file(folder, row.name).exists()]


def import_as_assets(folder: Path) -> jobs.Job:
    """Start a job that makes each finished run of a batch an asset, and then lists the library in Blender's preferences.

    `folder` is the folder of the batch's runs. Runs that are in the library already are left out. The job runs in another Blender process,
    so the open file does not change. Raises InputError if there is no run to import, or if such a job for this batch is running already.
    """
    from ...scene.render_process import start_blender

    rows = missing_assets(folder)
    if not rows:
        known = (folder / LIBRARY).is_dir()
        what = "all finished runs are in the library" if known else "no run has finished"
        raise InputError(f"{folder.name}: {what}: train more captures first")
    if any(job.kind == "library" and job.commands[0]["folder"] == str(folder) and not job.ended for job in jobs.JOBS):
        raise InputError(f"the assets of {folder.name} are being made already: wait for them")
    jobs.JOBS[:] = [job for job in jobs.JOBS if not (job.ended and job.kind == "library")]
    runs = [{"name": row.name, "picture": row.picture} for row in rows]
    command = {"command": "library", "folder": str(folder), "runs": runs}
    job = start_blender(library_name(folder), f"library {folder.name}", command)
    job.then = lambda job: add_library(folder)
    return job
