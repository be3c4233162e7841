"""Test the evaluation by the protocols of published data sets. The data sets are made from a run, so the right figures are known."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.scenes.analytic import sky
from refgs import commands
from refgs.capture import read_capture
from refgs.capture.poses import split_similarity
from refgs.capture.stanford_orb import novel_views
from refgs.color import srgb_decode, srgb_encode
from refgs.compare.pictures import maps
from refgs.formats.exr import write_exr
from refgs.formats.panorama import directions
from refgs.formats.splats import write_splats
from refgs.model.surfels import activate, initial_parameters, to_splats
from refgs.run import create_run, open_run
from refgs.settings import load_settings
from tests.makers.ball import dusk
from tests.makers.captures import CENTRE, RADIUS, stanford_orb, tensoir, write
from tests.makers.distances import spread

TINT = np.array([0.5, 0.75, 0.9])  # true divided by learned base colour


def ball_run(folder, capture):
    """Write the run folder of a training that has learned the ball of the makers' captures, glossy and grey, under `sky`. Open it."""
    create_run(folder, capture, load_settings("quick", ["environment.resolution=16"]), "quick", "cpu")
    to_run, scale = np.linalg.inv(capture.to_capture), split_similarity(capture.to_capture)[0]
    normals = spread(3000)
    points = ((CENTRE + RADIUS * normals) @ to_run[:3, :3].T + to_run[:3, 3]).astype(np.float32)
    look = {"opacity": 0.95, "sh_degree": 0, "albedo": 0.6, "metallic": 0.001, "roughness": 0.3}
    surfels = activate(initial_parameters(points, normals, np.full(3000, 0.04 * RADIUS / scale), None, **look))
    write_splats(folder / "splats.ply", to_splats(surfels._replace(indirect_dc=surfels.indirect_dc[:, :0])))
    write_exr(folder / "environment.exr", sky(directions(64, 128)))
    return open_run(folder)


def evaluated(run, capture):
    """Evaluate the run, whose capture's pictures have changed since it was created. Return its figures."""
    file = run.folder / "run.toml"
    now = read_capture(capture.folder).fingerprint()
    file.write_text(file.read_text().replace(capture.fingerprint(), now))
    commands.evaluate(run.folder, "test", None)
    return json.loads((run.folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """Make a scene of TensoIR-Synthetic whose true base colour is TINT times what a run of it has learned. Return both."""
    folder = tmp_path_factory.mktemp("tensoir")
    capture = read_capture(tensoir(folder / "synthetic" / "ball"))
    run = ball_run(folder / "run", capture)
    true = replace(run, splats=replace(run.splats, albedo=(run.splats.albedo * TINT).astype(np.float32)), _traced={})
    panorama = dusk(directions(64, 128)).astype(np.float32)
    write(folder / "synthetic" / "Environment_Maps" / "high_res_envmaps_2k" / "bridge.hdr", panorama)
    for view in capture.test_views:
        images, relit = maps(true.render(view.camera)), maps(true.render(view.camera, run.light(panorama)))["color"]
        alpha = images["alpha"][..., None]
        straight = srgb_encode(relit[..., :3] / np.maximum(relit[..., 3:], 1e-6))
        for name, pixels in (
            ("normal", images["normal"] / 2 + 0.5),
            ("albedo", images["albedo"]),
            ("rgba_bridge", straight),
        ):
            stored = np.rint(255 * np.dstack([pixels, alpha]).clip(0, 1)).astype(np.uint8)
            write(view.image_path.with_name(f"{name}.png"), stored)
    return run, capture


def test_tensoir_corrects_base_colour_before_it_relights(synthetic, capsys):
    run, capture = synthetic
    found = evaluated(run, capture)
    assert found["tensoir"]["ratio"] == pytest.approx(TINT, abs=0.01)
    assert found["tensoir"]["relit_psnr"] == found["tensoir"]["relit"]["bridge"]["psnr"] > 40
    assert found["tensoir"]["relit_ssim"] > 0.99 and found["tensoir"]["albedo_psnr"] > 30
    assert found["tensoir"]["normal_mae_degrees"] < found["normal_mae_degrees"] < 1
    assert found["albedo"]["scale"] == pytest.approx(TINT, abs=0.01) and "relight" not in found
    said = capsys.readouterr().out
    assert "relit, as TensoIR measures: PSNR" in said
    for kind in ("refgs", "truth"):
        picture = cv2.imread(str(run.folder / "pictures" / "relight" / kind / "bridge_test_000.png"))
        assert picture.shape == (64, 64, 3) and (picture[0, 0] == 255).all()


def test_tensoir_without_lights_measures_the_rest(synthetic, tmp_path):
    run, capture = synthetic
    maps_folder = capture.folder.parent / "Environment_Maps"
    maps_folder.rename(tmp_path / "kept")
    (run.folder / "metrics.json").unlink(missing_ok=True)
    found = evaluated(run, capture)
    (tmp_path / "kept").rename(maps_folder)
    assert found["tensoir"].keys() == {"ratio", "normal_mae_degrees", "albedo_psnr"}


def seen_light(view, light, height=64):
    """Compute a light's panorama as Stanford-ORB stores it for a photo: the middle is forward, right is right, up is up."""
    turn = 2 * np.pi * ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5)
    rise = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    axes = [
        np.cos(rise) * np.sin(turn),
        np.broadcast_to(-np.sin(rise), (height, 2 * height)),
        np.cos(rise) * np.cos(turn),
    ]
    return light(np.stack(axes, axis=-1) @ view.camera.world_to_camera[:3, :3])


def test_stanford_orb(tmp_path, capsys):
    """Check a run that is the truth, in a turned and scaled frame, under the lights of another scene, which were exposed otherwise.

    Photos of the other scene have a tint, which is forgiven. Photos of this scene have none.
    """
    folder = stanford_orb(tmp_path / "data")
    capture = read_capture(folder)
    run, truth = ball_run(tmp_path / "run", capture), tmp_path / "data" / "ground_truth"
    turn, to_run = split_similarity(capture.to_capture)[1], np.linalg.inv(capture.to_capture)

    def radiance(rendering):
        alpha = rendering.alpha.numpy()[..., None]
        return srgb_decode(np.maximum(rendering.color.numpy() - (1 - alpha), 0))

    for view in capture.test_views:
        rendering, name = run.render(view.camera), view.camera.name
        write_exr(view.image_path, radiance(rendering))
        seen = maps(rendering)["normal"] @ view.camera.world_to_camera[:3, :3].T * [1, -1, -1]
        np.save(truth / folder.name / "surface_normal" / f"{name}.npy", seen)
        np.save(truth / folder.name / "z_depth" / f"{name}.npy", 0.7 * rendering.depth.numpy())
    for scene, view in novel_views(folder):
        camera = replace(view.camera, world_to_camera=view.camera.world_to_camera @ capture.to_capture)
        camera.world_to_camera[:3] /= np.cbrt(np.linalg.det(camera.world_to_camera[:3, :3]))
        light = dusk(directions(64, 128) @ turn.T)  # of the run's directions; `dusk` is of the capture's
        write_exr(truth / scene / "env_map" / f"{view.image_path.stem}.exr", seen_light(view, dusk))
        write_exr(view.image_path, radiance(run.render(camera, run.light(light))) * [0.4, 0.8, 1.2])
    assert not np.allclose(to_run, np.eye(4))
    found = evaluated(run, capture)["stanford_orb"]
    assert found["view"]["psnr_l"] > 60 and found["view"]["ssim"] > 0.999
    assert found["light"]["psnr_h"] > 35 and found["light"]["psnr_l"] > 35
    assert found["normal_cosine_distance"] < 1e-4 and found["depth_si_mse"] < 1e-5
    assert "relit, as Stanford-ORB measures: PSNR-H" in capsys.readouterr().out
    assert (run.folder / "pictures" / "relight" / "truth" / "ball_scene002_0003.png").exists()


def test_stanford_orb_without_exr_has_no_psnr_of_radiance(tmp_path):
    capture = read_capture(stanford_orb(tmp_path / "data", ".png"))
    found = evaluated(ball_run(tmp_path / "run", capture), capture)["stanford_orb"]
    for kind in ("view", "light"):
        assert "psnr_h" not in found[kind] and found[kind]["psnr_l"] > 5
