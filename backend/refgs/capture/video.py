"""Choose photos from a video: the sharpest frame of each stretch of time in which the camera moved."""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import av.filter
import cv2
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.reformatter import Colorspace, ColorTrc, VideoReformatter
from av.video.stream import VideoStream
from PIL import Image

from refgs.capture.color_profiles import coded_profile
from refgs.capture.images import as_bytes
from refgs.errors import InputError
from refgs.paths import check_file, disk_errors_named

SIDE = 800  # pixels on the longer side of the grey pictures that are measured; `standard` trains on as many
FLOW_SIDE = 400  # pixels on the longer side of the pictures between which movement is measured
BLURRED = 0.4  # part of the neighbours' median sharpness; motion blur over 7 pixels of 800 is below it
FORMLESS = 0.04  # sharpness of edges that are blurred by 3 pixels of 800 (standard deviation), and of fine texture blurred by 4
OFF_CENTRE = 0.1  # part of the sharpness taken off at a stretch's ends, so that equally sharp photos are evenly spaced
MOVED = 0.005  # part of the picture's longer side. Between neighbours of 100 photos around an object it is 0.02 or more
MIN_PHOTOS = 3  # `find_cameras` needs as many
WHOLE = 0.95  # part of the length in the header that must be there, else the file is truncated; the last frame may stay for long
HDR = (ColorTrc.ARIB_STD_B67, ColorTrc.SMPTE2084)  # HLG and PQ
UNTAGGED = 2  # H.273's code point of an unspecified matrix
SD_LINES = (
    576  # a film with more lines that names no matrix has that of BT.709, as players assume; others that of BT.601
)
ASPECTS = 0.1, 10.0  # of a pixel; others are errors of the file
REFILM = "Film for 20 to 60 seconds, walking slowly around the object"


@dataclass(eq=False)
class _Film:
    """Hold an opened video: its stream of frames, its length in seconds, and a pixel's width divided by its height.

    `matrix` is the part of the display matrix (a, b, c, d) by which players turn and mirror frames: x' = ax + cy, y' = bx + dy, y down.
    """

    file: Path
    container: InputContainer
    stream: VideoStream
    length: float
    aspect: float
    matrix: tuple[int, int, int, int] = (1, 0, 0, 1)


@dataclass(eq=False)
class _Candidate:
    """Hold a stretch's sharpest frame: sharpness, grey picture (h, w) uint8, and JPEG file."""

    sharpness: float
    grey: np.ndarray
    file: Path


def extract_photos(
    video: Path, out: Path, count: int, report: Callable[[str, dict[str, Any]], None] = lambda *_: None
) -> dict[str, int]:
    """Choose up to `count` frames of a video and write them to `out`/images as JPEG files frame_0001.jpg, frame_0002.jpg …

    The video's time is divided into `count` equal stretches. The sharpest frame of each stretch is taken. It is left out if it is much less
    sharp than the frames of the neighbouring stretches, or if the camera has not moved since the last photo. Photos are turned and mirrored
    as players show the video, with square pixels; interlaced frames are deinterlaced. Colours are converted to sRGB from the colour space
    that the video declares. In HDR video (HLG, PQ), the white of diffuse surfaces becomes white, and anything brighter is clipped.

    Memory holds one frame in full size, and a small grey picture for each stretch. `report("progress", facts)` is called after each frame:
    `done` and `total` in the dict `facts` count frames, `kept` and `blurred` count the stretches so far. Returns a dict of the counts
    `frames`, `photos`, `blurred` and `duplicates`.

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
    film = _opened(video)
    with film.container:
        try:
            out.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir()
        except OSError as error:
            raise InputError(f"{out}: no folder can be made there ({error.strerror}). Name another one.") from error
        try:
            with disk_errors_named([work], "run the command again"):
                frames, candidates = _sharpest(film, work, count, report)
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

    It is the sum of squared second derivatives divided by the sum of squared first derivatives. Both are taken in the direction that gives
    the smallest result, because motion blurs in one direction only. Sharp texture (power spectrum 1/f²) has a sharpness of 0.4. The same
    texture, blurred with a standard deviation of 1, 2 or 3 pixels, has 0.26, 0.13 or 0.07. For edges, these values are half as large.
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

    Corners are tracked by the method of Lucas and Kanade. The result is the distance that 90 % of the corners do not exceed. So an object
    that turns on a turntable counts as movement, even if its surroundings stand still. The result is infinite if there are no corners, or
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
    """Return the matrix of the scalar products of every two pictures."""
    # The sum of the pictures with weights w has the sum of squares w @ M @ w.
    return np.array([[np.vdot(one, other) for other in pictures] for one in pictures], np.float64)


def _opened(video: Path) -> _Film:
    """Open a video file. Raises InputError if it is no video or truncated."""
    path = os.path.abspath(video)  # FFmpeg takes what is before a colon for a protocol, but not in a path from the root
    try:
        check_file(video)
        container = av.open(path, metadata_errors="replace")
        # A song's or a film's cover is a stream, too.
        streams = [each for each in container.streams.video if not each.disposition & Disposition.attached_pic]
        length = _length(container, streams[0]) if streams else 0.0
        if streams and length <= 0:  # as programs write it that stream while they record
            with av.open(path, metadata_errors="replace") as again:
                length = _scanned_length(again, streams[0].index)
    except (FFmpegError, OSError) as error:
        why = error.strerror or type(error).__name__
        raise InputError(
            f"{video}: this is not a video that can be read ({why}). Copy it from the phone again, or save it as MP4."
        ) from error
    if length <= 0:
        container.close()
        raise InputError(f"{video}: there is no film in it. Name a video, such as .mp4 or .mov.")
    aspect = float(streams[0].sample_aspect_ratio or 1)
    return _Film(video, container, streams[0], length, aspect if ASPECTS[0] < aspect < ASPECTS[1] else 1.0)


def _length(container: InputContainer, stream: VideoStream) -> float:
    """Return a video's length in seconds, 0 if the file does not say it."""
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    return (container.duration or 0) / av.time_base


def _scanned_length(container: InputContainer, stream: int) -> float:
    """Return a stream's length in seconds by its packets, 0 if there are too few."""
    times = [
        (float(packet.pts * packet.time_base), float((packet.duration or 0) * packet.time_base))
        for packet in container.demux(container.streams[stream])
        if packet.pts is not None
    ]
    return max(start + long for start, long in times) - min(times)[0] if len(times) > 1 else 0.0


def _frames(film: _Film) -> Iterator[tuple[float, av.VideoFrame]]:
    """Yield each frame with its seconds from 0. Raises InputError where the video is broken."""
    video, stream, length = film.file, film.stream, film.length
    stream.thread_type = "AUTO"
    start, time, step = None, 0.0, float(1 / stream.average_rate) if stream.average_rate else 0.0
    again = "Copy it from the phone again, or save it as MP4."
    try:
        for frame in _deinterlaced(film):
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


def _deinterlaced(film: _Film) -> Iterator[av.VideoFrame]:
    """Decode a video and yield its frames. Interlaced frames are deinterlaced (FFmpeg's bwdif). Sets `film.matrix`."""
    graph = None
    for number, frame in enumerate(film.container.decode(film.stream)):
        if number == 0:
            film.matrix = _display_matrix(frame)
        if graph is None and frame.interlaced_frame:
            graph = av.filter.Graph()
            graph.link_nodes(
                graph.add_buffer(template=film.stream),
                graph.add("bwdif", "mode=send_frame:deint=interlaced"),
                graph.add("buffersink"),
            ).configure()
        if graph is None:
            yield frame
        else:
            graph.push(frame)
            yield from _pulled(graph)
    if graph is not None:
        graph.push(None)
        yield from _pulled(graph)


def _pulled(graph: av.filter.Graph) -> Iterator[av.VideoFrame]:
    """Yield the frames that an FFmpeg filter graph has ready."""
    while True:
        try:
            yield graph.vpull()
        except (BlockingIOError, EOFError):
            return


def _display_matrix(frame: av.VideoFrame) -> tuple[int, int, int, int]:
    """Return a frame's display matrix (see `_Film`), rounded to quarter turns."""
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return 1, 0, 0, 1
    a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5].astype(int)
    sideways = abs(b) + abs(c) > abs(a) + abs(d)
    one, other = (b, c) if sideways else (a, d)
    one, other = (-1 if one < 0 else 1), (-1 if other < 0 else 1)
    return (0, one, other, 0) if sideways else (one, 0, 0, other)


def _sharpest(film: _Film, work: Path, count: int, report: Callable) -> tuple[int, list[_Candidate]]:
    """Write each stretch's sharpest frame to `work`; return the frame count and the candidates."""
    length = film.length
    rate = float(film.stream.average_rate or 0)
    frames, candidates = 0, []
    current, best, most = -1, None, 0.0
    so_far = {"kept": 0, "blurred": 0}  # the neighbours to come may change them
    # Each converter keeps its tables.
    to_grey, to_color = VideoReformatter(), VideoReformatter()

    def write(measured: float, grey: np.ndarray, frame: av.VideoFrame) -> None:
        file = work / f"stretch_{current:05d}.jpg"
        Image.fromarray(_upright(film, frame, to_color)).save(file, quality=95, subsampling=0)
        scale = min(1.0, FLOW_SIDE / max(grey.shape))
        size = [max(1, round(side * scale)) for side in grey.shape[::-1]]
        candidates.append(_Candidate(measured, cv2.resize(grey, size, interpolation=cv2.INTER_AREA), file))
        so_far["kept"] = len(_sharp(candidates))
        so_far["blurred"] = len(candidates) - so_far["kept"]

    for time, frame in _frames(film):
        place = time / length * count
        stretch = min(int(place), count - 1)
        if stretch != current:
            if best is not None:
                write(*best)
            current, best = stretch, None
        grey = _grey(film, frame, to_grey)
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
    """Leave out the candidates that are much less sharp than those of the neighbouring stretches."""
    measured = np.array([candidate.sharpness for candidate in candidates])
    reach = max(2, len(candidates) // 10)
    usual = [np.median(measured[max(0, i - reach) : i + reach + 1]) for i in range(len(measured))]
    return [
        candidate
        for candidate, near in zip(candidates, usual, strict=True)
        if candidate.sharpness >= max(FORMLESS, BLURRED * near)
    ]


def _choose(video: Path, frames: int, candidates: list[_Candidate]) -> tuple[list[_Candidate], int, int]:
    """Drop blurred candidates and duplicates; return the rest and both counts, or raise InputError."""
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


def _grey(film: _Film, frame: av.VideoFrame, converter: VideoReformatter) -> np.ndarray:
    """Return a frame as a grey picture (h, w) uint8 of at most SIDE pixels."""
    size = _square(film, frame)
    scale = min(1.0, SIDE / max(size))
    width, height = (max(1, round(side * scale)) for side in size)
    return converter.reformat(frame, width, height, "gray", interpolation="AREA").to_ndarray()


def _square(film: _Film, frame: av.VideoFrame) -> tuple[int, int]:
    """Return a frame's width and height with square pixels, neither smaller than before."""
    return round(frame.width * max(film.aspect, 1)), round(frame.height * max(1 / film.aspect, 1))


def _upright(film: _Film, frame: av.VideoFrame, converter: VideoReformatter) -> np.ndarray:
    """Return a frame as upright sRGB-encoded RGB (H, W, 3) uint8 with square pixels."""
    # Players take the curves of other transfers for that of the screen, and so do we.
    transfer = frame.color_trc if frame.color_trc in HDR else ColorTrc.BT709
    profile = coded_profile(frame.color_primaries, transfer, film.file)
    picture = converter.reformat(
        frame,
        *_square(film, frame),
        "rgb24" if profile is None else "rgb48le",
        src_colorspace=Colorspace.ITU709 if frame.colorspace == UNTAGGED and frame.height > SD_LINES else None,
        interpolation=None if film.aspect == 1 else "BICUBIC",
    ).to_ndarray()
    if profile is not None:
        picture = as_bytes(*profile.to_srgb(picture))
    a, b, c, d = film.matrix
    if a == 0:
        picture, a, d = picture.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(picture[::d, ::a])
