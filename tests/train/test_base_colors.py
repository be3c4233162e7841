"""Test that base colours start at what photos show, and are kept at what photos and experience tell."""

import math

import pytest
import torch

from refgs.model import cubemap
from refgs.model.surfels import raw_metallic
from refgs.render.mirrored_light import SIDE
from refgs.train.keep import snapshot
from refgs.train.material import base_colors, metals, reckoning
from refgs.train.material.highlights import Told
from refgs.train.material.observe import neighbours
from tests.makers.pieces import ball_on_board, reckoned
from tests.makers.training import copied, do, put
from tests.makers.training import trainer as small

LEVEL, DRAW, KEEP = "level base colours", "draw metals' base colours", "keep shades of base colours"


def ball(by_object):
    """Return what was reckoned of a metal ball on paint, whose surfels `by_object` (N,) reflect 0.8 of the object; and the metals (N,)."""
    points, normals, metal = ball_on_board()
    found = reckoned(points, normals, metal.float(), metal.float(), True)
    which = metal & by_object(torch.arange(len(metal)))
    return found._replace(by_object=which, reflected=torch.where(which[:, None], 0.8, 0.1).expand(-1, 3)), metal


@pytest.fixture(scope="module")
def start(large_ball, tmp_path_factory):
    """Make a small training. Tests copy it."""
    return small(large_ball, tmp_path_factory.mktemp("runs") / "start", total=400)


def metal_and_paint(folder, start, albedo, every=3):
    """Copy a small training with surfels of `albedo` (N, 3) or (3,). Photos are sure that one in `every` is paint, the others metal."""
    made = copied(start, folder)
    count = made.state.learned.count
    metal = torch.arange(count) % every > 0
    put(made, albedo=albedo.logit(), metallic=torch.where(metal, raw_metallic(0.98), raw_metallic(0.02)), told=True)
    made.state.part(metals.Metals).found = True
    made.state.told_light = torch.zeros(6 * SIDE**2, dtype=torch.bool)
    return made.state, metal


def told_by(found, metal):
    """Return what photos tell of base colours of `metal` (N,), if all surfels that mirror the object do in all photos."""
    return base_colors.told(found._replace(met=found.by_object[:, None].expand_as(found.met)), metal)


def test_a_few_surfels_that_mirror_the_object_tell_of_their_piece():
    found, metal = ball(lambda i: i % 10 == 0)
    told = told_by(found, metal)
    assert torch.allclose(told[metal, :3], torch.tensor(0.8), atol=1e-3) and bool((told[metal, 3] > 0.1).all())
    assert float(told[~metal, 3].median()) < 0.1, "the board is another piece"


def test_wrong_normals_do_not_darken_what_metals_tell():
    """Check a metal of 0.8 some of whose surfels mirror bright points, where their rays meet dark ones, and some the other way round."""
    found, metal = ball(lambda i: i >= 0)
    bright = torch.where(torch.rand(len(metal), 2, generator=torch.Generator().manual_seed(0)) < 0.5, 0.1, 1.0)
    reflected, white = (each[:, None].expand(-1, 3) for each in (0.8 * bright[:, 0], bright[:, 1]))
    told = told_by(found._replace(reflected=reflected, white=white), metal)
    assert torch.allclose(told[metal, :3], torch.tensor(0.8), atol=0.15)
    assert float(told[metal, :3].mean()) == pytest.approx(0.8, abs=0.03)


def test_mirrors_tell_the_light_that_they_face():
    """Check a ball whose camera sees each surfel from the front: it tells the light in all directions, or above, if it mirrors the rest."""
    found, metal = ball(lambda i: i >= 0)
    above = cubemap.texel_directions(SIDE)[:, 2]
    told = base_colors.told_light(found, metal)
    assert float(told[above > -0.8].float().mean()) > 0.85 and not told[above < -0.98].any()
    few = metal & (torch.arange(len(metal)) % 60 == 0)
    assert base_colors.told_light(found, metal & False) is base_colors.told_light(found, few) is None, "paint tells it"
    told = base_colors.told_light(found._replace(met=(found.seen.normal[..., 2] < 0)), metal)
    assert not told[above < -0.1].any() and float(told[above > 0.1].float().mean()) > 0.85


def highlights(found, light, own):
    """Return `found` as 12 photos show it: of base colour `own` (N, 3), with highlights, in a light of colours `light` (N, 3)."""
    points = found.surfels.positions
    gloss = 0.1 * torch.rand(len(points) // 50 + 1, 12, 1, generator=torch.Generator().manual_seed(0))
    radiance = light[:, None] * (0.3 * own[:, None] + gloss[torch.arange(len(points)) // 50])
    seen = found.seen._replace(radiance=radiance, weight=torch.full(radiance.shape[:2], 9.0))
    return found._replace(changes=reckoning.mean_and_changes(seen, neighbours(points, 16))[1])


def test_highlights_of_paint_tell_the_hue_of_the_light():
    """Check red paint in a bluish light, of which metals tell nothing. The hue is trusted against grey as the scatter of hues tells."""
    found, metal = ball(lambda i: i >= 0)
    light, own = torch.tensor([0.85, 1.0, 1.15]), torch.tensor([0.8, 0.3, 0.1])
    trusted = base_colors.HUES**2 / (base_colors.HUES**2 + base_colors.PARTS_HUES**2)
    expected = trusted * (light.log() - light.log().mean())
    found = highlights(found, torch.where(metal[:, None], light.flip(0), light), own.expand(len(metal), 3))
    assert torch.allclose(base_colors.told_hue(found, ~metal), expected, atol=0.01)
    assert not base_colors.told_hue(found, metal & False).any()


def test_paint_whose_highlights_have_many_colours_tells_no_hue():
    found, metal = ball(lambda i: i >= 0)
    across = found.surfels.positions[:, :1]
    light = (torch.tensor([0.3, 0.1, -0.4]) * (1 + 2 * across)).exp()
    hue = base_colors.told_hue(highlights(found, light, torch.ones(len(metal), 3)), ~metal)
    assert float(hue.abs().max()) < 0.1 and float(hue.sum()) == pytest.approx(0, abs=1e-6)


def test_metals_that_mirror_no_object_are_left_alone():
    for few in (lambda i: i < 0, lambda i: i % 100 == 0):
        assert not told_by(*ball(few)).any()


@pytest.mark.parametrize("one_in", [30, 100, 300])
def test_metal_that_mirrors_little_of_the_object_is_as_bright_as_most_metals(one_in):
    """Check a ball all of which mirrors the object, beside one of which a hundredth does, as a car's bumper. Both seem to be dark."""
    points, normals, metal = ball_on_board()
    count = len(points)
    apart = torch.tensor([10.0, 0, 0])
    points, normals, metal = torch.cat([points, points + apart]), normals.repeat(2, 1), metal.repeat(2)
    found = reckoned(points, normals, metal.float(), metal.float(), True)
    index = torch.arange(2 * count)
    mirrors = metal & (index % torch.where(index < count, 1, one_in) == 0)
    reflected = torch.full((2 * count, 3), 0.2)
    told = told_by(found._replace(by_object=mirrors, reflected=reflected, white=torch.ones_like(reflected)), metal)
    much, little = told[:count][metal[:count]], told[count:][metal[count:]]
    assert torch.allclose(much, torch.tensor([0.2, 0.2, 0.2, 1.0]), atol=0.01)
    if one_in == 30:
        assert bool((little[:, 0] > 0.3).all() and (little[:, 3] < 0.7).all())
    elif one_in == 100:
        assert bool((little[:, 0] > 0.75).all() and (little[:, 3] < 0.1).all())
    else:
        assert not little.any()


def test_metals_are_drawn_to_what_they_show(start, tmp_path):
    shade = 0.1 + 0.2 * torch.rand(10**4, 3, generator=torch.Generator().manual_seed(0))
    count = start.state.learned.count
    state, metal = metal_and_paint(tmp_path / "run", start, shade[:count])
    unknown = metal & (torch.arange(count) % 2 > 0)
    state.learned["shown_color"].data.copy_(torch.tensor([0.9, 0.6, 0.3, 1.0]) * ~unknown[:, None])
    for _ in range(40):
        do(state, DRAW, 0.3, done=120)
    now = state.surfels().albedo.detach()
    assert torch.allclose(now[metal & ~unknown], torch.tensor([0.9, 0.6, 0.3]), atol=1e-3)
    assert torch.allclose(now[unknown], shade[:count][unknown], atol=1e-5), "photos tell nothing of these"

    snapshot.save(state)
    again = copied(start, tmp_path / "again").state
    snapshot.restore(again, state.folder)
    assert torch.equal(again.learned["shown_color"], state.learned["shown_color"])


def test_paint_is_left_alone_where_metals_do_not_tell_the_light(start, tmp_path):
    shade = 0.1 + 0.2 * torch.rand(start.state.learned.count, 3, generator=torch.Generator().manual_seed(0))
    state, metal = metal_and_paint(tmp_path / "run", start, shade)
    state.told_light = None
    state.learned["shown_color"].data.copy_(torch.tensor([0.9, 0.6, 0.3, 1.0]) * metal[:, None])
    light = state.learned["environment"].detach().clone()
    for _ in range(40):
        for row in LEVEL, DRAW, "average paint's base colours":
            do(state, row, 0.3, done=120)
    do(state, KEEP, 0.7, done=280)
    now = state.surfels().albedo.detach()
    assert torch.allclose(now[metal], torch.tensor([0.9, 0.6, 0.3]), atol=1e-3), "that needs no light"
    assert torch.allclose(now[~metal], shade[~metal], atol=1e-5)
    assert torch.equal(state.learned["environment"], light)


def test_later_metals_keep_their_level_and_learn_patterns(start, tmp_path):
    state, metal = metal_and_paint(tmp_path / "run", start, torch.tensor([0.3, 0.3, 0.3]))
    pattern = torch.where(torch.arange(len(metal)) % 2 > 0, 0.2, 0.4)[:, None].expand(-1, 3)
    state.learned["albedo"].data.copy_(pattern.logit())
    state.learned["shown_color"].data.copy_(torch.tensor([0.6, 0.6, 0.6, 1.0]).expand(len(metal), 4))
    light = state.learned["environment"].detach().clone()
    for _ in range(10):
        do(state, LEVEL, 0.8, done=320)
    now = state.surfels().albedo.detach()
    ratio = now[metal] / pattern[metal]
    assert torch.allclose(ratio, ratio.mean().expand_as(ratio), rtol=1e-3) and float(now[metal].log().mean().exp()) == (
        pytest.approx(0.6, rel=0.01)
    )
    assert torch.allclose(now[~metal], pattern[~metal], atol=1e-5) and torch.equal(state.learned["environment"], light)


def test_shades_of_paint_are_averaged_but_not_its_pattern_nor_metal(start, tmp_path):
    state, metal = metal_and_paint(tmp_path / "run", start, torch.tensor([0.3, 0.3, 0.3]), every=2)
    chance = torch.rand(len(metal), 2, generator=torch.Generator().manual_seed(0)) < 0.5
    shade, white = torch.where(chance[:, :1], 0.8, 1.0), chance[:, 1] & ~metal
    speckled = shade * torch.where(white[:, None], torch.tensor([0.8, 0.8, 0.8]), torch.tensor([0.05, 0.1, 0.3]))
    state.learned["albedo"].data.copy_(torch.where(metal[:, None], 0.9, speckled).logit())
    do(state, "average paint's base colours", 0.3, done=120)
    now = state.surfels().albedo.detach()
    assert torch.allclose(now[metal], torch.tensor(0.9), atol=1e-4)
    for pattern in white, ~white & ~metal:
        left, was = now[pattern] / speckled[pattern].mean(dim=0), speckled[pattern] / speckled[pattern].mean(dim=0)
        assert float(left.log().std()) < 0.5 * float(was.log().std())
        assert torch.allclose(left.mean(dim=0), torch.ones(3), atol=0.05), "it takes no colour of the other"


def test_later_shades_of_paint_are_kept_and_patterns_learn(start, tmp_path):
    """Check paint that has become darker on one side, brighter as a whole, and speckled, since its shades were first kept."""
    state, metal = metal_and_paint(tmp_path / "run", start, torch.tensor([0.3, 0.3, 0.3]), every=2)
    do(state, KEEP, 0.7, done=280)
    side = state.learned["position"].detach()[:, 0]
    side = (side - side.mean()) / side.std()
    speckle = torch.where(torch.rand(len(metal), generator=torch.Generator().manual_seed(0)) < 0.5, -0.2, 0.2)
    shaded = (0.3 * (0.3 * side + speckle + 0.2).exp())[:, None].expand(-1, 3)
    state.learned["albedo"].data.copy_(torch.where(metal[:, None], 0.9, shaded).logit())
    do(state, KEEP, 0.7, done=288)
    now = (state.surfels().albedo.detach()[:, 0] / 0.3).log()[~metal]
    side, speckle = side[~metal], speckle[~metal]
    assert abs(float((now * side).mean() / side.square().mean())) < 0.1, "of 0.3"
    assert float((now * speckle).mean() / speckle.square().mean()) > 0.8
    assert float(now.mean()) == pytest.approx(0.2, abs=0.05)
    assert torch.allclose(state.surfels().albedo.detach()[metal], torch.tensor(0.9), atol=1e-4), (
        "nothing is known of it"
    )


def test_later_shades_of_metals_are_what_they_show(start, tmp_path):
    state, metal = metal_and_paint(tmp_path / "run", start, torch.tensor([0.3, 0.3, 0.3]))
    state.learned["shown_color"].data.copy_(torch.tensor([0.9, 0.6, 0.3, 1.0]) * metal[:, None])
    do(state, KEEP, 0.7, done=280)
    now = state.surfels().albedo.detach()
    assert torch.allclose(now[metal], torch.tensor([0.9, 0.6, 0.3]), atol=1e-3)
    assert torch.allclose(now[~metal], torch.tensor(0.3), atol=1e-4)


def test_white_paint_under_dim_lamps_is_darker_under_brighter_lamps(start, tmp_path):
    """Check that paint's base colour times the light's power is kept, in each channel, and that dark walls are left as they are."""
    state, metal = metal_and_paint(tmp_path / "run", start, torch.tensor([0.9, 0.8, 0.7]), every=2)
    light = state.learned["environment"]
    lamps = torch.arange(len(light)) < len(light) // 20
    light.data.copy_(torch.where(lamps[:, None], torch.tensor([8.0, 4.0, 3.0]), 0.1).log())
    area = cubemap.texel_solid_angles(state.environment().resolution).view(-1, 1)

    def power():
        return (light.detach().exp() * area).sum(dim=0)

    before, colour = power(), state.surfels().albedo.detach()[~metal].mean(dim=0)
    state.part(metals.Metals).mean = torch.tensor(0.35).log()
    for _ in range(60):
        do(state, LEVEL, 0.3, done=120)
    now = state.surfels().albedo.detach()[~metal].mean(dim=0)
    assert torch.allclose(now * power(), colour * before, rtol=1e-3)
    assert torch.allclose(light.detach()[~lamps].exp(), torch.tensor(0.1))
    assert float(now.max()) == pytest.approx(0.35, abs=0.02)
    assert power().std() / power().mean() < before.std() / before.mean(), "the light is greyer"


def test_highlights_outweigh_what_paint_usually_is(start, tmp_path):
    """Check to which mean grey paint of 0.6 is drawn: downward by experience alone, and as highlights tell, the more they are sure."""
    state, metal = metal_and_paint(tmp_path / "run", start, torch.tensor([0.6, 0.6, 0.6]))

    def wanted(told, before=None):
        return float(base_colors.wanted(state, ~metal, told, before).exp())

    assert base_colors.PAINT < wanted(None) < 0.6
    brighter, darker = Told(-0.2, 0.02), Told(0.2, 0.02)
    assert wanted(darker) < 0.6 < wanted(brighter)
    assert wanted(Told(-0.2, 1e6)) == pytest.approx(wanted(None), rel=1e-3)
    lower = torch.tensor(0.5).log()
    assert wanted(darker, lower) < 0.5, "photos have drawn it back"
    assert wanted(Told(3.0, 0.02), lower) == pytest.approx(0.6 * math.exp(-base_colors.FARTHEST), rel=1e-3)
    assert wanted(Told(3.0, 0.02), torch.tensor(0.36).log()) >= base_colors.PAINT - 1e-6, "paint is seldom so dark"
    state.learned["albedo"].data.fill_(-2.2)
    assert wanted(None) == wanted(darker) == pytest.approx(0.1, rel=0.01), "dark paint is left alone"


def test_a_light_without_lamps_is_kept(start, tmp_path):
    state, metal = metal_and_paint(tmp_path / "run", start, torch.tensor([0.9, 0.8, 0.7]))
    light = state.learned["environment"].detach().fill_(-1.0).clone()
    do(state, LEVEL, 0.3, done=120)
    assert torch.equal(state.learned["environment"], light)
    assert torch.allclose(state.surfels().albedo[~metal], torch.tensor([0.9, 0.8, 0.7]), atol=1e-5)


def test_base_colours_stay_below_one(start, tmp_path):
    made = copied(start, tmp_path / "run")
    state = made.state
    put(made, albedo=torch.tensor([20.0, 0.0, -40.0]), metallic=raw_metallic(0.98), told=True)
    metal = torch.ones(state.learned.count, dtype=torch.bool)
    state.learned["shown_color"].data.fill_(1.0)
    base_colors.level(state, metal)
    base_colors.balance(state, ~metal, torch.zeros(3), torch.tensor(0.3).log())
    base_colors.draw(state, metal)
    assert bool(state.learned["albedo"].isfinite().all()) and float(state.surfels().albedo.detach().max()) <= 0.981


def test_base_colours_start_at_what_photos_show(start, tmp_path):
    """Check that the start's picture, lit by the start's light, is about the photos' mean."""
    state = copied(start, tmp_path / "run").state
    light = state.environment().radiance.mean(dim=0)
    shown = torch.stack(
        [(p.linear * (p.mask[..., None] > 127)).sum(dim=(0, 1)) / (p.mask > 127).sum() for p in state.photos]
    )
    expected = (shown.mean(dim=0) / light).clamp(0.02, 0.98)
    assert torch.allclose(state.surfels().albedo.detach().mean(dim=0), expected, rtol=0.25)
    assert float(state.surfels().albedo.detach().std(dim=0).max()) > 0.01, "not one grey"
