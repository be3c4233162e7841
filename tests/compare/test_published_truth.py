"""Test the ground truth of TensoIR-Synthetic and Stanford-ORB against the ball that their files describe."""

import numpy as np
import pytest

from refgs.capture import load_view, read_capture
from refgs.capture.poses import split_similarity
from refgs.color import srgb_decode
from refgs.compare.published import published_truth
from refgs.errors import InputError
from refgs.formats.panorama import sample
from refgs.settings import load_settings
from tests.makers.captures import CENTRE, RADIUS, ball, ball_normals, nerf_blender, ring, stanford_orb, tensoir

POSES = ring(4)


def truth_of(folder):
    """Read a capture in a frame that is turned by its up direction, and its ground truth."""
    capture = read_capture(folder, load_settings("quick", ["region.up=[0.3, -0.2, 0.9]"]).region)
    return capture, published_truth(capture, capture.to_capture)


def assert_normals(found, pose, turn, side):
    """Assert that normals are the ball's. `turn` (3, 3) rotates directions of the run to those of the capture."""
    true = ball_normals(pose, side, side, 60.0 / 64 * side)
    inside = np.isfinite(true[..., 0]) & (np.linalg.norm(found, axis=-1) > 0.9)
    assert inside.sum() > 60
    cosine = ((found @ turn.T) * true).sum(-1)[inside]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < (2 if side == 64 else 8)


@pytest.mark.parametrize("side", [64, 32])
def test_maps_of_tensoir(tmp_path, side):
    capture, truth = truth_of(tensoir(tmp_path / "synthetic" / "ball"))
    for view, pose in zip(capture.test_views, POSES, strict=True):
        known, alpha = truth.maps(view.camera.fitted(side))
        assert_normals(known["normal"], pose, split_similarity(capture.to_capture)[1], side)
        np.testing.assert_allclose(alpha * 255, load_view(view, side).alpha, atol=0.51)
        red = known["albedo"][alpha > 0.99][:, 0]
        assert red.max() == pytest.approx(110 / 255, abs=1e-5), "base colour is stored linear"


def test_pictures_of_tensoir_under_another_light(tmp_path):
    capture, truth = truth_of(tensoir(tmp_path / "synthetic" / "ball"))
    assert truth.hdris == ["bridge"], "the others have neither panoramas nor pictures"
    np.testing.assert_allclose(truth.panorama("relight/bridge"), 0.5, atol=0.01)
    for view, pose in zip(capture.test_views, POSES, strict=True):
        pixels, image = truth.relit("bridge", view.camera), ball(pose, 64, 64, 60.0)
        expected = srgb_decode(image[..., :3] // 3 * 2 / 255)
        np.testing.assert_allclose(pixels, np.dstack([expected, image[..., 3] / 255]), atol=1e-6)


@pytest.mark.parametrize("side", [64, 32])
def test_maps_of_stanford_orb(tmp_path, side):
    """Check normals in the run's frame, depth and base colour. The run's frame is turned, moved and scaled against the capture's."""
    capture, truth = truth_of(stanford_orb(tmp_path))
    scale, turn, _ = split_similarity(capture.to_capture)
    assert scale < 0.9
    for view, pose in zip(capture.test_views, POSES, strict=True):
        camera = view.camera.fitted(side)
        known, alpha = truth.maps(camera)
        assert_normals(known["normal"], pose, turn, side)
        depth, middle = truth.depth(camera), side // 2
        assert depth[middle, middle] == pytest.approx(3 - RADIUS, abs=0.02), (
            "the cameras are 3 units from the ball's centre"
        )
        green = known["albedo"][alpha > 0.99][:, 1].max()
        assert green == pytest.approx(srgb_decode(np.float64(100 / 255)), abs=1e-4), (
            "base colour is stored sRGB-encoded"
        )


def test_lights_of_stanford_orb_turn_with_the_camera(tmp_path):
    """Check that the light is seen in the run's frame where the camera's axes say that it is."""
    capture, truth = truth_of(stanford_orb(tmp_path))
    views = truth.novel_views()
    assert len(views) == 4
    for view, pose in zip(views, POSES, strict=True):
        panorama = truth.light(view)
        in_capture = (
            pose[:3, :3] @ np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0], [0, 0, 1]]).T
        )  # forward, left, up, back
        in_run = split_similarity(capture.to_capture)[1].T @ in_capture
        radiance = sample(panorama, in_run.T)[:, 0]
        np.testing.assert_allclose(radiance, [3, 1, 0.5, 0.2], rtol=0.02)
        towards = (view.camera.world_to_camera @ np.linalg.inv(capture.to_capture) @ np.append(CENTRE, 1))[:3]
        np.testing.assert_allclose(towards / np.linalg.norm(towards), [0, 0, 1], atol=1e-6)


def test_other_captures_have_no_published_truth(tmp_path):
    assert truth_of(nerf_blender(tmp_path / "a"))[1] is None
    folder = stanford_orb(tmp_path)
    (tmp_path / "ground_truth").rename(tmp_path / "elsewhere")
    assert truth_of(folder)[1] is None


def test_a_missing_or_wrong_file_is_one_line(tmp_path):
    capture, truth = truth_of(tensoir(tmp_path / "synthetic" / "ball"))
    camera = capture.test_views[1].camera
    (truth.folder / "test_001" / "normal.png").unlink()
    with pytest.raises(InputError, match=r"test_001/normal.png: the image is missing"):
        truth.maps(camera)
    capture, truth = truth_of(stanford_orb(tmp_path))
    camera = capture.test_views[1].camera
    file = tmp_path / "ground_truth" / "ball_scene001" / "surface_normal" / "0001.npy"
    np.save(file, np.zeros(5))
    with pytest.raises(InputError, match=r"0001.npy: an array of \(5,\)"):
        truth.maps(camera)
    file.write_bytes(b"normals")
    with pytest.raises(InputError, match=r"0001.npy: not an array of NumPy"):
        truth.maps(camera)
    file.unlink()
    with pytest.raises(InputError, match=r"0001.npy is missing"):
        truth.maps(camera)
