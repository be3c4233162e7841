"""Write videos."""

import av
import numpy as np


def write_video(path, frames, codec="libx264", pixels="yuv420p", options=None, **color) -> None:
    """Write frames (H, W, 3) uint8 as a video of 30 frames a second. `color` are properties of the codec, such as color_trc."""
    with av.open(str(path), "w", options=options or {}) as container:
        options = {"crf": "12", "preset": "ultrafast", "x265-params": "log-level=none"}
        stream = container.add_stream(codec, rate=30, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        for name, value in color.items():
            setattr(stream.codec_context, name, value)
        for number, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame = frame.reformat(format=pixels, dst_colorspace=color.get("colorspace"))
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
