"""Draw docs/pictures/ordinary.jpg: `python -m scripts.ordinary_splats RUN --hdri sunset`.

On the left, a run's splats under another light. On the right, what relighting makes of the same splats as ordinary ones: without
materials, in their learned colours, with normals by PCA of their neighbours' positions. It is exposed to the same mean brightness.
"""

import argparse
import tempfile
from pathlib import Path

import bpy
import numpy as np
from numpy.lib.recfunctions import repack_fields
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree

from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.render_eevee import render_preview
from refgs_addon.scene.run_parts import show
from refgs_addon.scene.splat_cloud import linear_to_srgb, srgb_to_linear
from refgs_addon.scene.world_light import hdris, relight

NEIGHBOURS = 16
GREY = 0.045  # of the background, linear
ORDINARY = [
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
]
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "ordinary.jpg"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--hdri", default="sunset", help="light, one of Blender's")
    parser.add_argument("--view", help="camera; default: the first")
    parser.add_argument("--size", type=int, default=400, help="longer side of each picture in pixels")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "ordinary.ply"
        write_ordinary(options.run / "splats.ply", plain)
        shown = [draw(options, source, Path(folder) / "shown.png") for source in (options.run, plain)]
    target = shown[0][:, :, :3].mean()
    shown = [light[:, :, :3] * (target / light[:, :, :3].mean()) + GREY * (1 - light[:, :, 3:]) for light in shown]
    Image.fromarray((255 * linear_to_srgb(np.concatenate(shown, axis=1))).round().astype(np.uint8)).save(
        PICTURE, quality=90
    )


def write_ordinary(source: Path, target: Path) -> None:
    """Write a run's splats without materials, with the normals that PCA finds."""
    rows = PlyData.read(str(source))["vertex"].data
    places = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    near = places[cKDTree(places).query(places, NEIGHBOURS)[1]]
    near -= near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    table = np.empty(len(rows), [(name, "<f4") for name in [*ORDINARY, "nx", "ny", "nz"]])
    for name in ORDINARY:
        table[name] = repack_fields(rows)[name]
    for axis, name in enumerate(("nx", "ny", "nz")):
        table[name] = normals[:, axis]
    PlyData([PlyElement.describe(table, "vertex")]).write(str(target))


def draw(options: argparse.Namespace, source: Path, png: Path) -> np.ndarray:
    """Render splats under the light, through a camera of the run. Returns linear, premultiplied colours and alpha."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    run = import_run(options.run, scene)
    camera = run.cameras[options.view or next(iter(run.cameras))]
    show(run.collection, "splats")
    if source != options.run:
        run.splats.hide_render = True
        import_run(source, scene)
    relight(scene, next(file for file in hdris() if file.stem == options.hdri))
    render_preview(scene, png, camera, options.size)
    shown = np.asarray(Image.open(png).convert("RGBA"), np.float32) / 255
    return np.dstack([srgb_to_linear(shown[:, :, :3]) * shown[:, :, 3:], shown[:, :, 3:]])


if __name__ == "__main__":
    main()
