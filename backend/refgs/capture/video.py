"""Choose photos from a video: the sharpest frame of each stretch of time, where the camera moved."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.reformatter import ColorPrimaries, ColorTrc, VideoReformatter
from PIL import Image

from refgs.errors import InputError
from refgs.paths import disk_errors_named

SIDE = 800  # pixels on the longer side of the grey pictures that are measured; `standard` trains on as many
FLOW_SIDE = 400  # pixels on the longer side of the pictures between which movement is measured
BLURRED = 0.4  # part of the neighbours' median sharpness; motion blur over 7 pixels of 800 is below it
FORMLESS = 0.04  # sharpness of edges that are blurred by 3 pixels of 800 (standard deviation), and of fine texture blurred by 4
OFF_CENTRE = 0.1  # part of the sharpness taken off at a stretch's ends, so that equally sharp photos are evenly spaced
MOVED = 0.005  # part of the picture's longer side. Between neighbours of 100 photos around an object it is 0.02 or more
MIN_PHOTOS = 3  # `find_cameras` needs as many
WHOLE = 0.95  # part of the length in the header that must be there, else the file is truncated; the last frame may stay for long
HDR = (ColorTrc.ARIB_STD_B67, ColorTrc.SMPTE2084)  # HLG and PQ
REFILM = "Film for 20 to 60 seconds, walking slowly around the object"


@dataclass(eq=False)
class _Candidate:
    """Hold the sharpest frame of a stretch: its sharpness, a small grey picture (h, w) uint8, and the JPEG file it is written to."""

    sharpness: float
    grey: np.ndarray
    file: Path


def extract_photos(
    video: Path, out: Path, count: int, report: Callable[[str, dict[str, Any]], None] = lambda *_: None
) -> dict[str, int]:
    """Choose up to `count` frames of a video and write them to `out`/images as JPEG files frame_0001.jpg, frame_0002.jpg …

    The video's time is divided into `count` equal stretches. The sharpest frame of each stretch is taken. It is left out if it is blurred
    compared with the frames of the neighbouring stretches, or if the camera has not moved since the last photo. Photos are upright, as
    players show the video. HDR is converted to sRGB.

    Memory holds one full-size frame, and a small grey picture for each stretch. `report("progress", facts)` is called after each frame. The
    facts are counts: `done` frames of `total` are read, and of the stretches read so far, `kept` are kept and `blurred` are blurred.
    Returns the counts `frames`, `photos`, `blurred` and `duplicates`.

    Raises InputError, and leaves nothing behind, if `out`/images exists, if the file is not a video or is truncated, or if fewer than three
    photos remain.
    """
    video, out = Path(video), Path(out)
    images, work = out / "images", out / "images.tmp"
    if images.exists():
        raise InputError(f"{images} exists: name another folder, or remove it")
    if not video.is_file():
        raise InputError(f"{video}: there is no such file. Name a video, such as .mp4 or .mov.")
    new = not out.exists()
    with _opened(video) as container:
        try:
            out.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir()
        except OSError as error:
            raise InputError(f"{out}: no folder can be made there ({error.strerror}). Name another one.") from error
        try:
            with disk_errors_named([work], "run the command again"):
                frames, candidates = _sharpest(video, container, work, count, report)
                kept, blurred, duplicates = _choose(video, frames, candidates)
                for number, candidate in enumerate(kept, 1):
                    candidate.file.rename(work / f"frame_{number:04d}.jpg")
                for path in work.glob("stretch_*"):
                    path.unlink()
                work.rename(images)
        finally:
            shutil.rmtree(work, ignore_errors=True)
            if new and out.is_dir() and not any(out.iterdir()):
                out.rmdir()
    return {"frames": frames, "photos": len(kept), "blurred": blurred, "duplicates": duplicates}


def sharpness(grey: np.ndarray) -> float:
    """Measure how sharp a grey picture (h, w) is. The result is 0 for a uniform picture and does not depend on contrast.

    The measure is the sum of squared second derivatives divided by the sum of squared first derivatives. The direction with the smallest
    ratio counts, because motion blurs in one direction only. A sharp texture (power spectrum 1/f²) gives 0.4. Blurred with a standard
    deviation of 1, 2 or 3 pixels, it gives 0.26, 0.13 or 0.07. Sharp edges give half as much as sharp texture.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)  # else a dark frame's noise counts as sharp detail
    across, down = _gradient(smooth)
    xx, xy = _gradient(across)
    yy = _gradient(down)[1]
    first, second = _products(across, down), _products(xx, xy, yy)
    least = np.inf
    for angle in np.radians([0, 45, 90, 135]):
        c, s = np.cos(angle), np.sin(angle)
        along, twice = np.array([c, s]), np.array([c * c, 2 * c * s, s * s])  # derivatives in this direction
        energy = along @ first @ along
        least = min(least, float(twice @ second @ twice / energy) if energy > 0 else 0.0)
    return least


def movement(before: np.ndarray, after: np.ndarray) -> float:
    """Measure how far the picture moved between two grey pictures (h, w) uint8, as a fraction of the longer side.

    Corners are tracked by the method of Lucas and Kanade. The result is the distance that 90 % of the corners do not exceed. So the motion
    of an object on a turntable counts, even though its surroundings stand still. The result is infinite if the picture has no corners, or
    if a tenth of them is lost.
    """
    corners = cv2.goodFeaturesToTrack(before, 400, 0.01, 5)
    if corners is None:
        return np.inf
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    distance = np.linalg.norm(tracked - corners, axis=-1).ravel()
    distance[found.ravel() == 0] = np.inf
    return float(np.quantile(distance, 0.9, method="higher")) / max(before.shape)


def _gradient(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives along x and along y, by central differences."""
    across, down = (cv2.Sobel(picture, cv2.CV_32F, *axis, ksize=1, scale=0.5) for axis in ((1, 0), (0, 1)))
    return across, down


def _products(*pictures: np.ndarray) -> np.ndarray:
    """Return the scalar products of every two pictures, as a matrix M. A weighted sum of the pictures has the sum of squares w·M·w."""
    return np.array([[np.vdot(one, other) for other in pictures] for one in pictures], np.float64)


def _opened(video: Path) -> InputContainer:
    """Open a video file. Raise InputError if it is not a video, or if its header is missing because it is truncated."""
    try:
        container = av.open(str(video), metadata_errors="replace")
    except (FFmpegError, OSError) as error:
        why = error.strerror or type(error).__name__
        raise InputError(
            f"{video}: this is not a video that can be read ({why}). Copy it from the phone again, or save it as MP4."
        ) from error
    if not container.streams.video or _length(container) <= 0:
        container.close()
        raise InputError(f"{video}: there is no film in it. Name a video, such as .mp4 or .mov.")
    return container


def _length(container: InputContainer) -> float:
    """Return the length of a video in seconds, 0 if the file does not say it."""
    stream = container.streams.video[0]
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    return (container.duration or 0) / av.time_base


def _frames(video: Path, container: InputContainer) -> Iterator[tuple[float, av.VideoFrame]]:
    """Decode a video. Yield each frame with its time in seconds, from 0. Raise InputError where it is broken or truncated."""
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    length = _length(container)
    start, time, step = None, 0.0, float(1 / stream.average_rate) if stream.average_rate else 0.0
    again = "Copy it from the phone again, or save it as MP4."
    try:
        for frame in container.decode(stream):
            if frame.time is None:
                continue
            start = frame.time if start is None else start
            time = frame.time - start
            yield time, frame
    except FFmpegError as error:
        why = error.strerror or type(error).__name__
        raise InputError(f"{video}: it is broken after {time:.1f} seconds ({why}). {again}") from error
    if start is None:
        raise InputError(f"{video}: there are no frames in it. {again}")
    if time + step < WHOLE * length:
        raise InputError(f"{video}: it is truncated, {time:.1f} of {length:.1f} seconds are there. {again}")


def _sharpest(
    video: Path, container: InputContainer, work: Path, count: int, report: Callable
) -> tuple[int, list[_Candidate]]:
    """Find the sharpest frame of each of `count` stretches, and write it to the folder `work`. Stretches without frames are skipped.

    Returns how many frames were read, and the candidates in the order of time.
    """
    length = _length(container)
    rate = float(container.streams.video[0].average_rate or 0)
    frames, candidates = 0, []
    current, best, most = -1, None, 0.0
    so_far = {"kept": 0, "blurred": 0}  # the neighbours to come may change them
    # Each converter keeps its tables. Those for HDR take seconds to compute.
    to_grey, to_color = VideoReformatter(), VideoReformatter()

    def write(measured: float, grey: np.ndarray, frame: av.VideoFrame) -> None:
        file = work / f"stretch_{current:05d}.jpg"
        Image.fromarray(_upright(frame, to_color)).save(file, quality=95, subsampling=0)
        scale = min(1.0, FLOW_SIDE / max(grey.shape))
        size = [max(1, round(side * scale)) for side in grey.shape[::-1]]
        candidates.append(_Candidate(measured, cv2.resize(grey, size, interpolation=cv2.INTER_AREA), file))
        so_far["kept"] = len(_sharp(candidates))
        so_far["blurred"] = len(candidates) - so_far["kept"]

    for time, frame in _frames(video, container):
        place = time / length * count
        stretch = min(int(place), count - 1)
        if stretch != current:
            if best is not None:
                write(*best)
            current, best = stretch, None
        grey = _grey(frame, to_grey)
        measured = sharpness(grey)
        value = measured * (1 - OFF_CENTRE * abs(2 * (place - stretch) - 1))
        if best is None or value > most:
            best, most = (measured, grey, frame), value
        frames += 1
        facts = {"stage": "frames", "done": frames, "total": max(frames, round(length * rate))}
        report("progress", facts | so_far)
    if best is not None:
        write(*best)
    return frames, candidates


def _sharp(candidates: list[_Candidate]) -> list[_Candidate]:
    """Leave out the candidates that are blurred compared with those of the neighbouring stretches."""
    measured = np.array([candidate.sharpness for candidate in candidates])
    reach = max(2, len(candidates) // 10)
    usual = [np.median(measured[max(0, i - reach) : i + reach + 1]) for i in range(len(measured))]
    return [
        candidate
        for candidate, near in zip(candidates, usual, strict=True)
        if candidate.sharpness >= max(FORMLESS, BLURRED * near)
    ]


def _choose(video: Path, frames: int, candidates: list[_Candidate]) -> tuple[list[_Candidate], int, int]:
    """Leave out blurred candidates and duplicates. A duplicate shows hardly any camera motion since the last candidate kept.

    Returns the kept candidates, the number of blurred ones and the number of duplicates. Raises InputError if fewer than MIN_PHOTOS are
    left.
    """
    if len(candidates) < MIN_PHOTOS:
        raise InputError(f"{video}: too few frames in it ({frames}). {REFILM}.")
    sharp = _sharp(candidates)
    if len(sharp) < MIN_PHOTOS:
        raise InputError(f"{video}: its {frames} frames are blurred. {REFILM}, in more light and in focus.")
    kept = sharp[:1]
    for candidate in sharp[1:]:
        if movement(kept[-1].grey, candidate.grey) > MOVED:
            kept.append(candidate)
    if len(kept) < MIN_PHOTOS:
        raise InputError(f"{video}: the camera hardly moves, {len(kept)} of {frames} frames differ. {REFILM}.")
    return kept, len(candidates) - len(sharp), len(sharp) - len(kept)


def _grey(frame: av.VideoFrame, converter: VideoReformatter) -> np.ndarray:
    """Return a frame as a grey picture (h, w) uint8, reduced to SIDE pixels on its longer side."""
    scale = min(1.0, SIDE / max(frame.width, frame.height))
    width, height = (max(1, round(side * scale)) for side in (frame.width, frame.height))
    return converter.reformat(frame, width, height, "gray", interpolation="AREA").to_ndarray()


def _upright(frame: av.VideoFrame, converter: VideoReformatter) -> np.ndarray:
    """Return a frame in full size as RGB (H, W, 3) uint8, sRGB-encoded and turned as its metadata says."""
    turns = round(frame.rotation / 90)  # counter-clockwise; phones film portrait as landscape with a rotation
    hdr = {"dst_color_trc": ColorTrc.IEC61966_2_1, "dst_color_primaries": ColorPrimaries.BT709}
    picture = converter.reformat(frame, format="rgb24", **(hdr if frame.color_trc in HDR else {}))
    return np.ascontiguousarray(np.rot90(picture.to_ndarray(), turns))
