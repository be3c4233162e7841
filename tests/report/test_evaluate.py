"""Test the evaluation of a run against known ground truth. The ground truth is in rotated, moved and scaled coordinates."""

import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scenes.analytic import sky
from refgs import commands
from refgs.capture import read_capture
from refgs.color import srgb_encode
from refgs.compare import surface
from refgs.compare.pictures import DOUBTFUL, TOLD, maps
from refgs.compare.truth import GroundTruth
from refgs.errors import InputError
from refgs.formats.exr import read_exr, write_exr
from refgs.formats.panorama import directions
from refgs.formats.splats import read_splats, write_splats
from refgs.model.environment import Environment
from refgs.run import open_run
from refgs.run_folder import update_metrics
from tests.makers.ball import BOX, MOVE, SCALE, TURN, dusk, write_run

DUSK = Environment.from_panorama(dusk(directions(64, 128)).astype(np.float32), 16)


def turned(light, turn, height=64):
    """Sample the light as a panorama (height, 2 × height, 3), rotated by the matrix `turn`."""
    return light(directions(height, 2 * height) @ turn)


def write_truth(folder, run, views):
    """Write ground truth of every kind, rendered from the run itself. So if the run is evaluated unchanged, all its errors are zero."""
    for name, light in {"light": sky, "relight/dusk": dusk}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_exr(folder / f"{name}.exr", turned(light, TURN))
    box = BOX.copy()
    box.vertices = SCALE * box.vertices @ TURN.T + MOVE
    box.export(folder / "mesh.ply")
    for view in views:
        images = maps(run.render(view.camera))
        images["normal"] = images["normal"] @ TURN.T
        images["visibility"] = np.ones_like(images["alpha"])
        images["relight/dusk"] = maps(run.render(view.camera, DUSK))["color"]
        for name in ("alpha", "normal", "albedo", "roughness", "metallic", "visibility", "color", "relight/dusk"):
            (folder / name).mkdir(exist_ok=True)
            write_exr(folder / name / f"{view.camera.name}.exr", images[name])
    return folder


@pytest.fixture(scope="module")
def made(sharp_ball, tmp_path_factory):
    folder, capture = tmp_path_factory.mktemp("evaluate"), read_capture(sharp_ball)
    run, views = write_run(folder / "run", capture), capture.test_views
    return run, write_truth(folder / "truth", open_run(run), views), views


@pytest.fixture(autouse=True)
def fewer_points(monkeypatch):
    monkeypatch.setattr(surface, "POINTS", 2000)


def evaluated(run, truth):
    commands.evaluate(run, "test", truth)
    return json.loads((run / "metrics.json").read_text())


def test_a_run_that_is_the_truth_has_no_error_in_whatever_frame(made, capsys):
    run, truth, views = made
    update_metrics(run, {"relight": {"dusk": {"mesh": {"psnr_raw": 20.0}}}, "psnr": 1.0})
    found = evaluated(run, truth)
    assert found["views"] == len(views) == 4 and found["splats"] == 3000 and found["frames_per_second"] > 0
    assert found["psnr"] > 15 and 0 < found["ssim"] < 1 and 0 < found["flip"] < 0.5
    assert found["lpips"] is None and found["lpips_reason"]
    assert found["normal_mae_degrees"] < 0.1 and found["normal_ssim"] > 0.9999
    assert found["albedo"]["psnr_raw"] > 90 and found["albedo"]["scale"] == pytest.approx([1, 1, 1], abs=1e-4)
    assert found["roughness_mae"] < 1e-6 and found["metallic_mae"] < 1e-6
    assert found["metallic_wrong"] == 0
    assert found["visibility_agreement"] == found["visibility_free"] == 1
    assert found["environment"]["log_rmse"] < 0.02 and found["environment"]["scale"] == pytest.approx(1, abs=0.01)
    assert found["mesh"]["chamfer"] < 1e-3 and found["mesh"]["normal_consistency"] > 0.99
    relit = found["relight"]["dusk"]
    assert relit["refgs"]["psnr_raw"] > 45 and relit["refgs"]["flip_raw"] < 0.01
    assert relit["refgs"]["scale"] == pytest.approx(1, abs=0.01)
    assert relit["mesh"] == {"psnr_raw": 20.0}, "the figures of others stay"
    said = capsys.readouterr().out
    assert "4 test views: PSNR" in said and "relit by dusk, surfels (RefGS)" in said
    name = views[0].camera.name
    for kind in ("photo", "color", "normal", "true_normal", "true_albedo", "true_visibility", "metallic"):
        assert (run / "pictures" / "test" / kind / f"{name}.png").exists()
    found, true = (cv2.imread(str(run / "pictures" / f"environment{which}.png")) for which in ("", "_truth"))
    np.testing.assert_array_equal(found, np.rint(255 * srgb_encode(sky(directions(64, 128))).clip(0, 1))[..., ::-1])
    assert np.abs(found.astype(int) - true).max() < 12, "both in the run's frame, at one exposure"
    for kind in ("truth", "refgs"):
        assert (run / "pictures" / "relight" / kind / f"dusk_{name}.png").exists()


def test_known_errors_are_found(made, tmp_path):
    run, _, views = made
    there = open_run(run)
    truth = write_truth(tmp_path, there, views)
    tilt = Rotation.from_euler("x", 10, degrees=True).as_matrix()
    for view in views:
        name = f"{view.camera.name}.exr"
        images = maps(there.render(view.camera))
        write_exr(truth / "albedo" / name, images["albedo"] * [0.5, 0.8, 1.0])
        write_exr(truth / "roughness" / name, images["roughness"] + 0.125)
        visible = np.ones_like(images["alpha"])
        visible[: view.camera.height // 2] = 0
        write_exr(truth / "visibility" / name, visible)
        normal = images["normal"] @ TURN.T
        axis = np.cross(normal, view.camera.position @ TURN.T)  # tilt the normal about a tangent
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True) + 1e-12
        write_exr(truth / "normal" / name, np.cos(0.2) * normal + np.sin(0.2) * np.cross(axis, normal))
        image = maps(there.render(view.camera, DUSK))["color"]
        write_exr(truth / "relight" / "dusk" / name, image * np.float32([0.5, 0.5, 0.5, 1]))
    write_exr(truth / "light.exr", 2 * turned(sky, TURN @ tilt))
    found = evaluated(run, truth)
    assert found["albedo"]["psnr_aligned"] > 90 and found["albedo"]["scale"] == pytest.approx([0.5, 0.8, 1], abs=1e-4)
    assert found["albedo"]["psnr_raw"] == pytest.approx(-10 * np.log10(0.7**2 * (0.5**2 + 0.2**2) / 3), abs=0.05)
    assert found["roughness_mae"] == pytest.approx(0.125, abs=1e-4)
    assert found["visibility_agreement"] == pytest.approx(0.5, abs=0.05) == found["visibility_free"]
    assert found["normal_mae_degrees"] == pytest.approx(np.degrees(0.2), abs=0.1)
    assert found["environment"]["scale"] == pytest.approx(2, rel=0.02) and found["environment"]["log_rmse"] > 0.03
    relit = found["relight"]["dusk"]["refgs"]
    assert relit["scale"] == pytest.approx(0.5, rel=0.01) and relit["psnr_aligned"] > 45 > 30 > relit["psnr_raw"]


def test_where_photos_do_not_tell_is_a_picture(made, tmp_path):
    """Check the colours of a ball about the origin, whose half to the right of the camera is in doubt."""
    run, _, views = made
    camera = views[0].camera
    shutil.copytree(run, tmp_path / "run")
    splats = read_splats(run / "splats.ply")
    splats.doubt = (splats.positions @ camera.camera_to_world[:3, 0] > 0).astype(np.float32)
    write_splats(tmp_path / "run" / "splats.ply", splats)
    evaluated(tmp_path / "run", None)
    picture = cv2.imread(str(tmp_path / "run/pictures/test/doubt" / f"{camera.name}.png"))[..., ::-1] / 255
    x, y, _ = camera.projection @ [0, 0, 0, 1] / np.linalg.norm(camera.position)
    half = 0.5 * camera.fx / np.linalg.norm(camera.position)
    np.testing.assert_allclose(picture[int(y), int(x + half)], DOUBTFUL, atol=0.03)
    np.testing.assert_allclose(picture[int(y), int(x - half)], TOLD, atol=0.03)
    assert (picture[0, 0] == 0).all()


def test_only_what_is_there_is_measured(made, tmp_path):
    run, truth, _ = made
    (run / "metrics.json").unlink(missing_ok=True)
    photos_only = {"psnr", "ssim", "flip", "lpips", "lpips_reason", "views", "split", "splats"}
    photos_only |= {"frames_per_second", "frames_device"}
    assert evaluated(run, None).keys() == photos_only
    (tmp_path / "light.exr").write_bytes((truth / "light.exr").read_bytes())
    assert evaluated(run, tmp_path).keys() - photos_only == {"environment"}


def test_normals_that_a_data_set_brings_are_the_truth_where_there_is_no_other(made, monkeypatch):
    run, truth, _ = made
    there, asked = open_run(run), []

    def published(view, max_side):
        asked.append(view.camera.name)
        images = maps(there.render(view.camera))
        return np.where(images["alpha"][..., None] > 0.5, -images["normal"] @ TURN.T, 0), images["alpha"]

    monkeypatch.setattr("refgs.compare.truth.published_normals", published)
    assert evaluated(run, None)["normal_mae_degrees"] == pytest.approx(180, abs=0.1) and len(asked) == 4
    assert evaluated(run, truth)["normal_mae_degrees"] < 0.1 and len(asked) == 4


def test_a_larger_truth_is_reduced(made):
    """Check true maps at half their size against the mean of four pixels, in which only the object counts."""
    _, truth, views = made
    known, camera = GroundTruth(truth, np.eye(4)), views[0].camera
    half = camera.resized(32, 32)

    def mean(values):
        return values.reshape(32, 2, 32, 2, -1).mean(axis=(1, 3))

    (wholes, alpha), (halves, reduced) = known.maps(camera), known.maps(half)
    alpha = alpha[..., None]
    assert reduced[..., None] == pytest.approx(mean(alpha), abs=1e-6)
    inside = mean(alpha)[..., 0] > 0.1
    assert (inside & (mean(alpha)[..., 0] < 0.9)).sum() > 10, "the outline is asked about, too"
    for name in ("normal", "albedo", "roughness"):
        expected = mean(wholes[name].reshape(64, 64, -1) * alpha) / np.maximum(mean(alpha), 1e-6)
        if name == "normal":
            expected /= np.maximum(np.linalg.norm(expected, axis=-1, keepdims=True), 1e-6)
        found = halves[name].reshape(32, 32, -1)
        assert found[inside] == pytest.approx(expected[inside], abs=1e-4), name
    assert known.relit("dusk", half) == pytest.approx(mean(known.relit("dusk", camera)), abs=1e-5)


def test_a_missing_file_is_one_line(made, tmp_path):
    run, truth, views = made
    with pytest.raises(InputError, match="no ground truth in it"):
        GroundTruth(tmp_path, np.eye(4))
    for name in ("albedo", "relight/dusk"):
        file = truth / name / f"{views[2].camera.name}.exr"
        kept = file.rename(tmp_path / "kept.exr")
        with pytest.raises(InputError, match=f"{views[2].camera.name}.exr is missing"):
            commands.evaluate(run, "test", truth)
        kept.rename(file)
    known = GroundTruth(truth, np.eye(4))
    for size in ((128, 128), (64, 32)):
        other = views[0].camera.resized(*size)
        with pytest.raises(InputError, match=f"64×64 pixels, which does not fit its view of {size[0]}×{size[1]}"):
            known.maps(other)
        with pytest.raises(InputError, match="64×64 pixels, which does not fit"):
            known.relit("dusk", other)
    other = shutil.copytree(truth, tmp_path / "other")
    file = other / "albedo" / f"{views[0].camera.name}.exr"
    write_exr(file, np.repeat(np.repeat(read_exr(file), 2, axis=0), 2, axis=1))
    with pytest.raises(InputError, match=r"albedo/.* is not as large as the alpha"):
        GroundTruth(other, np.eye(4)).maps(views[0].camera)
    (tmp_path / "grey" / "normal").mkdir(parents=True)
    write_exr(tmp_path / "grey" / "normal" / f"{views[0].camera.name}.exr", np.ones((64, 64)))
    with pytest.raises(InputError, match="one channel where there should be 3"):
        GroundTruth(tmp_path / "grey", np.eye(4)).maps(views[0].camera)
