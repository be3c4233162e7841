"""What `refgs check` says."""

import numpy as np
import pytest
from makers import ball, colmap, edit, nerf_blender, nerfstudio, ring, write

from refgs.capture import read_capture
from refgs.capture.check import describe
from refgs.errors import InputError


def text(folder) -> str:
    return "\n".join(describe(read_capture(folder)))


def test_an_object_with_masks(tmp_path):
    said = text(nerf_blender(tmp_path, {"train": 24, "test": 4}))
    for part in (
        "NeRF-Blender",
        "28, 24 to train on, 4 to test on",
        "64×48",
        "56.1° wide, no distortion",
        "28 views (the photos' alpha), covering 11 %",
        "12 to 52° above it, 345° around it",
        "an object: the photos have masks",
    ):
        assert part in said, said
    assert "Warning" not in said


def test_distortion_points_and_a_guess(tmp_path):
    said = text(colmap(tmp_path, model=(2, "SIMPLE_RADIAL", [60.0, 32.0, 24.0, -0.1])))
    assert "COLMAP" in said and "distortion removed from 16 views" in said and "50 structure-from-motion" in said
    assert "Masks: none" in said and "a guess" in said
    assert "Warning: no masks" in said and "Warning: 14 training views are few" in said


def test_warnings_name_the_first_view(tmp_path):
    folder = nerfstudio(tmp_path, count=32)
    for i, pose in enumerate(ring(32)):
        if i != 3:
            mask = ball(pose, 64, 48, 60.0)[..., 3]
            write(folder / "masks" / f"{i:04d}.png", mask if i != 5 else np.zeros_like(mask))
    write(folder / "images" / "0007.png", np.full((48, 64, 3), 255, np.uint8))
    write(folder / "images" / "0009.png", np.full((48, 64), 50, np.uint8))
    edit(folder / "transforms.json", lambda data: data["frames"][20].update(cx=400.0))
    said = text(folder)
    for part in (
        "1 of 32 views have no mask, first 0003.png",
        "1 of 32 views have an empty mask, first 0005.png",
        "greyscale, first 0007.png",
        "clipped to white over a tenth of the subject, first 0007.png",
        "exposure varies: 0007.png",
        "1 of 32 views do not see the centre, first 0020.png",
    ):
        assert f"{part}" in said, said


def test_every_image_is_decoded(tmp_path):
    folder = nerfstudio(tmp_path)
    for name in ("0002.png", "0006.png"):
        path = folder / "images" / name
        path.write_bytes(path.read_bytes()[:120])
    with pytest.raises(InputError, match=r"2 of 16 views cannot be read, the first: .*0002\.png"):
        text(folder)
