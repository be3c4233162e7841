"""Compare shadows and light that surfaces reflect onto each other with exact formulas."""

import math

import numpy as np
import pytest
import torch
import trimesh

from refgs.model import cubemap, harmonics
from refgs.model.environment import Environment
from refgs.render import brdf, relight
from refgs.render.directional import directional
from tests.makers.distances import look_at
from tests.makers.occluders import as_occluder, bowl, even, mirrors, plate, surfels


def colour(directions: torch.Tensor) -> torch.Tensor:
    """Compute the radiance (P, 3) of the environment `colourful()` in directions (P, 3)."""
    x, y, z = directions.unbind(-1)
    return torch.stack([1 + 0.5 * x, 1 + 0.8 * z, 1 - 0.6 * y * x], dim=1)


def colourful() -> Environment:
    return Environment(colour(cubemap.texel_directions(32).float()))


def test_an_open_plane_has_the_whole_light():
    """Check an unoccluded plane: it receives exactly the environment's diffuse light.

    `relit` gives its surfels a diffuse colour for each view direction. From four directions, this colour is right to 0.02.
    """
    light, up = colourful(), np.tile([0.0, 0.0, 1.0], (5, 1))
    plane = surfels(np.zeros((5, 3)), up)
    transport = relight.Transport(plane, as_occluder(plate(0.0, 1)))
    assert torch.equal(relight._gather(transport, light, 4)[0], light.diffuse(transport.normals))
    lit = relight.relit(transport, light).surfels
    for angle in (0.0, 0.5, 1.0, 1.3):
        camera = look_at([3 * math.sin(angle), 0, 3 * math.cos(angle)], 8)
        found = directional(lit.sh_dc, lit.sh_rest, 0.5, lit.positions, camera)[0]
        dielectric = brdf.look_up(torch.tensor([math.cos(angle)]), torch.tensor([0.5]))[0, 3]
        exact = (1 - dielectric) * 0.5 * light.diffuse(transport.normals)[0]
        torch.testing.assert_close(found, exact, rtol=0, atol=0.02)


def test_between_two_plates():
    """Check the light at the middle of a black plate below another: 1 minus the upper plate's form factor (Howell, B-4).

    Four times as many ray directions at least halve the error.
    """
    occluder = as_occluder(plate(0.0, 1), plate(1.0, -1))
    middle = surfels(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), albedo=0.0)
    a = 1 / (1 - occluder.lift)
    hidden = 4 / math.pi * a / math.sqrt(1 + a * a) * math.atan(a / math.sqrt(1 + a * a))
    errors = []
    for directions in (256, 1024, 4096):
        transport = relight.Transport(middle, occluder, directions)
        errors.append(float((relight._past_the_object(transport, even()) - (1 - hidden)).abs().max()))
    assert errors[0] < 0.04 and errors[1] < errors[0] / 2 and errors[2] < errors[1] / 2, errors


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.9])
def test_inside_a_matte_bowl(albedo, monkeypatch):
    """Check the light in a matte bowl. A point sees half sky, half bowl, so it receives x = 1/2 + albedo · x / 2."""
    occluder, points, normals = bowl()
    mirrors(monkeypatch, 0.0)
    found, _, _ = relight._gather(relight.Transport(surfels(points, normals, albedo), occluder), even(), 20)
    exact = 0.5 / (1 - albedo / 2)
    assert abs(float(found.mean()) / exact - 1) < 0.01
    assert float((found / exact - 1).square().mean().sqrt()) < 0.02


def test_what_training_takes_of_it(monkeypatch):
    """Check `received`: the light that a surfel receives, divided by the light that it would receive if nothing occluded it.

    It is 2/3 in a bowl of albedo 1/2, and 1 on a convex ball. The training multiplies light by this ratio. The ratio must not depend on
    whether normals point inward or outward. Its RMS error in the bowl is below 3 %, or below 5 % if only a quarter of the
    surfels trace rays.
    """
    occluder, points, normals = bowl()
    mirrors(monkeypatch, 0.0)
    inside = surfels(points, normals).turned(torch.arange(len(points)) % 2 == 0)
    assert (inside.normals() * torch.from_numpy(normals)).sum(dim=1)[::2].max() < -0.99
    for probes, error in ((10_000, 0.03), (len(points) // 4, 0.05)):
        monkeypatch.setattr(relight, "PROBES", probes)
        found = relight.received(inside, occluder, even(3.0))
        assert abs(float(found.mean()) * 1.5 - 1) < 0.01 and float((found * 1.5 - 1).square().mean().sqrt()) < error
    ball = trimesh.creation.icosphere(4)
    outside = surfels(np.asarray(ball.vertices), np.asarray(ball.vertices))
    convex = relight.received(outside, as_occluder(ball), colourful())
    assert (convex - 1).abs().max() < 0.01


@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
def test_a_white_bowl_under_an_even_sky_cannot_be_seen(part, monkeypatch):
    """Check that no light is lost: the points of a white bowl under a sky of radiance 1 receive radiance 1 from everywhere.

    `part` is the fraction of the light that the bowl mirrors; it reflects the rest diffusely.
    """
    occluder, points, normals = bowl()
    mirrors(monkeypatch, part)
    transport = relight.Transport(surfels(points, normals, 1.0), occluder)
    found, _, indirect = relight._gather(transport, even(), 20)
    torch.testing.assert_close(found, torch.ones_like(found), rtol=0, atol=0.01)
    across = torch.tensor([0.0, 0.0, -1.0]) - transport.normals * -transport.normals[:, 2:]
    ways = torch.nn.functional.normalize(transport.normals + 0.5 * across, dim=1)  # tilted towards the bowl's bottom
    seen = torch.einsum("nk,nkc->nc", harmonics.basis(ways, 3), indirect)
    torch.testing.assert_close(seen, torch.ones_like(seen), rtol=0, atol=0.03)
    face, weights = occluder.meet(points, normals, ways.double().numpy())
    met = face >= 0
    mirrored = relight.relit(transport, even(), 20).mirrored(face[met], weights[met], ways.double().numpy()[met])
    assert met.mean() > 0.3
    torch.testing.assert_close(mirrored, torch.ones_like(mirrored), rtol=0, atol=0.03)


def test_a_mirror_sends_the_light_that_it_faces(monkeypatch):
    """Check the light that a point sees in a perfect mirror above it: that of the environment below, to 0.05.

    Directions whose mirrored light is occluded are left out.
    """
    light = colourful()
    mirrors(monkeypatch, 1.0)
    below = surfels(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))._replace(roughness=torch.tensor([0.05]))
    transport = relight.Transport(below, as_occluder(plate(1.0, -1)))
    levels = cubemap.in_texel_order(light.levels, light.sides)
    first, _, _ = relight._first(transport, slice(0, len(transport.direction)), levels, light.sides)
    ways = transport.directions[transport.direction.long()] * torch.tensor([1.0, 1.0, -1.0])
    free = transport.free
    assert free.float().mean() > 0.9
    torch.testing.assert_close(first[free], colour(ways)[free], rtol=0, atol=0.05)
    directions = transport.directions[transport.direction.long()][free].double().numpy()
    start = np.zeros((len(directions), 3))
    face, weights = transport.occluder.meet(start, np.tile([0.0, 0.0, 1.0], (len(directions), 1)), directions)
    mirrored = relight.relit(transport, light).mirrored(face, weights, directions)
    torch.testing.assert_close(mirrored, colour(ways)[free], rtol=0, atol=0.01)


def test_a_light_that_the_object_hides_reaches_nothing():
    """Check that a sun hidden by a plate hardly lights the point below: it receives less than 0.1 % of what a point above does."""
    radiance = torch.full((6 * 32**2, 3), 1e-3)
    radiance[cubemap.texel_directions(32)[:, 2] > 0.99] = 100.0
    occluder = as_occluder(plate(0.0, 1), plate(1.0, -1))
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    points = surfels(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.5]]), up, albedo=0.0)
    found = relight._past_the_object(relight.Transport(points, occluder), Environment(radiance))
    assert float(found[0].max()) < 1e-3 * float(found[1].max())
    torch.testing.assert_close(found[1], Environment(radiance).diffuse(torch.tensor([[0.0, 0.0, 1.0]]))[0])
