"""Test the export of splats for viewers without lights. They look like the run, and have the properties that such viewers read."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData
from pxr import Usd

from refgs.capture import read_capture
from refgs.compare.metrics import psnr
from refgs.errors import InputError
from refgs.export.display import displayed
from refgs.export.export_job import export
from refgs.formats.splats import THIN, read_splats, write_display_splats, write_splats
from refgs.formats.splats_usd import PLACE
from refgs.formats.spz import read_spz
from refgs.model.surfels import from_splats
from refgs.render.renderer import render
from refgs.run import open_run
from tests.makers.ball import write_run
from tests.makers.box import glb_chunks
from tests.makers.splats import chosen, make


@pytest.fixture(scope="module")
def run(ball_capture, tmp_path_factory):
    """Open the run of a metal ball under a sky; its upper half is rough, its lower half smooth."""
    return open_run(write_run(tmp_path_factory.mktemp("display") / "run", read_capture(ball_capture)))


def quality(run, splats, cameras):
    """Render splats with their stored colours, without lights. Return the mean PSNR (dB) against the run's own rendering."""
    settings = run.settings.render.model_copy(update={"shading": "sh"})
    background = torch.tensor(run.settings.image.background)
    values = []
    for camera in cameras:
        shown = render(from_splats(splats), None, camera, background, settings, run.near).color
        values.append(psnr(shown.clamp(0, 1).numpy(), run.render(camera).color.clamp(0, 1).numpy()))
    return np.mean(values)


def test_they_show_what_the_run_shows_from_new_views_too(run):
    said = []
    splats = displayed(run, lambda done, total: said.append((done, total)))
    assert said[-1][0] == said[-1][1] == len(said)
    unseen = [camera for camera, split in zip(run.cameras, run.splits, strict=True) if split == "test"]
    flat = replace(splats, sh=splats.sh[:, :1])
    assert splats.sh.shape == (3000, 16, 3)
    assert quality(run, splats, unseen) > quality(run, flat, unseen) + 3
    assert quality(run, splats, unseen) > 27
    np.testing.assert_array_equal(splats.positions, run.splats.positions)


def test_the_file_is_what_viewers_of_gaussians_read(run, tmp_path):
    write_display_splats(tmp_path / "a.ply", run.splats)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert [p.name for p in vertex.properties] == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    scales = np.exp(np.stack([vertex[f"scale_{i}"] for i in range(3)], axis=1))
    np.testing.assert_allclose(scales[:, 2], THIN * scales[:, :2].min(axis=1), rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"])), run.splats.opacities, rtol=1e-4)


@pytest.mark.parametrize("count", [0, 1])
def test_few_splats_are_written_too(tmp_path, count):
    write_display_splats(tmp_path / "un été.ply", make(count))
    splats = read_splats(tmp_path / "un été.ply")
    assert len(splats) == count and splats.scales.shape == (count, 3)
    np.testing.assert_allclose(splats.scales[:, 2], THIN * splats.scales[:, :2].min(axis=1), rtol=1e-5)


def test_splats_alone_are_exported_unless_the_mesh_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setattr("refgs.export.display.ITERATIONS", 10)
    before, said = sorted(run.folder.iterdir()), []
    wanted = [tmp_path / "a.ply", tmp_path / "b.ply"]
    files = export(run.folder, None, None, *wanted, False, lambda *event: said.append(event))
    assert said[-1] == ("progress", {"stage": "colours", "done": 10, "total": 10})
    assert files == wanted and all(file.exists() for file in files)
    assert sorted(run.folder.iterdir()) == before
    assert len(PlyData.read(str(tmp_path / "b.ply"))["vertex"].properties) == 17 + 45
    with pytest.raises(InputError, match=r"b\.ply exists: add --overwrite"):
        export(run.folder, None, None, None, tmp_path / "b.ply", False, lambda event, facts: None)


@pytest.mark.parametrize(
    ("mesh", "ours", "display", "said"),
    [
        (None, "a.glb", None, "a.glb: splats with materials are written as .ply"),
        (None, None, "a.splat", "a.splat: display splats are written as .ply, .glb, .spz or .usdc"),
        (None, "a.ply", "a.ply", "a.ply is named twice"),
        ("a.glb", None, "a.glb", "a.glb is named twice"),
    ],
)
def test_wrong_names_are_refused_before_work(run, tmp_path, mesh, ours, display, said):
    files = [name and tmp_path / name for name in (mesh, ours, display)]
    with pytest.raises(InputError, match=said):
        export(run.folder, files[0], 64, *files[1:], False, lambda event, facts: None)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("count", [0, 1])
def test_a_run_of_few_splats_leaves_in_every_format(run, tmp_path, monkeypatch, count):
    """Check that a run of no splats, or of one, can be exported as splats.

    Exporting its mesh gives an error, because it has none.
    """
    monkeypatch.setattr("refgs.export.display.ITERATIONS", 3)
    folder = tmp_path / "des éclats, été"
    shutil.copytree(run.folder, folder, ignore=shutil.ignore_patterns("mesh.glb"))
    splats = chosen(run.splats, slice(count))
    splats.positions[:], splats.scales[:] = 0, 0.3
    write_splats(folder / "splats.ply", splats)

    def leave(mesh=None, ours=None, display=None):
        return export(folder, mesh, 64, ours, display, False, lambda event, facts: None)

    for file in leave(None, folder / "les nôtres.ply", folder / "à voir.ply"):
        assert len(read_splats(file)) == count
    (file,) = leave(display=folder / "à voir.usdc")
    stage = Usd.Stage.Open(str(file))
    assert len(stage.GetAttributeAtPath(f"{PLACE}.positions").Get()) == count
    (file,) = leave(display=folder / "à voir.spz")
    assert len(read_spz(file)) == count
    if count:
        (file,) = leave(display=folder / "à voir.GLB")
        gltf, _ = glb_chunks(file)
        assert gltf["accessors"][0]["count"] == count
    else:  # glTF has no arrays of length zero
        with pytest.raises(InputError, match="there are no splats to write"):
            leave(display=folder / "à voir.glb")
    for file in (folder / "mesh.glb", tmp_path / "à part" / "la forme.obj"):
        with pytest.raises(InputError, match="there is no mesh"):
            leave(file)
        assert not file.exists()
