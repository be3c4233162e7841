import itertools
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from benchmarks.scenes.analytic import F0, ONE, sky
from refgs import cli
from refgs.capture import read_capture
from refgs.errors import InputError
from refgs.formats.panorama import directions
from refgs.model import harmonics
from refgs.model.surfels import to_splats
from refgs.run import open_run
from refgs.train.keep.asset import write_asset
from refgs.train.keep.measures import held_out_psnr
from tests.makers import scenes
from tests.makers.captures import edit
from tests.makers.training import SMALL, asset_error, check_equal, copied, put, trained, trainer


@pytest.fixture(scope="module")
def ball(sharp_ball, tmp_path_factory):
    """Train on the metal ball for 700 iterations, and write the trained model."""
    folder = tmp_path_factory.mktemp("runs") / "ball"
    return trained(sharp_ball, folder, "train.checkpoint_every=200", "surfels.metallic=0.9", total=700)


def test_the_ball_is_recovered(ball):
    """Check that held-out views, normals, depth, metallic and light are close to the ground truth of the ball."""
    assert held_out_psnr(ball.state) > 30
    for view in ball.state.test:
        seen = ball.state.render(view.camera)
        _, hit, point, normal = scenes.meetings(view.camera, ONE)
        shown = torch.from_numpy(hit).view(seen.alpha.shape) & (seen.alpha > 0.5)
        hit = shown.flatten().numpy()
        cosine = torch.cosine_similarity(seen.normal[shown], torch.from_numpy(normal[hit]), dim=-1)
        assert math.degrees(float(torch.acos(cosine.clamp(-1, 1)).mean())) < 5.5
        depth = (point[hit] - view.camera.position) @ view.camera.world_to_camera[2, :3]
        assert np.abs(seen.depth[shown].numpy() - depth).mean() < 0.1
        assert float(seen.metallic[shown].mean()) > 0.8
        albedo = seen.albedo[shown].mean(dim=0).numpy()
    # Albedo and light share a scale, so compare their product and the shape of the light.
    panorama = ball.state.environment().panorama(32)
    truth = sky(directions(32, 64))
    product = panorama.mean(axis=(0, 1)) * albedo / (truth.mean(axis=(0, 1)) * F0)
    np.testing.assert_allclose(product, 1, atol=0.12)
    assert np.corrcoef(panorama.ravel() * np.tile(albedo, 32 * 64), (truth * F0).ravel())[0, 1] > 0.97


def test_the_asset_renders_as_the_training_did(ball):
    assert asset_error(ball) < 2e-3


def test_the_asset_keeps_surfels_as_they_were_learned(ball_capture, tmp_path):
    """Check that the written normals point outward, although the surfels' rotations are written as they were learned.

    The test first flips every other surfel. If writing turned surfels over to fit their normals, the model would render differently.
    """
    made = trainer(ball_capture, tmp_path / "run", total=10)
    made.run()
    with torch.no_grad():
        w, x, y, z = made.state.learned["rotation"][::2].unbind(-1)
        made.state.learned["rotation"][::2] = torch.stack([-x, w, z, -y], dim=-1)  # flip every other surfel
    write_asset(made.state)
    run, camera = open_run(made.state.folder), made.state.test[0].camera
    learned = made.state.render(camera).normal
    assert float((learned - run.render(camera).normal).abs().max()) < 1e-4
    assert ((run.splats.normals * run.splats.positions).sum(axis=1) > 0).mean() > 0.9
    inward = (run.surfels().normals() * torch.from_numpy(run.splats.normals)).sum(dim=-1) < 0
    assert 0.3 < inward.float().mean() < 0.7
    object.__setattr__(run, "splats", to_splats(run.surfels().turned(inward)))
    # Turning the surfels would change the picture.
    assert float((learned - run.render(camera).normal).abs().max()) > 0.01


def test_what_a_ball_does_without(ball):
    rows = json.loads((ball.state.folder / "needs.json").read_text())
    left_out = {row["what"] for row in rows if not row.get("needed")}
    assert {"inter-reflection", "exposures"} <= left_out
    assert [row["what"] for row in rows if row.get("needed")][:1] == ["specular shading"]
    assert ball.state.occluder is None and not (ball.state.folder / "occluder.ply").exists()
    assert open_run(ball.state.folder).splats.indirect.shape[1] == 0


def test_the_assets_normals_point_outward(ball):
    splats = open_run(ball.state.folder).splats
    solid = splats.opacities > 0.5
    assert ((splats.normals * splats.positions).sum(axis=1)[solid] > 0).mean() > 0.99


def test_history_grows_with_time(ball):
    rows = [json.loads(line) for line in (ball.state.folder / "history.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows][-8:] == [159, 200, 252, 317, 399, 502, 631, 700]
    assert all(a["seconds"] < b["seconds"] for a, b in itertools.pairwise(rows))
    assert rows[-1]["psnr_test"] > rows[0]["psnr_test"]


INDIRECT = ["indirect.start=0.2", "indirect.every=15", "needs.reflections=on", "indirect.resolution=32"]


TURNING = ["light.frame=camera", "light.exposure=on"]
STAGES = ["initial.until=0.5", "needs.initial=on", "densify.reset_every=15"]
STAGES += ["propagation.every=10", "propagation.rest=8"]


REGION = ["region.centre=[0.0, 0.0, 0.4]", "region.size=[2.5, 2.5, 1.2]", "region.up=[0.0, 1.0, 1.0]"]


@pytest.mark.parametrize("changes", [[], ["shading=sh"], ["diffuse=sh"], INDIRECT, TURNING, STAGES, REGION])
def test_a_resumed_run_is_the_same_run(ball_capture, tmp_path, changes):
    """Check that a resumed run ends with the same parameters as an uninterrupted run, bit for bit.

    Densification adds surfels during both.
    """
    changes = [*changes, "train.checkpoint_every=20", "densify.every=12"]
    whole = trainer(ball_capture, tmp_path / "whole", *changes, total=40)
    first = copied(whole, tmp_path / "cut")
    whole.run()
    first.run(stop=lambda: first.state.iteration >= 24)
    (tmp_path / "cut" / "checkpoints" / "00000024.toml").unlink()  # killed before this checkpoint was complete
    second = trainer(ball_capture, tmp_path / "cut", *changes, total=40)
    second.resume()
    assert second.state.iteration == 20
    second.run()
    check_equal(whole, second)
    # With STAGES, all surfels are faint when exposures would be decided, so exposures stay.
    assert ("exposure" in second.state.learned) == (changes[0] in (TURNING[0], STAGES[0]))
    if "exposure" in second.state.learned:
        exposures = whole.state.learned["exposure"]
        assert torch.equal(exposures, second.state.learned["exposure"]) and exposures.any()
    assert (second.state.occluder is not None) == (changes[0] == INDIRECT[0])


def test_shading_sh_learns_colour_alone(ball_capture, tmp_path):
    made = trainer(ball_capture, tmp_path / "sh", "shading=sh", total=150)
    before = held_out_psnr(made.state)
    made.run()
    assert held_out_psnr(made.state) > before + 2 and made.state.surfels().sh_rest.any()
    write_asset(made.state)
    assert not (tmp_path / "sh" / "environment.exr").exists()
    assert asset_error(made) < 1e-3


def test_sh_diffuse_leaves_an_albedo_that_relights(ball_capture, tmp_path):
    """Check the albedo that is written after a training with diffuse=sh: there, spherical harmonics give the diffuse colour.

    A dielectric's albedo is its diffuse colour divided by irradiance / π. A metal's albedo is its reflectance.
    """
    made = trainer(ball_capture, tmp_path / "run", "diffuse=sh", "surfels.metallic=0.1", total=100)
    made.run()
    reflectance = torch.tensor([0.9, 0.6, 0.3])
    sent = 0.2 * (0.5 + harmonics.DC * made.state.learned["sh_dc"])  # darken, or most albedos would exceed 1
    put(made, metallic=20, albedo=reflectance.logit(), sh_dc=(sent - 0.5) / harmonics.DC)
    with torch.no_grad():
        made.state.learned["metallic"][::2] = -20
    write_asset(made.state)
    run = open_run(tmp_path / "run")
    received = run.environment.diffuse(run.surfels().normals())
    sent = 0.5 + harmonics.DC * run.splats.sh[:, 0]
    dull = run.splats.metallic < 0.5
    assert 0.4 < dull.mean() < 0.6
    assert run.splats.albedo[dull].std() > 0.05 and run.splats.albedo[dull].max() < 1
    np.testing.assert_allclose(run.splats.albedo[dull], np.clip(sent / received.numpy(), 0, 1)[dull], atol=0.005)
    np.testing.assert_allclose(run.splats.albedo[~dull], np.broadcast_to(reflectance, (sum(~dull), 3)), atol=1e-5)


def refgs(*words, **options):
    return subprocess.run(
        [sys.executable, "-m", "refgs.cli", *map(str, words)], capture_output=True, text=True, timeout=300, **options
    )


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_ctrl_c_leaves_a_run_that_goes_on(ball_capture, tmp_path):
    out = tmp_path / "run"
    command = [sys.executable, "-m", "refgs.cli", "train", str(ball_capture), "--out", str(out), "--preset", "quick"]
    for change in (*SMALL, "train.iterations=100000", "train.checkpoint_every=20"):
        command += ["--set", change]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 240
    while not list(out.glob("checkpoints/*.toml")):
        assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "--resume" in said
    assert "Traceback" not in errors
    assert not (out / "splats.ply").exists()

    taken = refgs("train", ball_capture, "--out", out, "--preset", "quick")
    assert taken.returncode == 2
    assert "holds another run" in taken.stderr
    cli.app(["train", str(ball_capture), "--out", str(out), "--resume", "--minutes", "0.05"], standalone_mode=False)
    assert (out / "splats.ply").exists()
    figures = json.loads((out / "metrics.json").read_text())
    assert figures["training_seconds"] > 0 and figures["peak_memory_bytes"] > 1e8


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--device", "gpu"], "auto, cpu or cuda"),
        (["--set", "train.iterations=0"], "train.iterations"),
        (["--preset", "fast"], "no preset fast"),
        (["--resume"], "not a run folder"),
    ],
)
def test_bad_words_give_one_line_and_leave_nothing(ball_capture, tmp_path, words, said):
    done = refgs("train", ball_capture, "--out", tmp_path / "run", *words)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert said in done.stderr
    assert not (tmp_path / "run").exists()


def test_resume_refuses_another_capture(ball_capture, tmp_path):
    trainer(ball_capture, tmp_path / "run", total=20).run()
    other = tmp_path / "other"
    shutil.copytree(ball_capture, other)
    edit(other / "transforms_train.json", lambda data: data.update(camera_angle_x=0.71))
    done = refgs("train", other, "--out", tmp_path / "run", "--resume")
    assert done.returncode == 2
    assert "not the capture" in done.stderr


def test_a_missing_hull_is_an_error_in_words(ball_capture, tmp_path):
    capture = read_capture(ball_capture)
    object.__setattr__(capture, "centre", np.array([100.0, 0, 0]))
    with pytest.raises(InputError, match="check that masks and poses belong together"):
        trainer(capture, tmp_path / "run")
    assert not (tmp_path / "run").exists()
