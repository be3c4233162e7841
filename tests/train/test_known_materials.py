"""A tiny capture of a ball in three bands, a sharp metal, a rough one and a matte dielectric: what the shading's derivatives lead to
is what the photos were made from by quadrature of the rendering equation."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.scenes.analytic import BANDS, ONE, meet, sunny, write_ball_capture
from refgs.capture import load_view, read_capture
from refgs.compare.pictures import composite
from refgs.formats.panorama import directions
from refgs.model.environment import Environment
from refgs.render.shade import shade
from tests.makers import scenes

STEPS, RESOLUTION = 500, 16


@pytest.fixture(scope="module")
def learned(tmp_path_factory) -> tuple[Tensor, Environment]:
    """Albedo, metallic and roughness of each band (3, 5), and the light. The shape is given; and the first band's roughness, for a
    sharper light on rougher materials gives nearly the same photos."""
    folder, background, views = tmp_path_factory.mktemp("bands"), torch.zeros(3), []
    write_ball_capture(folder, 48, samples=2, bands=True)
    for view in read_capture(folder).train_views:
        loaded = load_view(view, 48)
        ray = scenes.camera_rays(loaded.camera).double().numpy()
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        position = np.broadcast_to(loaded.camera.position, ray.shape).reshape(-1, 3)
        hit, point, normal = (v.reshape(*ray.shape[:2], -1) for v in meet(position, ray.reshape(-1, 3), ONE))
        below = np.cumsum([normal[..., 2] < lowest for lowest, _ in BANDS[:2]], axis=0)[-1]
        band = torch.nn.functional.one_hot(torch.from_numpy(below), 3).float()
        alpha = torch.from_numpy(hit[..., 0] & (loaded.alpha == 255)).float()
        point, normal = (torch.from_numpy(np.nan_to_num(v, posinf=0)).float() for v in (point, normal))
        views.append((loaded.camera, composite(loaded, background), alpha, band, normal, point))

    raw, light = torch.zeros(3, 5), torch.full((6 * RESOLUTION**2, 3), -1.0)
    raw[:, 4] = -0.8
    optimiser = torch.optim.Adam([raw.requires_grad_(), light.requires_grad_()], lr=0.06)
    for step, (camera, photo, alpha, band, normal, point) in enumerate(itertools.islice(itertools.cycle(views), STEPS)):
        environment = Environment(light.exp())
        with torch.no_grad():
            raw[0, 4] = math.log(0.1 / 0.9)
        features = torch.cat([normal, band @ raw.sigmoid(), point], dim=-1) * alpha[..., None]
        color = shade(features, alpha, environment, camera, background).color
        loss = ((color - photo * alpha[..., None]) ** 2).sum() / (3 * alpha.sum())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        optimiser.param_groups[0]["lr"] = 0.06 * 0.1 ** (step / STEPS)
    print("PSNR", -10 * torch.log10(loss.detach()).item())
    return raw.detach().sigmoid(), Environment(light.detach().exp())


def test_roughness_and_metallic(learned):
    materials, _ = learned
    for (_, material), found in zip(BANDS, materials.tolist(), strict=True):
        print(material, np.round(found, 3))
    _, rough, matte = materials[:, 4].tolist()
    assert rough == pytest.approx(0.5, abs=0.1) and matte > 0.5  # a dielectric shows but 4 % of its highlight
    sharp, rough, matte = materials[:, 3].tolist()
    assert min(sharp, rough) > 0.65 and matte < 0.3


def test_light_and_albedo(learned):
    """The light's shape; and its brightness times each albedo, for they share a scale."""
    materials, environment = learned
    panorama, truth = environment.panorama(32), sunny(directions(32, 64))
    print("correlation", np.corrcoef(panorama.ravel(), truth.ravel())[0, 1])
    assert np.corrcoef(panorama.ravel(), truth.ravel())[0, 1] > 0.97
    scale = panorama.mean(axis=(0, 1)) / truth.mean(axis=(0, 1))
    for (_, material), found, error in zip(BANDS, materials.numpy(), (0.06, 0.06, 0.2), strict=True):
        print(scale * found[:3] / material.base_color)
        np.testing.assert_allclose(scale * found[:3] / material.base_color, 1, atol=error)
