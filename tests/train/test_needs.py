"""Test the decisions to leave out optional parts of the training that a scene does not need, such as specular shading.

A part is left out if a measured number is below the part's threshold.
"""

import json
import math
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from benchmarks.scenes.analytic import write_ball_capture
from refgs.formats.needs import Found
from refgs.formats.splats import read_splats
from refgs.model.environment import Environment
from refgs.render.sums import blended_shares
from refgs.run import open_run
from refgs.train import probe
from refgs.train.decide import iterations, lighting, needs, photos
from refgs.train.decide.materials import SHINES
from refgs.train.keep.asset import write_asset
from refgs.train.keep.measures import held_out_psnr
from refgs.train.learn.coarse import cost
from refgs.train.learn.losses import objective
from refgs.train.photo import MARGIN, Photo, bounds
from refgs.train.plan import Plan
from refgs.train.state import why_not_traced
from refgs.train.timeline import RESET, SEEN, faint_now
from tests.makers.occluders import as_occluder, plate
from tests.makers.training import asset_error, check_equal, copied, do, put
from tests.makers.training import trainer as small

DULL = ["surfels.metallic=0.01", "surfels.roughness=0.8"]  # a matte start, because the trainings are short
SMALL = ["environment.resolution=32", "indirect.every=100", "indirect.resolution=32"]


def trainer(capture, folder, *changes, total=150):
    return small(capture, folder, *SMALL, *changes, total=total)


@pytest.fixture(scope="module")
def matte(tmp_path_factory):
    """Write a capture of a matte ball, whose colour is the same from every direction."""
    folder = tmp_path_factory.mktemp("matte")
    write_ball_capture(folder, 64, matte=True)
    return folder


@pytest.fixture(scope="module")
def ball_capture(sharp_ball):
    """Use sharper photos than other tests: what a need is worth is measured in them."""
    return sharp_ball


@pytest.fixture(scope="module")
def start(ball_capture, tmp_path_factory):
    """Make a training on the mirror that has not begun. Tests copy it."""
    return trainer(ball_capture, tmp_path_factory.mktemp("runs") / "start", total=10)


@pytest.fixture(scope="module")
def early(ball_capture, tmp_path_factory):
    """Train on the mirror until just before its first mesh. Tests copy it."""
    made = trainer(ball_capture, tmp_path_factory.mktemp("runs") / "early", "surfels.metallic=0.9", total=150)
    made.run(stop=lambda: made.state.iteration == 99)
    return made


@pytest.fixture(scope="module")
def chalk(matte, tmp_path_factory):
    """Train on the matte ball until it is decided which optional parts of the training to leave out.

    Writes the trained model, and returns the trainer.
    """
    made = trainer(matte, tmp_path_factory.mktemp("runs") / "chalk", *DULL, total=300)
    made.run()
    write_asset(made.state)
    return made


def test_what_is_matte_goes_without_specular(chalk):
    found = chalk.state.needs["specular"]
    assert not found.needed and found.statistic < found.threshold and found.megabytes > 0
    assert chalk.state.settings.render.reflection == "none" and chalk.state.settings.environment.resolution == 16
    left = {"metallic", "roughness", "indirect_dc", "indirect_rest", "received"}
    assert not left & {*chalk.state.learned} and not left & {*chalk.state.learned.moments}
    assert held_out_psnr(chalk.state) > 35


def test_what_is_matte_ends_sooner(chalk, matte, tmp_path):
    """Check that training on a matte scene skips a fifth of its remaining iterations.

    The setting needs.iterations=on keeps all iterations. A duration given by the user keeps all of them too.
    """
    found = chalk.state.needs["iterations"]
    assert not found.needed and found.seconds > 0
    assert found.statistic == chalk.state.needs["specular"].statistic
    assert chalk.state.iteration == chalk.state.total == found.total == 100 + round(iterations.Iterations.ENOUGH * 200)
    forced = trainer(matte, tmp_path / "off", "needs.specular=off", total=150)
    assert forced.state.total == forced.state.needs["iterations"].total == round(iterations.Iterations.ENOUGH * 150)
    assert trainer(matte, tmp_path / "on", "needs.specular=off", "needs.iterations=on", total=150).state.total == 150
    forced.state.needs.clear()
    forced.state.plan = Plan(1.0)
    needs.evaluate(forced.state, "start")
    assert "iterations" not in forced.state.needs


def test_a_convex_mirror_keeps_specular_and_does_without_reflections(early, tmp_path):
    made = copied(early, tmp_path / "run")
    made.run(stop=lambda: made.state.iteration == 110)
    found = made.state.needs["specular"]
    assert found.needed and found.statistic > 1 and "metallic" in made.state.learned
    assert made.state.settings.render.reflection == "microfacet" and made.state.total == 150
    found = made.state.needs["reflections"]
    assert not found.needed and found.statistic < found.threshold
    assert made.state.occluder is None and "received" not in made.state.learned and why_not_traced(made.state)


@pytest.mark.parametrize("word", ["on", "off"])
def test_forced_either_way(word, matte, ball_capture, tmp_path):
    """Check that the setting needs.specular (on or off) overrides the automatic choice whether to train specular shading."""
    made = trainer(matte if word == "on" else ball_capture, tmp_path / "run", f"needs.specular={word}", total=120)
    made.run()
    assert ("metallic" in made.state.learned) == (word == "on")
    write_asset(made.state)
    rows = {row.get("need"): row for row in json.loads((tmp_path / "run" / "needs.json").read_text())}
    assert (word == "off") == ("specular" in rows)
    if word == "off":
        assert rows["specular"]["why"] == "its setting leaves it out" and not rows["specular"]["needed"]


def test_the_asset_says_so_once(chalk):
    """Check the PLY file of a ball with the same metallic, roughness and specular everywhere: the header stores these values once.

    The file has no columns for them, and it renders like the trained model.
    """
    splats, run = read_splats(chalk.state.folder / "splats.ply"), open_run(chalk.state.folder)
    assert splats.constants == {"metallic": 0.0, "roughness": 1.0, "specular": 0.0}
    assert (splats.metallic == 0).all() and (splats.roughness == 1).all()
    head = (chalk.state.folder / "splats.ply").read_bytes().partition(b"end_header")[0]
    assert b"property float metallic" not in head and b"property float albedo_r" in head
    camera = chalk.state.test[0].camera
    assert asset_error(chalk) < 2e-3
    assert (run.render(camera).roughness[run.render(camera).alpha > 0.9] == 1).all()


def test_needs_are_written_down(chalk):
    rows = {row.get("need"): row for row in json.loads((chalk.state.folder / "needs.json").read_text())}
    assert {"specular", "iterations", "light"} <= {*rows}
    for name in ("specular", "light"):
        assert rows[name]["saved"] == f"{rows[name]['seconds']:.1f} s, {rows[name]['megabytes']:.1f} MB"
        assert rows[name]["cost"] == f"{rows[name]['decibels']:+.3f} dB" and math.isfinite(rows[name]["decibels"])
        assert name in chalk.state.decided
    assert rows["light"]["side"] == 16
    assert "cost" not in rows["iterations"]  # has no cost: that could not be measured


def test_decisions_are_shown(chalk, ball_capture, tmp_path):
    """Check that the pictures of a decision show its two answers: mirrored or not, they are of one view, beside its photo."""
    mirror = trainer(ball_capture, tmp_path / "mirror", total=300)
    while "specular" not in mirror.state.needs:
        mirror.iterate()
    for made, needed in ((chalk, False), (mirror, True)):
        (row,) = [row for row in needs.rows(made.state) if row["need"] == "specular"]
        shown, folder = row["pictures"], made.state.folder
        assert row["needed"] == needed and row in json.loads((folder / "needs.json").read_text())
        on, off, photo = (cv2.imread(str(folder / shown[kind])).astype(float) / 255 for kind in ("on", "off", "photo"))
        assert on.shape == off.shape == photo.shape and shown["view"] in {v.camera.name for v in made.state.views}
        for picture, kind in ((on, "on"), (off, "off")):
            assert -10 * np.log10(np.square(picture - photo).mean()) == pytest.approx(shown[f"psnr_{kind}"], abs=0.3)
        # What is matte looks the same if what is mirrored does not change with the view.
        assert (shown["psnr_on"] > shown["psnr_off"] + 0.5) == needed
    assert chalk.state.needs["iterations"].pictures is None


def test_a_resumed_run_keeps_its_decisions(matte, tmp_path):
    """Check that a resumed training keeps its decisions about which optional parts to leave out, such as specular shading.

    Its parameters and light equal those of an uninterrupted run, bit for bit.
    """
    more = [*DULL, "train.checkpoint_every=20", "densify.every=25", "train.light_first=0"]
    whole = trainer(matte, tmp_path / "whole", *more, total=150)
    first = copied(whole, tmp_path / "cut")
    whole.run()
    first.run(stop=lambda: first.state.iteration == 115)
    second = trainer(matte, tmp_path / "cut", *more, total=150)
    second.resume()
    assert second.state.needs == first.state.needs and not second.state.needs["specular"].needed
    second.run()
    check_equal(whole, second)


def test_a_training_that_goes_back_keeps_its_decisions(matte, tmp_path):
    """Check that a training keeps its decisions about which optional parts to leave out when it returns to an earlier checkpoint.

    It returns to a checkpoint if values become NaN or infinite.
    """
    made = trainer(matte, tmp_path / "run", *DULL, "train.light_first=0", total=200)
    made.run(stop=lambda: made.state.iteration == 96)
    assert "specular" not in made.state.needs
    for _ in range(10):
        made.step()
    decided = dict(made.state.needs)
    assert not decided["specular"].needed
    made.resume()
    assert made.state.iteration == 96 and made.state.needs == decided and "metallic" not in made.state.learned
    assert made.state.total == decided["iterations"].total < 200
    made.step()


def test_a_scene_that_was_taken_for_matte_gets_its_gloss_back(matte, ball_capture, tmp_path):
    """Check that specular shading comes back if photos change with the view halfway through, and with it what had been left out.

    The photos of a matte ball are replaced by those of a mirror. A training that is resumed afterwards, or that goes back to an older
    checkpoint, learns metallic too.
    """
    options = [*DULL, "needs.reflections=on", "train.light_first=0"]
    made = trainer(matte, tmp_path / "run", *options, total=300)
    state = made.state
    made.run(stop=lambda: "specular" in state.needs)
    assert not state.needs["specular"].needed and "metallic" not in state.learned
    assert state.total == state.needs["iterations"].total < 300
    while 2 * state.iteration < state.total - 2:
        made.step()
    made.save()
    assert state.needs["specular"].again is None
    state.photos = [Photo.of(view) for view in small(ball_capture, tmp_path / "mirror").state.views]
    for _ in range(3):
        made.step()
    found = state.needs["specular"]
    assert found.needed and found.statistic >= found.threshold and "halfway" in state.decided["specular"]
    assert {"metallic", "roughness", "received"} <= {*state.learned} and state.total == 300
    assert state.settings.render.reflection == "microfacet" and "iterations" not in state.needs
    assert state.effective.rows()["train.iterations"]["became"] == 300
    before = state.learned["roughness"].detach().clone()
    for _ in range(5):
        made.step()
    assert (state.learned["roughness"] - before).abs().max() > 0 and len(before) == state.learned.count
    made.resume()  # the checkpoint before it was taken back
    assert 2 * state.iteration < state.total and {"metallic", "roughness"} <= {*state.learned}
    made.step()
    made.save()
    again = trainer(matte, tmp_path / "run", *options, total=300)
    again.resume()
    assert again.state.needs == state.needs and "metallic" in again.state.learned and again.state.total == 300


def test_what_a_setting_leaves_out_stays_out_when_gloss_comes_back(matte, tmp_path):
    state = trainer(matte, tmp_path / "run", "needs.iterations=off", total=150).state
    recorded = {"specular": Found(needed=False, why=""), "iterations": state.needs["iterations"]}
    state.needs["specular"] = Found(needed=True, why="taken back")
    needs.restore(state, recorded)
    assert state.total == state.needs["iterations"].total < 150


def test_a_matte_scene_is_looked_at_twice(chalk):
    found = chalk.state.needs["specular"]
    assert not found.needed and found.again < SHINES


def test_reflections_by_what_they_could_be_worth(early, tmp_path):
    """Check when inter-reflection is kept: for a mirror with a fifth of its reflections occluded, but not for a rough black dielectric.

    The dielectric reflects so little light that occlusion hardly changes the photos.
    """
    made = copied(early, tmp_path / "run")
    made.state.occluder = as_occluder(plate(0.5, -1), scale=3.0)  # faces down, above the ball
    do(made.state, "decide on inter-reflection", hidden=0.2)
    found = made.state.needs.pop("reflections")
    assert found.needed and found.statistic > lighting.Reflections.threshold
    put(made, metallic=-10, albedo=0, roughness=5)
    do(made.state, "decide on inter-reflection", hidden=0.2)
    assert not made.state.needs["reflections"].needed


@pytest.mark.parametrize("hidden", [0.004, 0.2])
def test_reflections_of_a_small_part_are_kept(early, tmp_path, hidden):
    """Keep inter-reflection for a small part that is chrome, below a plate. The rest of the ball is rough, black and dielectric.

    `hidden` is below or above the least for the whole object. Without the chrome, inter-reflection is left out.
    """
    made = copied(early, tmp_path / "run")
    state = made.state
    top = state.learned["position"][:, 2] > 0.97
    for chrome in (True, False):
        put(made, metallic=-10, albedo=0, roughness=5)
        with torch.no_grad():
            state.learned["metallic"][top & chrome] = 5
            state.learned["roughness"][top & chrome] = -3
            state.learned["albedo"][top & chrome] = 3
        state.occluder = None
        state.photos = [with_rendering(state, p, noise=0.1)._replace(mask=p.mask) for p in state.photos]
        state.occluder = as_occluder(plate(1.2, -1), scale=0.9)
        do(state, "decide on inter-reflection", hidden=hidden)
        found = state.needs.pop("reflections")
        assert found.needed == chrome
        assert found.threshold == lighting.Reflections.SMALL_PART  # the whole decided nothing


def test_views_that_show_the_same_from_the_same_place(start, tmp_path):
    made = copied(start, tmp_path / "run")
    one = made.state.views[0]
    noise = np.random.default_rng(0).normal(0, 1, one.image.shape)
    again = replace(one, image=(one.image + noise.round()).clip(0, 255).astype(np.uint8))
    other = replace(one, image=(one.image.astype(int) + 20).clip(0, 255).astype(np.uint8))
    pose = one.camera.world_to_camera.copy()
    pose[0, 3] += 4.0 * one.camera.position.dot(one.camera.position) ** 0.5 / one.camera.fx
    aside = replace(one, camera=replace(one.camera, world_to_camera=pose))
    radius = made.state.capture.radius
    assert photos.duplicate_views([one, again], radius) == [1]
    assert photos.duplicate_views([one, other], radius) == []
    assert photos.duplicate_views([one, aside], radius) == []
    assert photos.duplicate_views(made.state.views, radius) == []


def test_the_part_about_the_mask_is_all_that_counts(start, tmp_path):
    """Check that a photo cropped to its mask gives the same loss and gradients as the full photo.

    Outside the mask, the model renders nothing.
    """
    made, generator = copied(start, tmp_path / "run"), torch.Generator().manual_seed(0)
    camera = made.state.photos[0].camera
    camera = replace(camera, fx=0.6 * camera.fx, fy=0.6 * camera.fy)
    mask = (made.state.render(camera).alpha > 0).byte() * 255
    whole = Photo(torch.randint(255, (64, 64, 3), dtype=torch.uint8, generator=generator), mask, camera)
    part = whole.part(*bounds(mask.numpy(), MARGIN))
    assert part.image.shape[0] < 64 and part.mask.sum() == mask.sum()
    results = []
    for photo in (whole, part):
        rendering = made.state.picture(made.state.inputs(), photo.camera)
        found = objective(rendering, None, photo, made.state.background, made.state.losses, 0.5)
        found.loss.backward()
        by = {name: value.grad.clone() for name, value in made.state.learned.by_row.items() if value.grad is not None}
        results.append((found, by))
        made.state.learned.forget_gradients()
    (one, by_one), (other, by_other) = results
    torch.testing.assert_close(one.loss, other.loss, rtol=1e-5, atol=0)
    torch.testing.assert_close(one.square, other.square, rtol=1e-5, atol=0)
    for name, value in by_one.items():
        assert float((value - by_other[name]).abs().max()) <= 1e-3 * float(value.abs().max()) + 1e-12, name


def test_a_photo_that_its_object_fills_stays_whole(ball_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(photos, "MARGIN", 5)  # the ball covers 45 of 64 pixels
    made = trainer(ball_capture, tmp_path / "run", total=10)
    assert made.state.crops is not None
    for view in made.state.views:
        view.alpha[:] = 255
    made.state.photos, made.state.crops = [Photo.of(view) for view in made.state.views], None
    del made.state.needs["outside"]
    needs.evaluate(made.state, "start")
    assert made.state.crops is None


def test_surfels_that_are_faint_decide_nothing_and_are_no_mesh(ball_capture, tmp_path):
    changes = ["densify.reset_every=5", "densify.stop=0.1", "rates.opacity=1.0", "rates.decay=1.0"]
    changes += ["needs.specular=on", "needs.reflections=on", "indirect.start=0", "indirect.every=8"]
    made = trainer(ball_capture, tmp_path / "run", *changes, total=60)
    way = 4 * math.log(SEEN / (1 - SEEN) * (1 - RESET) / RESET)  # iterations that surfels stay faint, at a rate of one
    made.run(stop=lambda: made.state.iteration >= 5 + math.floor(way))
    assert faint_now(made.state, made.state.iteration) and made.state.iteration > 0.19 * 60
    assert "light" not in made.state.needs and made.state.occluder is None
    made.run(stop=lambda: made.state.iteration >= 24)
    assert (
        not faint_now(made.state, made.state.iteration)
        and "light" in made.state.needs
        and made.state.occluder is not None
    )


def test_what_the_part_about_the_mask_saves_is_timed(ball_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(photos, "MARGIN", 5)
    made = trainer(ball_capture, tmp_path / "run", "needs.specular=on", total=20)
    asked = []
    monkeypatch.setattr(probe, "seconds_saved", lambda trainer, whole: asked.append(whole) or 8.0)
    for done in (99, 100, 101):
        do(made.state, "time the crops", done=done)
    # 7/8 of 8 s are saved: one iteration in eight uses the full photo.
    assert asked == [True] and made.state.needs["outside"].seconds == 7.0
    assert next(row for row in needs.rows(made.state) if row["need"] == "outside")["saved"] == "7.0 s, 0.0 MB"


def test_texels_by_the_lobe():
    """Check the choice of the cubemap's side: the smallest whose texels are no wider than LOBE · roughness², in radians.

    The width of the specular lobe is roughness². A texel is (π / 2) / side wide. The side is limited to 16 … 256.
    """
    lobe = lighting.Light.LOBE
    for roughness, side in ((1.0, 16), (0.5, 16), (0.4, 32), (0.2, 128), (0.05, 256)):
        assert lighting.resolvable(roughness, lobe, 256, 16) == side
        assert side in (16, 256) or math.pi / 2 / side <= lobe * roughness**2 < math.pi / side
    light = Environment(torch.rand(6 * 32**2, 3))
    coarse = light.reduced(16)
    assert coarse.resolution == 16
    torch.testing.assert_close(coarse.radiance.mean(dim=0), light.radiance.mean(dim=0))


def test_weighted_quantiles():
    values, weight = torch.tensor([3.0, 1.0, 2.0]), torch.tensor([1.0, 8.0, 1.0])
    assert [probe.quantile(values, weight, part) for part in (0.1, 0.79, 0.85, 1.0)] == [1.0, 1.0, 2.0, 3.0]


def test_degrees_by_what_they_are_worth(ball_capture, tmp_path):
    """Check that the degree of spherical harmonics is lowered to what the photos need: 3, 2, 1 or 0."""
    changes = ["needs.specular=on", "needs.reflections=off", "needs.light=on", "residual.start=0.5"]
    made = trainer(ball_capture, tmp_path / "run", *changes, total=10)
    made.run(stop=lambda: made.state.iteration == 6)
    for kept in (15, 8, 3, 0):
        rest = made.state.learned["sh_rest"]
        with torch.no_grad():
            rest[:] = 0.1 * torch.randn(rest.shape, generator=torch.Generator().manual_seed(0))
            rest[:, kept:] = 0
            for view, photo in enumerate(made.state.photos):
                made.state.photos[view] = with_rendering(made.state, photo)
        made.state.needs.pop("degrees", None)
        do(made.state, "decide on degrees of harmonics", progress=1.0)
        assert made.state.learned["sh_rest"].shape[1] == kept
        assert made.state.needs["degrees"].needed == (kept == 15)
    made.step()


def test_what_all_have_alike_is_said_once(ball_capture, tmp_path):
    made = trainer(ball_capture, tmp_path / "run", "needs.specular=on", total=10)
    made.run()
    put(made, metallic=-20)
    write_asset(made.state)
    splats = read_splats(tmp_path / "run" / "splats.ply")
    assert {*splats.constants} == {"metallic"} and splats.roughness.std() > 0
    assert made.state.needs["constants"].statistic == 1 and abs(made.state.needs["constants"].decibels) < 0.01
    assert open_run(tmp_path / "run").settings.render.reflection == "microfacet"


def with_rendering(state, photo, noise=0.0):
    """Replace the photo's pixels by the model's own rendering plus Gaussian noise of standard deviation `noise` (colours are 0 … 1)."""
    color = state.render(photo.camera).color
    color = color + noise * torch.randn(color.shape, generator=torch.Generator().manual_seed(0))
    return photo._replace(image=(color.clamp(0, 1) * 255).round().byte(), mask=torch.full_like(photo.mask, 255))


def test_specular_on_synthetic_surfels(start, tmp_path):
    """Check that specular shading gains over 3 dB in photos of a mirror, and under 0.3 dB in photos of a matte ball.

    The photos are renderings of the model itself.
    """
    made = copied(start, tmp_path / "run")
    light = torch.randn(made.state.learned["environment"].shape, generator=torch.Generator().manual_seed(1))
    for metallic, roughness, least, most in ((5.0, -3.0, 3.0, math.inf), (-20.0, 20.0, -math.inf, 0.3)):
        put(made, metallic=metallic, roughness=roughness)
        with torch.no_grad():
            made.state.learned["environment"].copy_(torch.nn.functional.softplus(light).log())
            for view, photo in enumerate(made.state.photos):
                made.state.photos[view] = with_rendering(made.state, photo, noise=0.01)
        assert least < probe.specular_explains(made.state).whole < most


@pytest.mark.parametrize("mask", [True, False])
def test_what_a_small_part_loses_is_told_apart(start, tmp_path, mask):
    """Check that a patch of surfels, a hundredth of the object's pixels or so, is not hidden by the rest, nor by what is not the object.

    The patch turns from black to white. Photos are the model's renderings, with noise that is much larger beyond the mask.
    """
    made = copied(start, tmp_path / "run")
    state = made.state
    put(made, albedo=-3.0, opacity=4.0)
    cameras = [state.photo(view).camera for view in probe.spread_views(state)]
    shares = blended_shares(state.surfels(), cameras, state.near)
    seen = shares.sum(dim=0)
    nearest = (state.learned["position"] - state.learned["position"][seen.argmax()]).norm(dim=1).argsort()
    patch = nearest[: 1 + int((seen[nearest].cumsum(dim=0) < 0.008 * seen.sum()).sum())]
    for view, photo in enumerate(state.photos):
        clean = with_rendering(state, photo, noise=0.1)
        outside = 255 * torch.rand(clean.image.shape, generator=torch.Generator().manual_seed(view))
        image = torch.where((photo.mask > 127)[..., None], clean.image, outside.byte())
        state.photos[view] = photo._replace(image=image, mask=photo.mask if mask else None)

    def whiter(inputs):
        albedo = inputs.surfels.albedo.clone()
        albedo[patch] = 1.0
        return inputs._replace(surfels=inputs.surfels._replace(albedo=albedo))

    lost = probe.psnr_loss(state, whiter)
    assert lost.part > 3 > 1 > lost.whole > 0
    assert lost.part > 5 * lost.whole
    same = probe.psnr_loss(state, lambda inputs: inputs)
    assert same == (0, 0)
    if mask:
        shown = probe.on_object(state, state.surfels(), 0)
        torch.testing.assert_close(shown, state.photo(0).mask > 127)


def test_chance_loses_nothing():
    """Check that two pictures with the same noise are equally near the photo, and so are their pixels that differ most."""
    truth = torch.full((20000, 3), 0.5)
    one, other = (
        truth + 0.05 * torch.randn(20000, 3, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1)
    )
    lost = probe.lost([(one, other, truth)])
    assert abs(lost.whole) < 0.1 and abs(lost.part) < 0.3


def test_shares_are_weights(start, tmp_path):
    """Check `blended_shares`, which sums the blending weights of each surfel over all pixels.

    The weights of all surfels add up to the sum of alpha. The weighted mean of a constant map is the constant.
    """
    made = copied(start, tmp_path / "run")
    photo, surfels = made.state.photo(0), made.state.surfels()
    alpha = made.state.render(photo.camera).alpha
    shares = blended_shares(surfels, [photo.camera], made.state.near)
    torch.testing.assert_close(shares.sum(), alpha.sum(), rtol=1e-3, atol=0)
    even = torch.full((*alpha.shape, 2), 0.3)
    mean = blended_shares(surfels, [photo.camera], made.state.near, [even])
    seen = shares[0] > 1e-3
    torch.testing.assert_close(mean[seen], torch.full_like(mean[seen], 0.3), rtol=1e-3, atol=0)


def test_seconds_saved_are_of_all_iterations_to_come(ball_capture, tmp_path, monkeypatch):
    """Check the seconds that a change saves, by a clock that goes on by a second at each look.

    The change turns it by a quarter of a second. A change that makes iterations slower saves nothing.
    """
    state, clock = trainer(ball_capture, tmp_path / "run", total=40).state, SimpleNamespace(now=0.0)

    def look():
        clock.now += 1.0
        return clock.now

    def turned(seconds):
        def change(inputs):
            clock.now += seconds
            return inputs

        return change

    monkeypatch.setattr(probe, "time", SimpleNamespace(perf_counter=look))
    left = cost(state, state.iteration, state.total)
    assert left > 0 and probe.seconds_saved(state, turned(-0.25)) == pytest.approx(0.25 * left)
    assert probe.seconds_saved(state, turned(0.25)) == 0


def test_training_does_not_load_torchs_compiler(ball_capture, tmp_path):
    """Check that training imports neither torch._dynamo (takes 2 s) nor sympy (0.5 s).

    torch imports sympy if `backward` is called with a gradient.
    """
    program = """
import sys
from pathlib import Path
from refgs.train import probe
from tests.makers.training import trainer
made = trainer(Path(sys.argv[1]), Path(sys.argv[2]), total=10)
made.run()
probe.specular_explains(made.state), probe.seconds_saved(made.state)
assert not {"sympy", "torch._dynamo"} & {*sys.modules}
"""
    subprocess.run([sys.executable, "-c", program, ball_capture, tmp_path / "run"], check=True)
