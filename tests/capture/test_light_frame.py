"""Test light that turns with the camera, and photos of different exposures. The scenes are balls with known ground truth."""

import json
import tomllib

import numpy as np
import pytest
from PIL import Image

from benchmarks.scenes.analytic import DISTANCE, F0, TWO, camera_matrix, sky, write_ball_capture
from refgs.camera import Camera
from refgs.capture.poses import OPENGL_TO_OPENCV
from refgs.formats.panorama import directions
from refgs.model.environment import turn_between
from refgs.run import open_run
from refgs.train.keep.measures import held_out_psnr
from refgs.train.learn.exposures import exposure
from tests.makers.training import asset_error, trained, trainer

SIZE = 32  # pixels along a photo's side
METAL = "surfels.metallic=0.9"
STOPS = (0.0, 0.7, 0.0, -0.7, 0.0)


@pytest.fixture(scope="module")
def turntable(tmp_path_factory):
    folder = tmp_path_factory.mktemp("turntable")
    write_ball_capture(folder, SIZE, turning=True)
    return folder


def camera(direction) -> Camera:
    pose = np.linalg.inv(camera_matrix(np.asarray(direction, float)) @ OPENGL_TO_OPENCV)
    return Camera("c", 8, 8, 8, 8, 4, 4, pose)


def test_heading_is_the_turn_about_the_vertical():
    for elevation in (-1.2, 0.0, 0.4, 1.5):
        for azimuth in (-3.0, -1.0, 0.0, 0.5, 2.0):
            level = np.cos(elevation)
            here = camera([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
            there = camera([1, 0, 0])  # looks along −x
            assert np.isclose(np.linalg.norm(here.position), DISTANCE)
            assert np.isclose(np.cos(here.heading - azimuth - np.pi / 2), 1)
            turned = turn_between(here, there) @ here.position
            expected = DISTANCE * np.array([level, 0, np.sin(elevation)])
            np.testing.assert_allclose(turned, expected, atol=1e-9)


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("how", [{}, {"balls": TWO}, {"stops": STOPS}], ids=["one ball", "two balls", "exposures"])
def test_auto_tells_which_light_it_was(tmp_path, how, turning):
    """Check that the photos alone show whether the light turns with the camera or stands still.

    The answer must also be right for two balls that mirror each other, and for photos of different exposures.
    """
    write_ball_capture(tmp_path / "capture", SIZE, turning=turning, **how)
    found = trainer(tmp_path / "capture", tmp_path / "run", METAL, total=600).state
    assert found.settings.light.frame == ("camera" if turning else "world"), found.effective.chosen()
    assert "explains" in found.effective.chosen()["light.frame"]


def test_without_masks_the_light_stands_still(turntable, tmp_path):
    write_ball_capture(tmp_path / "bare", SIZE, turning=True)
    for file in (tmp_path / "bare").glob("*/*.png"):
        Image.open(file).convert("RGB").save(file)
    said = []
    report = lambda event, facts: said.append((event, facts["what"]))  # noqa: E731
    found = trainer(tmp_path / "bare", tmp_path / "run", METAL, report=report)
    assert found.state.settings.light.frame == "world"
    assert ("decided", "the light stands still: not every photo has a mask of the object") in said
    assert ("decided", "without inter-reflection: not every photo has a mask of the object") in said
    assert "mask" in found.state.effective.chosen()["light.frame"]


def test_a_light_that_turns_is_recovered(turntable, tmp_path):
    """Check that learning a light that turns with the camera gains 3 dB over learning a fixed light.

    Check also that the saved run renders as the training did, and that run.toml records which light was chosen.
    """
    still = trainer(turntable, tmp_path / "still", METAL, "light.frame=world", "light.exposure=off", total=200)
    still.run()
    turning = trained(turntable, tmp_path / "run", METAL, "light.exposure=off", total=200)
    assert held_out_psnr(turning.state) > held_out_psnr(still.state) + 3

    run = open_run(turning.state.folder)
    assert run.settings.light.frame == "camera" and asset_error(turning) < 2e-3
    assert tomllib.loads((run.folder / "run.toml").read_text())["chosen"]["light.frame"].startswith("camera: ")
    left_out = {entry["what"]: entry["why"] for entry in json.loads((run.folder / "needs.json").read_text())}
    assert "turns with the camera" in left_out["inter-reflection"]

    # environment.exr holds the light in its orientation for one photo, which cameras.json names.
    cameras = json.loads((run.folder / "cameras.json").read_text())
    first = turning.state.views[0].camera
    assert cameras["light_of"] == f"images/{first.name}"
    around, albedo = directions(16, 32), turning.state.surfels().albedo.mean(dim=0).detach().numpy()
    mirrored = around @ (first.position * [1, 1, 0]) > 0  # directions behind the ball are reflected in no photo
    found = (run.environment.panorama(16) * albedo)[mirrored].ravel()

    def likeness(angle: float) -> float:
        sine, cosine = np.sin(angle - first.heading), np.cos(angle - first.heading)
        truth = sky(around @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])) * F0
        return np.corrcoef(found, truth[mirrored].ravel())[0, 1]

    assert likeness(0) > 0.9
    assert likeness(0) > max(likeness(angle) for angle in (-np.pi / 2, np.pi / 2, np.pi)) + 0.03


def test_exposures_are_learned_where_photos_differ(tmp_path):
    write_ball_capture(tmp_path / "capture", 48, stops=STOPS)
    without, with_them = (
        trained(tmp_path / "capture", tmp_path / e, METAL, f"light.exposure={e}", total=600) for e in ("off", "auto")
    )
    assert held_out_psnr(with_them.state) > held_out_psnr(without.state) + 1
    index = [int(view.camera.name.partition("_")[2].partition(".")[0]) for view in with_them.state.views]
    truth = np.array([STOPS[i % len(STOPS)] for i in index])
    assert with_them.state.learned["exposure"].shape[1] == 1 and "not in white" in with_them.state.decided["exposures"]
    found = with_them.state.learned["exposure"].detach().numpy()[:, 0] / np.log(2)
    assert np.abs(found - truth).max() < 0.25
    frames = json.loads((tmp_path / "auto" / "cameras.json").read_text())["frames"]
    factors = [frame.get("exposure") for frame in frames if frame["split"] == "train"]
    np.testing.assert_allclose(factors, 2**found, rtol=1e-5)
    assert not any("exposure" in frame for frame in frames if frame["split"] == "test")


BALANCES = ((0.0, 0.0, 0.0), (0.3, 0.0, -0.3), (0.2, 0.0, -0.1), (-0.3, 0.0, 0.4), (0.0, 0.2, 0.0))


def test_white_balances_are_learned_where_photos_differ(tmp_path):
    """Check that white balances are told apart, to 5 % in the root mean square, and that they are neutral in the mean."""
    write_ball_capture(tmp_path / "capture", 48, stops=BALANCES)
    made = trained(tmp_path / "capture", tmp_path / "run", METAL, total=600)
    index = [int(view.camera.name.partition("_")[2].partition(".")[0]) for view in made.state.views]
    truth = np.array([BALANCES[i % len(BALANCES)] for i in index])
    found = exposure(made.state, slice(None)).detach().log2().numpy()
    found_tint, tint = (value - value.mean(axis=1, keepdims=True) for value in (found, truth))
    np.testing.assert_allclose(found_tint.mean(axis=0), 0, atol=1e-5)
    error = found_tint - (tint - tint.mean(axis=0))
    assert np.sqrt((error**2).mean()) < np.log2(1.05) < 0.5 * tint.std()
    frames = json.loads((tmp_path / "run" / "cameras.json").read_text())["frames"]
    np.testing.assert_allclose([f["exposure"] for f in frames if f["split"] == "train"], 2**found, rtol=1e-5)


def test_exposures_cost_nothing_where_photos_agree(ball_capture, tmp_path):
    without, asked = (
        trained(ball_capture, tmp_path / e, METAL, f"light.exposure={e}", total=200) for e in ("off", "auto")
    )
    assert "exposure" not in asked.state.learned and "no exposures of their own" in asked.state.decided["exposures"]
    assert abs(held_out_psnr(asked.state) - held_out_psnr(without.state)) < 0.3
