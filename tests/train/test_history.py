"""Test the history of a training: when its lines are written, what they contain, and how long measuring takes."""

import json
import math
import shutil

import numpy as np
import pytest

from benchmarks.scenes.analytic import F0, ONE, sky
from refgs.capture import read_capture
from refgs.formats.exr import read_exr, write_exr
from refgs.formats.panorama import directions
from refgs.train import timeline
from refgs.train.keep import history
from tests.makers import scenes
from tests.makers.ball import dusk
from tests.makers.mutants import put_link
from tests.makers.training import TINY, put, trainer


def make(capture, folder, *changes, total=40, **options):
    return trainer(capture, folder, *TINY, *changes, total=total, **options)


def rows(folder):
    return [json.loads(line) for line in (folder / history.FILE).read_text().splitlines()]


def test_lines_are_evenly_spaced_by_logarithm():
    found = [i for i in range(20_000) if timeline.even_by_logarithm(i)]
    assert found[0] == 10 and {100, 1000, 10_000} <= set(found)
    assert sum(100 <= i < 1000 for i in found) == sum(1000 <= i < 10_000 for i in found) == 10
    ratios = np.divide(found[5:], found[4:-1])
    np.testing.assert_allclose(ratios, 10**0.1, rtol=0.06)


@pytest.mark.parametrize(("cost", "lines"), [(0.1, 26), (2.0, 5), (100.0, 2)])
def test_measuring_has_its_share(cost, lines):
    """Check that measurements take at most 2.5 % of the training's time, not counting the first and the last.

    The training has 3,000 iterations of 0.1 s. A measurement takes `cost` seconds. `lines` is how many measurements are expected.
    """
    spent, at = 0.0, []
    for i in [*filter(timeline.even_by_logarithm, range(3000)), 3000]:
        if i == 3000 or spent <= history.allowed(i, 3000, 0.1 * i):
            spent += cost
            at.append(i)
    assert len(at) == lines and at[0] == 10 and at[-1] == 3000
    assert spent <= history.SHARE * 300 + 2 * cost
    if lines == 5:
        gaps = np.diff(np.log(at))
        assert gaps.max() < 2 * gaps.min()


def test_measuring_is_not_in_the_seconds(ball_capture, tmp_path, monkeypatch):
    """Check that time spent on measurements does not count as training time. In this test a measurement takes 1000 s."""

    class Time:
        now = 0.0

        def perf_counter(self):
            self.now += 0.001
            return self.now

        process_time = perf_counter

    time = Time()
    monkeypatch.setattr("refgs.train.trainer.time", time)
    monkeypatch.setattr("refgs.clock.time", time)
    made = make(ball_capture, tmp_path / "run", total=20)

    def slow(_):
        time.now += 1000
        return {"psnr_test": 20.0}

    made.measures.errors = slow
    made.run()
    found = rows(tmp_path / "run")
    assert [row["iteration"] for row in found] == [10, 13, 16, 20]
    measured = [row["iteration"] for row in found if "psnr_test" in row]
    assert measured == [10, 20], "the first and the last, whatever it costs"
    assert found[-1]["seconds"] < 10 and made.state.seconds < 10
    assert made.state.clock.seconds["measuring"] == pytest.approx(2000, abs=1)
    assert found[-1]["parts"]["measuring"] == pytest.approx(1000, abs=1), "what was spent before that line"


def test_parts_add_up_to_the_seconds(ball_capture, tmp_path):
    said = []
    make(ball_capture, tmp_path / "run", "densify.every=10", report=lambda *event: said.append(event)).run()
    last = rows(tmp_path / "run")[-1]
    parts = last["parts"]
    inside = {name: seconds for name, seconds in parts.items() if name not in history.BESIDE}
    assert {"raster", "shading", "prefilter", "surfels", "loss", "optimiser", "densification"} < inside.keys()
    assert sum(inside.values()) == pytest.approx(last["seconds"], abs=2e-3) and min(inside.values()) > 0
    assert parts["raster"] > parts["optimiser"], "which takes a hundredth of its time"
    heard = [facts for event, facts in said if event == "measured"]
    assert [facts["iteration"] for facts in heard] == [row["iteration"] for row in rows(tmp_path / "run")]
    assert "parts" not in heard[0] and heard[-1]["psnr_test"] == last["psnr_test"]


def test_a_resumed_run_records_the_same(ball_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(history, "SHARE", math.inf)  # measure at every line, at any cost
    changes = ["train.checkpoint_every=20", "densify.every=15"]
    make(ball_capture, tmp_path / "whole", *changes).run()
    first = make(ball_capture, tmp_path / "cut", *changes)
    first.run(stop=lambda: first.state.iteration >= 34)
    assert rows(tmp_path / "cut")[-1]["iteration"] == 32
    (tmp_path / "cut" / "checkpoints" / "00000034.toml").unlink()  # killed before this checkpoint was complete
    second = make(ball_capture, tmp_path / "cut", *changes)
    second.resume()
    assert rows(tmp_path / "cut")[-1]["iteration"] == 20 == second.state.iteration
    second.run()
    others = {"seconds", "parts"}
    whole, cut = (
        [{name: row[name] for name in row.keys() - others} for row in rows(tmp_path / run)] for run in ("whole", "cut")
    )
    assert whole == cut and whole[-1]["iteration"] == 40 and "flip_test" in whole[3]
    before, after = (row["parts"] for row in rows(tmp_path / "cut")[3:5])
    assert all(after[name] >= before[name] - 1e-4 for name in before), "time is counted on"


@pytest.mark.parametrize("other", ["", "/dev/zero"])
def test_what_is_no_file_is_set_aside(tmp_path, other):
    """Put a folder or a link to an endless device in the place of a history. Check that a resumed training has a new one."""
    put_link(tmp_path / "history.jsonl", other)
    said = []
    history.trim(tmp_path, 20, lambda event, facts: said.append((event, facts["what"])))
    assert len(said) == 1 and said[0][0] == "warning" and "cannot be read and is set aside as *.damaged" in said[0][1]
    assert not (tmp_path / "history.jsonl").exists() and (tmp_path / "history.jsonl.damaged").exists()


def test_a_training_that_is_ended_early_has_a_last_line(ball_capture, tmp_path):
    made = make(ball_capture, tmp_path / "run")

    def finish():
        if made.state.iteration == 14:
            made.state.total = 14
        return made.state.ended

    made.run(stop=finish)
    assert [row["iteration"] for row in rows(tmp_path / "run")] == [10, 13, 14]
    assert "flip_test" in rows(tmp_path / "run")[-1]


def write_truth(capture):
    """Write the ball's ground truth for the held-out views, also under a second light. It is computed by formula."""
    truth = capture / "ground_truth"
    for name in ("alpha", "normal", "albedo", "roughness", "metallic", "relight/dusk"):
        (truth / name).mkdir(parents=True)
    write_exr(truth / "light.exr", sky(directions(64, 128)))
    write_exr(truth / "relight" / "dusk.exr", dusk(directions(64, 128)))
    for view in read_capture(capture).test_views:
        camera, name = view.camera, f"{view.camera.name}.exr"
        ray, hit, _, normal = scenes.meetings(camera, ONE)
        cosine = -(ray * normal).sum(-1, keepdims=True)
        fresnel = F0 + (1 - F0) * (1 - cosine.clip(0, 1)) ** 5
        radiance = np.where(hit[:, None], fresnel * dusk(ray + 2 * cosine * normal), 0)
        images = {"alpha": hit, "metallic": hit, "roughness": 0 * hit}
        images |= {"normal": normal * hit[:, None], "albedo": hit[:, None] * F0}
        images["relight/dusk"] = np.concatenate([radiance, hit[:, None]], axis=1)
        for kind, pixels in images.items():
            shape = camera.height, camera.width, *pixels.shape[1:]
            write_exr(truth / kind / name, pixels.reshape(shape).astype(np.float32))


@pytest.fixture(scope="module")
def known_capture(ball_capture, tmp_path_factory):
    folder = tmp_path_factory.mktemp("known") / "ball"
    shutil.copytree(ball_capture, folder)
    write_truth(folder)
    return folder


def test_errors_against_the_truth(known_capture, tmp_path):
    """Check that the errors recorded by a training agree with an independent computation from the ground truth.

    Check also that training lowers the errors.
    """
    changes = "surfels.metallic=0.9", "surfels.budget=1500", "surfels.start=1500"
    made = make(known_capture, tmp_path / "run", *changes, total=250)
    start = made.measures.errors(made.state)
    made.run()
    found = rows(tmp_path / "run")[-1]
    angles, roughness, metallic = [], [], []
    for view in made.state.test:
        _, hit, _, normal = scenes.meetings(view.camera, ONE)
        seen = made.state.render(view.camera)
        shown = seen.normal.double().numpy().reshape(-1, 3)[hit]
        there = (seen.alpha.numpy().reshape(-1)[hit] >= 0.1) & (np.linalg.norm(shown, axis=1) > 1e-6)
        cosine = (shown * normal[hit]).sum(-1) / np.maximum(np.linalg.norm(shown, axis=1), 1e-6)
        angles.append(np.degrees(np.where(there, np.arccos(cosine.clip(-1, 1)), np.pi / 2)).mean())
        roughness.append(seen.roughness.numpy().reshape(-1)[hit].mean())
        metallic.append(1 - seen.metallic.numpy().reshape(-1)[hit].mean())
    assert found["normal_mae_degrees"] == pytest.approx(np.mean(angles), rel=1e-4)
    assert found["roughness_mae"] == pytest.approx(np.mean(roughness), abs=1e-4)
    assert found["metallic_mae"] == pytest.approx(np.mean(metallic), abs=1e-4)
    light, true = made.state.environment().panorama(64), sky(directions(64, 128))
    weight = np.cos(np.pi * (0.5 - (np.arange(64) + 0.5) / 64))[:, None, None]
    apart = np.log(light) - np.log(true)
    apart -= (apart * weight).sum() / (weight.sum() * 128 * 3)
    rmse = math.sqrt((apart**2 * weight).sum() / (weight.sum() * 128 * 3))
    assert found["light_log_rmse"] == pytest.approx(rmse, rel=0.05)
    assert found["light_log_rmse"] < 0.5 * start["light_log_rmse"]
    assert found["relit_psnr"] > start["relit_psnr"] + 3 and found["psnr_test"] > start["psnr_test"] + 5
    assert found["albedo_psnr"] > 15 and 0 < found["flip_test"] < 0.1


def test_a_light_known_exactly_leaves_the_relit_picture_alone(known_capture, tmp_path):
    """Check that surfels with the true material, relit by the known light, reach a PSNR over 20 dB.

    Surfels of another metal must stay below 20 dB.
    """
    made = make(known_capture, tmp_path / "run", "surfels.start=3000", "surfels.budget=3000", "surfels.hull=96")
    logit = np.log(F0 / (1 - F0))
    put(made, albedo=logit, metallic=9.0, roughness=-9.0)
    assert made.measures.errors(made.state)["relit_psnr"] > 20
    put(made, albedo=logit[::-1].copy())
    assert made.measures.errors(made.state)["relit_psnr"] < 20, "of another metal"


def test_without_colour_that_is_material_there_is_none_to_compare(known_capture, tmp_path):
    sh = make(known_capture, tmp_path / "sh", "render.shading=sh")
    assert sh.measures.errors(sh.state).keys() == {"psnr_test", "normal_mae_degrees"}
    diffuse = make(known_capture, tmp_path / "diffuse", "render.diffuse=sh")
    materials = {"roughness_mae", "metallic_mae", "metallic_wrong"}
    expected = {"psnr_test", "normal_mae_degrees", *materials, "light_log_rmse"}
    assert diffuse.measures.errors(diffuse.state).keys() == expected


def test_a_truth_that_does_not_fit_is_left_out_with_a_line(known_capture, tmp_path):
    said = []
    folder = shutil.copytree(known_capture, tmp_path / "ball")
    for file in (folder / "ground_truth" / "normal").iterdir():
        write_exr(file, read_exr(file)[::2])
    made = make(folder, tmp_path / "run", report=lambda *event: said.append(event))
    (warning,) = [facts["what"] for event, facts in said if event == "warning"]
    assert "does not fit its view of 32×32" in warning
    assert made.measures.errors(made.state).keys() == {"psnr_test"}


def test_psnr_is_that_of_encoded_pictures(ball_capture, tmp_path):
    made = make(ball_capture, tmp_path / "run")
    square = []
    for view in made.state.test:
        alpha = view.alpha[..., None] / 255
        photo = view.image / 255 * alpha + 1 - alpha
        seen = made.state.render(view.camera)
        square.append(((seen.color.double().numpy().clip(0, 1) - photo) ** 2).mean())
    expected = np.mean([-10 * np.log10(s) for s in square])
    assert made.measures.errors(made.state)["psnr_test"] == pytest.approx(expected, abs=1e-4)
