"""Write captures without masks: photos of a ball before a mottled ground, and their true masks. Compare masks with these."""

import numpy as np
from PIL import Image

from tests.makers.captures import CENTRE, ball, edit, nerfstudio, ring, write

SIZE, FOCAL, COUNT = (96, 72), 110.0, 10
ASIDE = CENTRE + np.array([0.0, 1.1, 0.0])


def colored(shown, random):
    """Put RGBA pixels before a mottled blue ground. Return the RGB photo."""
    ground = np.array([60, 70, 150]) + random.normal(0, 12, (*shown.shape[:2], 3))
    photo = np.where(shown[..., 3:] > 0, shown[..., :3] + random.normal(0, 8, ground.shape), ground)
    return np.clip(photo, 0, 255).astype(np.uint8)


def photograph(folder, beside=False, poses=None, show=ball):
    """Write photos of a ball before a mottled blue ground. With `beside`, a second ball lies beside it. Return the true masks.

    `show(pose, width, height, focal)` renders another object as RGBA.
    """
    random = np.random.default_rng(0)
    poses, truths = poses or ring(COUNT), []
    nerfstudio(folder, poses=poses)
    for i, pose in enumerate(poses):
        shown = show(pose, *SIZE, FOCAL)
        if beside:
            other = ball(pose, *SIZE, FOCAL, ASIDE)
            shown = np.where(shown[..., 3:] > 0, shown, other)
        write(folder / "images" / f"{i:04d}.png", colored(shown, random))
        truths.append(shown[..., 3] > 0)
    intrinsics = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1]}
    edit(folder / "transforms.json", lambda data: data.update(intrinsics))
    return truths


def read_masks(folder, count=COUNT):
    """Read the masks of a capture's photos, bool (H, W) each."""
    return [np.asarray(Image.open(folder / "masks" / f"{i:04d}.png")) > 127 for i in range(count)]


def overlap(ours, truths):
    """Return the intersection over union of each mask."""
    return [(a & b).sum() / (a | b).sum() for a, b in zip(ours, truths, strict=True)]
