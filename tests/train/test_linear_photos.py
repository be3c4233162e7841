"""Test training on photos with more than 8 bits: fine gradients, and light that is brighter than white."""

import json

import numpy as np
import pytest
import torch

from benchmarks.scenes import analytic
from benchmarks.scenes.analytic import F0, sky, write_ball_capture
from refgs.camera import Camera
from refgs.capture import View, load_view
from refgs.color import srgb_decode
from refgs.formats.exr import write_exr
from refgs.formats.panorama import directions
from refgs.render.renderer import Rendering
from refgs.train.keep.measures import held_out_psnr
from refgs.train.learn.losses import objective
from refgs.train.photo import Photo
from tests.makers.captures import write
from tests.makers.training import only, trained

LAMP = np.array([0.5, 0.5, 0.7]) / np.linalg.norm([0.5, 0.5, 0.7])
TOTAL = 700
EXPOSURE = 2.0**-5  # at which the lamp's photos are not clipped


def with_lamp(direction: np.ndarray) -> np.ndarray:
    """Compute the radiance of a dim sky with a lamp that is 5 times as bright as white."""
    return 0.3 * sky(direction) + 5 * np.exp(16 * (direction @ LAMP - 1))[..., None]


@pytest.mark.parametrize("bits", [8, 16])
def test_a_value_between_two_8_bit_codes_comes_into_the_loss(tmp_path, bits):
    """Check that 16-bit photos of code 100.4 pull a rendering of 100.25 up. 8-bit ones round to 100 and pull it down."""
    photo = np.full((16, 16, 3), np.rint(100.4) if bits == 8 else 100.4 * 257)
    write(tmp_path / "a.png", photo.astype(np.uint8 if bits == 8 else np.uint16))
    camera = Camera("a", 16, 16, 20, 20, 8, 8, np.eye(4))
    view = load_view(View(camera, tmp_path / "a.png", None, "train"), 8)  # through the decoding and reducing, too
    color = torch.full((8, 8, 3), 100.25 / 255, requires_grad=True)
    one = torch.ones(8, 8)
    rendering = Rendering(color, one, one, torch.zeros(8, 8, 3))
    objective(rendering, None, Photo.of(view), torch.zeros(3), only(), 1.0).loss.backward()
    assert ((color.grad < 0) if bits == 16 else (color.grad > 0)).all()


def test_light_brighter_than_white_is_recovered_from_exr(tmp_path, monkeypatch):
    """Check that a training on EXR photos of a mirror ball finds how much light comes from a lamp, which is 5 times as bright as white."""
    monkeypatch.setattr(analytic, "sky", with_lamp)
    folder = tmp_path / "capture"
    write_ball_capture(folder, 32)
    for split in ("train", "test"):
        for frame in json.loads((folder / f"transforms_{split}.json").read_text())["frames"]:
            pixels = analytic.photo(np.array(frame["transform_matrix"]), 32, stops=np.log2(EXPOSURE))
            linear, alpha = srgb_decode(pixels[..., :3]) / EXPOSURE, pixels[..., 3:]
            (folder / f"{frame['file_path']}.png").unlink()
            write_exr(folder / f"{frame['file_path']}.exr", np.dstack([linear * alpha, alpha]))
    made = trained(folder, tmp_path / "run", "surfels.metallic=0.9", "light.exposure=off", total=TOTAL)
    albedo = made.state.surfels().albedo.mean(dim=0).detach().numpy()
    towards = directions(32, 64)
    # Single texels tell little: reflections are blurred, so that the brightest one may be too bright and its neighbours too dim.
    near = np.sin((np.arange(32) + 0.5) / 32 * np.pi)[:, None] * (towards @ LAMP > np.cos(0.6))
    found, true = made.state.environment().panorama(32) * albedo, with_lamp(towards) * F0
    ratio = (found * near[..., None]).sum(axis=(0, 1)) / (true * near[..., None]).sum(axis=(0, 1))
    assert (ratio > 0.8).all() and (ratio < 1.2).all()
    assert held_out_psnr(made.state) > 28
