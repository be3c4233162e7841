"""Write videos."""

from pathlib import Path

import av
import numpy as np
from scipy.ndimage import map_coordinates

from tests.makers.captures import CENTRE, ball_normals, ring


def write_video(
    path, frames, codec="libx264", pixels="yuv420p", options=None, matrix=None, x264="", **properties
) -> None:
    """Write frames (H, W, 3) uint8 as a video of 30 frames a second. `properties` are the codec's, such as color_trc.

    `matrix` is that from RGB to YUV, by default the one that `properties` name as `colorspace`; `x264` are the encoder's parameters.
    """
    with av.open(str(path), "w", options=options or {}) as container:
        options = {"crf": "12", "preset": "ultrafast", "x265-params": "log-level=none", "x264-params": x264}
        stream = container.add_stream(codec, rate=30, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        for name, value in properties.items():
            setattr(stream.codec_context, name, value)
        for number, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame = frame.reformat(
                format=pixels,
                dst_colorspace=matrix or properties.get("colorspace"),
                dst_color_range=properties.get("color_range"),
            )
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def speckled_ball(pose: np.ndarray, width: int = 320, height: int = 240) -> tuple[np.ndarray, np.ndarray]:
    """Render a red ball on a blue floor, both with random speckles. Returns the picture (H, W, 3) uint8, and where the ball is (H, W).

    `pose` is the camera-to-world matrix. The focal length is 1.1 times the width.
    """
    focal, lattice = 1.1 * width, np.random.default_rng(0).random((32, 32, 32))
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    local = np.stack([u / focal, -v / focal, -np.ones_like(u)], axis=-1)
    normals = ball_normals(pose, width, height, focal)
    ball, rays = np.isfinite(normals[..., 0]), local @ pose[:3, :3].T
    depth = (CENTRE[2] - 0.5 - pose[2, 3]) / np.minimum(rays[..., 2], -1e-3)
    points = np.where(ball[..., None], CENTRE + 0.5 * normals, pose[:3, 3] + rays * depth[..., None])
    grains = sum(
        map_coordinates(lattice, size * points.transpose(2, 0, 1) + 3 * size, order=1, mode="wrap")
        for size in (5.0, 17.0)
    )
    colors = np.where(ball[..., None], [110, 40, 30], [30, 50, 110])
    return (grains[..., None] * colors).astype(np.uint8), ball


def film_ball(path: Path, count: int = 48, width: int = 320, height: int = 240) -> None:
    """Write a video of one round about the ball of `speckled_ball`."""
    poses = ring(2 * count, distance=3.5)[::2]  # those at the same height
    write_video(path, [speckled_ball(pose, width, height)[0] for pose in poses])
