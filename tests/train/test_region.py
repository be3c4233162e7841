"""Test training on a box (region) of a capture. The result holds only the ball inside the box, and `region.up` points upwards."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.scenes.analytic import TWO, camera_matrix, photo, write_ball_capture
from refgs import commands, train_job
from refgs.asked import Asked
from refgs.capture import read_capture
from refgs.capture.first_points import AROUND
from refgs.errors import InputError
from refgs.formats.gltf import read_glb
from refgs.formats.splats import read_splats
from refgs.run import open_run
from refgs.train.keep.live_view import write_preview
from refgs.train.start import start_parameters
from tests.makers.training import SMALL, trainer

CHANGES = [*SMALL, "surfels.hull=48", "train.iterations=150", "mesh.resolution=48", "image.masks=off"]
RIGHT = ["region.centre=[0.62, 0.0, 0.0]", "region.size=[1.2, 1.2, 1.2]"]


@pytest.fixture(scope="module", params=["masks", "no masks"])
def balls(request, tmp_path_factory):
    """Write a capture of two mirror balls, with masks or on a grey background. The balls occlude each other in some photos."""
    folder = tmp_path_factory.mktemp("balls")
    write_ball_capture(folder, 48, TWO, samples=2)
    if request.param == "no masks":
        for file in folder.rglob("*.png"):
            pixels = np.asarray(Image.open(file)).astype(float)
            alpha = pixels[..., 3:] / 255
            Image.fromarray(np.rint(pixels[..., :3] * alpha + 128 * (1 - alpha)).astype(np.uint8)).save(file)
    return folder


def train(capture, out, *changes):
    asked = Asked(capture, out, "quick", "cpu", changes=(*CHANGES, *changes))
    return train_job.train(asked, lambda *_: None, lambda state: False)


@pytest.fixture(scope="module")
def right(balls, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "right"
    return (*train(balls, folder, *RIGHT), folder)


def test_only_what_is_in_the_box_comes_out(right, balls):
    trainer, quality, folder = right
    run = open_run(folder)
    box = read_capture(balls, trainer.settings.region).box
    assert box.contains(run.splats.positions).all()
    beside = int((~trainer.wanted()).sum())
    assert 0 < beside <= AROUND * trainer.settings.surfels.budget, "something has to show the other ball"
    said = {entry["why"]: entry["what"] for entry in json.loads((folder / "needs.json").read_text())}
    assert said["they show what is outside the region"] == f"{beside} surfels"
    assert quality > (20 if trainer.from_hull else 15)
    # The silhouette must be that of the whole ball, even where the other ball occludes it.
    shares = []
    for view in trainer.test:
        direction = view.camera.position @ trainer.capture.to_capture[:3, :3].T
        true = photo(camera_matrix(direction), 48, TWO[1:])[..., 3] > 0.5
        alpha = run.render(view.camera).alpha.numpy() > 0.5
        shares.append((alpha & true).sum() / (alpha | true).sum())
    assert np.mean(shares) > (0.85 if trainer.from_hull else 0.6)


def test_mesh_figures_and_preview_are_of_the_box(right, balls):
    trainer, _, folder = right
    preview = write_preview(trainer)
    assert trainer.capture.box.contains(read_splats(preview["splats"]).positions).all()
    commands.evaluate(folder, "test", None)
    assert json.loads((folder / "metrics.json").read_text())["psnr"] > 20
    if trainer.from_hull:
        commands.export(folder, None, 64, None, None, False)
        mesh = read_glb(folder / "mesh.glb")
        assert np.linalg.norm(mesh.vertices - TWO[1, :3], axis=1).max() < 0.7


def test_surfels_start_in_the_box_and_around_it(balls, tmp_path):
    state = trainer(balls, tmp_path / "run", *CHANGES, *RIGHT).state
    inside = state.wanted()
    assert 0.5 <= inside.float().mean() < 1 and len(inside) <= 1500
    if state.from_hull:
        start = start_parameters(state.capture, state.views, state.settings)
        parameters, shown = start.parameters, start.on_hull
        faint = parameters["opacity"].sigmoid() < 0.2
        assert faint[shown:].all() and not faint[:shown].any() and 0.3 < shown / len(faint) < 0.7


def test_a_box_with_nothing_in_it_is_said_in_a_line(balls, tmp_path):
    if not read_capture(balls).masked:
        pytest.skip("without masks there may be something anywhere")
    with pytest.raises(InputError, match=r"lies in the region: move its box, or enlarge it$") as error:
        train(balls, tmp_path / "run", "region.centre=[0.0, 0.0, 1.0]", "region.size=[0.3, 0.3, 0.3]")
    assert "\n" not in str(error.value) and not (tmp_path / "run").exists()


def test_up_turns_the_result_and_nothing_else(ball_capture, tmp_path):
    """Check that the setting `region.up` rotates the result, its cameras and its environment together.

    The rendered pictures stay the same.
    """
    up = np.array([0.6, 0.0, 0.8])
    folders = [tmp_path / "plain", tmp_path / "turned"]
    for folder, words in zip(folders, ([], [f"region.up={up.tolist()}"]), strict=True):
        train(ball_capture, folder, "train.iterations=200", "surfels.metallic=0.9", *words)
    plain, turned = map(open_run, folders)
    np.testing.assert_allclose(turned.to_capture[:3, :3] @ (0, 0, 1), up, atol=1e-12)
    assert np.array_equal(plain.to_capture, np.eye(4))
    turn = turned.to_capture[:3, :3]
    back = torch.from_numpy(turn.T).float()
    for one, other in zip(plain.cameras[::9], turned.cameras[::9], strict=True):
        np.testing.assert_allclose(turn @ other.position, one.position, atol=1e-9)
        seen, again = plain.render(one.fitted(64)), turned.render(other.fitted(64))
        assert float((seen.color - again.color).abs().mean()) < 0.01
        assert float((seen.alpha - again.alpha).abs().mean()) < 0.01
        solid = (seen.alpha > 0.9) & (again.alpha > 0.9)
        cosine = torch.cosine_similarity(seen.normal[solid], again.normal[solid] @ back, dim=-1)
        assert float(cosine.mean()) > 0.99
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    there = plain.environment.diffuse(directions @ back)
    here = turned.environment.diffuse(directions)
    assert float((there - here).abs().mean() / there.mean()) < 0.06
    commands.evaluate(folders[1], "test", None)
    assert json.loads((folders[1] / "metrics.json").read_text())["psnr"] > 25
