"""Test the choice of photos from videos. The videos are made here, of a window that moves over a texture."""

import struct
from fractions import Fraction
from itertools import pairwise

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition
from av.video.reformatter import Colorspace
from PIL import Image

from refgs.capture.files import find_photos
from refgs.capture.images import read_image
from refgs.capture.video import SIDE, extract_photos, movement, sharpness
from refgs.errors import InputError
from tests.makers.films import write_video

WIDTH, HEIGHT = 192, 128
LENGTH = 60  # frames
STRETCHES = 12  # of five frames each
REMUXED = {"movflags": "faststart"}  # the header first, so that a truncated file still opens


def texture(size: int = 512, seed: int = 0) -> np.ndarray:
    """Make an orange texture like those in photos, with the power spectrum 1/f²: RGB (size, size, 3) uint8."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)) + 1 / size
    waves = np.fft.irfft2(np.fft.rfft2(np.random.default_rng(seed).normal(size=(size, size))) / frequency)
    grey = (128 + 40 * waves / waves.std()).clip(0, 255)
    return (grey[..., None] * [1.0, 0.8, 0.6]).astype(np.uint8)


def window(step: float) -> np.ndarray:
    """Return the frame after `step` steps of four pixels."""
    x = round(4 * step)
    return TEXTURE[100 : 100 + HEIGHT, x : x + WIDTH]


def blurred(frame: np.ndarray, pixels: int) -> np.ndarray:
    """Blur a frame as a camera does that moves by `pixels` sideways while the shutter is open."""
    return cv2.blur(frame, (pixels, 1))


def track_matrix(a: int, b: int, c: int, d: int) -> bytes:
    """Return the matrix of a track header as 36 bytes, without a shift."""
    return struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)


TEXTURE = texture()
WALK = [window(step) for step in range(LENGTH)]


def refused(says: str, video, out, count: int = STRETCHES) -> None:
    """Assert that the video is refused with one line that holds `says`, and that no file or folder is left."""
    before = sorted(out.parent.rglob("*"))
    with pytest.raises(InputError) as error:
        extract_photos(video, out, count)
    message = str(error.value)
    assert says in message and "\n" not in message, message
    assert sorted(out.parent.rglob("*")) == before


def source(file) -> int:
    """Return the number of the frame in WALK that a photo is most like."""
    photo = read_image(file)[0].astype(int)
    return int(np.argmin([np.abs(photo - frame).mean() for frame in WALK]))


@pytest.mark.parametrize("name", ["film.mp4", "film.MOV"])
def test_the_sharpest_frame_of_each_stretch(tmp_path, name):
    sharp = {5 * stretch + (3 * stretch) % 5 for stretch in range(STRETCHES)}
    shaky = [frame if number in sharp else blurred(frame, 3) for number, frame in enumerate(WALK)]
    for number in range(20, 25):
        shaky[number] = blurred(WALK[number], 15)
    write_video(tmp_path / name, shaky)
    said = []
    found = extract_photos(tmp_path / name, tmp_path / "out", STRETCHES, lambda *facts: said.append(facts))
    assert found == {"frames": LENGTH, "photos": STRETCHES - 1, "blurred": 1, "duplicates": 0}
    photos = find_photos(tmp_path / "out")
    assert [photo.name for photo in photos] == [f"frame_{n:04d}.jpg" for n in range(1, STRETCHES)]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["images"]
    assert [source(photo) for photo in photos] == sorted(sharp - set(range(20, 25)))
    assert np.abs(read_image(photos[0])[0].astype(int) - WALK[0]).mean() < 6
    assert [facts["done"] for _, facts in said] == list(range(1, LENGTH + 1))
    last = {"stage": "frames", "done": LENGTH, "total": LENGTH, "kept": STRETCHES - 2, "blurred": 1}
    assert said[-1] == ("progress", last)  # the last stretch is not over yet


def test_photos_are_evenly_spaced_where_all_frames_are_as_sharp(tmp_path):
    write_video(tmp_path / "film.mp4", WALK)
    extract_photos(tmp_path / "film.mp4", tmp_path / "out", STRETCHES)
    sources = [source(photo) for photo in find_photos(tmp_path / "out")]
    assert len(sources) == STRETCHES and np.ptp(np.diff(sources)) <= 3


def test_stretches_in_which_the_camera_stands_are_left_out(tmp_path):
    steps = [*range(20), *[20] * 20, *range(20, 40)]
    noise = np.random.default_rng(0)
    frames = [(window(step) + noise.normal(0, 2, (HEIGHT, WIDTH, 3))).clip(0, 255).astype(np.uint8) for step in steps]
    write_video(tmp_path / "pause.mp4", frames)
    found = extract_photos(tmp_path / "pause.mp4", tmp_path / "out", STRETCHES)
    assert found["duplicates"] in (3, 4) and found["blurred"] == 0
    sources = [source(photo) for photo in find_photos(tmp_path / "out")]
    assert len(sources) == found["photos"] == STRETCHES - found["duplicates"]
    assert all(a < b for a, b in pairwise(sources))


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((0, 1, -1, 0), lambda frame: np.rot90(frame, -1)),
        ((0, -1, 1, 0), lambda frame: np.rot90(frame, 1)),
        ((-1, 0, 0, -1), lambda frame: np.rot90(frame, 2)),
        ((-1, 0, 0, 1), lambda frame: frame[:, ::-1]),
        ((1, 0, 0, -1), lambda frame: frame[::-1]),
        ((0, 1, 1, 0), lambda frame: frame.transpose(1, 0, 2)),
        ((0, -1, -1, 0), lambda frame: np.rot90(frame.transpose(1, 0, 2), 2)),
    ],
    ids=["portrait", "portrait upside down", "upside down", "mirrored", "flipped", "transposed", "transversed"],
)
def test_photos_are_upright(tmp_path, matrix, shown):
    """Check the matrix in an MP4's track header (ISO/IEC 14496-12): x' = ax + cy, y' = bx + dy, with y down."""
    write_video(tmp_path / "film.mp4", WALK[:30])
    film = (tmp_path / "film.mp4").read_bytes()
    header = film.index(b"tkhd")
    place = film.index(track_matrix(1, 0, 0, 1), header)
    (tmp_path / "film.mp4").write_bytes(film[:place] + track_matrix(*matrix) + film[place + 36 :])
    extract_photos(tmp_path / "film.mp4", tmp_path / "out", 3)
    photo = read_image(find_photos(tmp_path / "out")[0])[0].astype(int)
    assert min(np.abs(shown(frame) - photo).mean() for frame in WALK[:10]) < 4


GOLD = np.array([212, 175, 55])


def patch(video, out, codes, lines: int = HEIGHT, **options) -> np.ndarray:
    """Write a film with a patch of 8-bit `codes` over WALK, repeated to at least that many lines. Returns the patch's mean in a photo."""
    frames = [np.tile(frame, (-(-lines // HEIGHT), 1, 1)) for frame in WALK]
    for frame in frames:
        frame[:40, :40] = codes
    write_video(video, frames, **options)
    extract_photos(video, out, 3)
    return read_image(find_photos(out)[0])[0][8:32, 8:32].mean(axis=(0, 1))


@pytest.mark.parametrize(
    ("lines", "options"),
    [
        (HEIGHT, {"matrix": Colorspace.ITU601}),
        (640, {"matrix": Colorspace.ITU709}),
        (HEIGHT, {"colorspace": Colorspace.ITU709}),
        (640, {"colorspace": Colorspace.ITU601}),
        (HEIGHT, {"colorspace": Colorspace.BT2020}),
        (HEIGHT, {"colorspace": Colorspace.ITU709, "color_range": 2}),
    ],
    ids=["untagged, small", "untagged, HD", "BT.709", "HD of BT.601", "BT.2020", "full range"],
)
def test_colours_have_the_matrix_of_their_tags_or_size(tmp_path, lines, options):
    """Check a green, which another matrix or range changes by at least 7 codes. FFmpeg's conversions are off by up to 3."""
    green = 40, 190, 60
    found = patch(tmp_path / "film.mp4", tmp_path / "out", green, lines, **options)
    np.testing.assert_allclose(found, green, atol=4)


def test_wide_primaries_become_srgb(tmp_path):
    """Check Display P3: gold there is (206, 176, 78)."""
    tags = {"color_primaries": 12, "color_trc": 1, "colorspace": Colorspace.ITU709}
    found = patch(tmp_path / "film.mp4", tmp_path / "out", (206, 176, 78), **tags)
    np.testing.assert_allclose(found, GOLD, atol=4.5)


@pytest.mark.parametrize(("transfer", "white", "grey"), [(18, 0.75, 0.3783), (16, 0.5807, 0.4109)], ids=["HLG", "PQ"])
def test_hdr_becomes_srgb(tmp_path, transfer, white, grey):
    """Check that the white of diffuse surfaces (BT.2408) is white, and what reflects 18 % as much is 0.18 of it: 118 of 255.

    Its code is √(3 · 0.18 · 0.265) for HLG, and for PQ that of 36.5 cd/m².
    """
    tags = {"color_trc": transfer, "color_primaries": 9, "colorspace": Colorspace.BT2020}
    tags |= {"codec": "libx265", "pixels": "yuv420p10le"}
    for code, expected in ((white, 255), (grey, 118), (0.9, 255)):
        out = tmp_path / f"{code}"
        assert np.abs(patch(tmp_path / "hdr.mov", out, round(code * 255), **tags) - expected).max() < 4


def test_pixels_become_square(tmp_path):
    """Check that a pixel's width stretches the photo, in the direction in which no detail is lost."""
    frames = [window(step) for step in range(LENGTH)]
    for aspect, size in ((Fraction(4, 3), (HEIGHT, 256)), (Fraction(3, 4), (round(HEIGHT * 4 / 3), WIDTH))):
        out = tmp_path / f"{size[1]}"
        write_video(tmp_path / "film.mp4", frames, sample_aspect_ratio=aspect)
        extract_photos(tmp_path / "film.mp4", out, 3)
        photo = read_image(find_photos(out)[0])[0]
        assert photo.shape == (*size, 3)
        back = cv2.resize(photo, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(int)
        assert min(np.abs(back - frame).mean() for frame in WALK) < 6


def test_interlaced_frames_are_deinterlaced(tmp_path):
    """Check that a photo of two woven fields, between which the camera moved by 8 pixels, has no comb."""

    def comb(picture: np.ndarray) -> float:
        grey = picture.astype(float).mean(axis=2)
        return float(np.abs(grey[1:-1] - (grey[:-2] + grey[2:]) / 2).mean())

    woven = [frame.copy() for frame in WALK[2:]]
    for frame, later in zip(woven, WALK[4:] + WALK[:2], strict=True):
        frame[1::2] = later[1::2]
    write_video(tmp_path / "film.mp4", woven, x264="tff=1")
    found = extract_photos(tmp_path / "film.mp4", tmp_path / "out", 5)
    assert found["frames"] == len(woven)
    for photo in find_photos(tmp_path / "out"):
        assert comb(read_image(photo)[0]) < 1.2 * comb(WALK[0]) < 0.65 * comb(woven[0])


@pytest.mark.parametrize("name", ["film.mkv", "film.webm"])
def test_a_film_whose_header_has_no_length(tmp_path, name):
    """Check a film as programs write it that stream it while they record: into a pipe, so that the header cannot be completed."""
    codec = {"codec": "libvpx-vp9"} if name.endswith("webm") else {}
    write_video(tmp_path / name, WALK, options={"live": "1"}, **codec)
    with av.open(str(tmp_path / name)) as container:
        assert not container.duration and not container.streams.video[0].duration
    found = extract_photos(tmp_path / name, tmp_path / "out", STRETCHES)
    assert found == {"frames": LENGTH, "photos": STRETCHES, "blurred": 0, "duplicates": 0}


def test_a_name_with_a_colon(tmp_path, monkeypatch):
    """Check that FFmpeg does not take what is before the colon for a protocol."""
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "film.mp4", WALK)
    (tmp_path / "film.mp4").rename(tmp_path / "12:30.mp4")
    assert extract_photos("12:30.mp4", "out", 5)["photos"] == 5


def test_a_large_video_is_kept_in_full_size(tmp_path):
    large = cv2.resize(TEXTURE, (1600, 1600))
    write_video(tmp_path / "large.mp4", [large[:SIDE, x : x + 2 * SIDE - 200] for x in range(0, 200, 20)])
    found = extract_photos(tmp_path / "large.mp4", tmp_path / "out", 5)
    assert found["photos"] == 5
    assert read_image(find_photos(tmp_path / "out")[0])[0].shape == (SIDE, 2 * SIDE - 200, 3)


def test_sharpness():
    """Check that blur in any direction lowers the sharpness, and that contrast does not change it."""
    grey = cv2.cvtColor(TEXTURE, cv2.COLOR_RGB2GRAY)
    sharp = sharpness(grey)
    assert sharpness(grey // 2 + 60) == pytest.approx(sharp, rel=0.02) and 0.3 < sharp < 0.5
    gaussian = [sharpness(cv2.GaussianBlur(grey, (0, 0), sigma)) / sharp for sigma in (1, 2, 3)]
    assert gaussian == pytest.approx([0.67, 0.34, 0.18], abs=0.03)
    for kernel in (np.ones((1, 9)), np.ones((9, 1)), np.eye(9), np.eye(9)[::-1]):
        assert sharpness(cv2.filter2D(grey, -1, kernel / kernel.sum())) < 0.4 * sharp
    assert sharpness(np.full((32, 32), 100, np.uint8)) == 0


def test_movement():
    grey = cv2.cvtColor(TEXTURE, cv2.COLOR_RGB2GRAY)
    assert movement(grey[:200, :400], grey[:200, 8:408]) == pytest.approx(8 / 400, rel=0.05)
    assert movement(grey[:200, :400], grey[:200, :400]) < 1e-4
    turntable = grey[:200, :400].copy()
    turntable[60:140, 100:250] = grey[60:140, 105:255]
    assert movement(grey[:200, :400], turntable) > 0.01
    assert movement(grey[:200, :400], grey[300:500, :400]) > 0.05
    assert movement(np.zeros((50, 50), np.uint8), np.zeros((50, 50), np.uint8)) == np.inf


def test_what_is_no_video(tmp_path):
    (tmp_path / "notes.mp4").write_text("no video " * 100)
    refused("notes.mp4: this is not a video", tmp_path / "notes.mp4", tmp_path / "out")
    (tmp_path / "empty.mp4").touch()
    refused("empty.mp4: this is not a video", tmp_path / "empty.mp4", tmp_path / "out")
    refused("no such file", tmp_path / "nowhere.mp4", tmp_path / "out")
    refused("no such file", tmp_path, tmp_path / "out")
    cv2.imwrite(str(tmp_path / "photo.jpg"), TEXTURE)
    refused("too few frames in it (1)", tmp_path / "photo.jpg", tmp_path / "out")
    Image.fromarray(TEXTURE).save(tmp_path / "still.gif")
    refused("there is no film in it", tmp_path / "still.gif", tmp_path / "out")
    for name, says in (("header.mp4", "there is no film in it"), ("header.mkv", "not a video that can be read")):
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            container.start_encoding()
        refused(says, tmp_path / name, tmp_path / "out")
    with av.open(str(tmp_path / "sound.m4a"), "w") as container:
        stream = container.add_stream("aac", rate=44100, layout="mono")
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 44100), np.float32), format="fltp", layout="mono")
        sound.sample_rate = 44100
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    refused("there is no film in it", tmp_path / "sound.m4a", tmp_path / "out")
    with av.open(str(tmp_path / "song.mp4"), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        cover.disposition = Disposition.attached_pic
        stream = container.add_stream("aac", rate=44100, layout="mono")
        container.mux(cover.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(WALK[0]), format="rgb24")))
        container.mux(stream.encode(sound))
        for each in (cover, stream):
            container.mux(each.encode())
    refused("there is no film in it", tmp_path / "song.mp4", tmp_path / "out")


def test_a_truncated_video(tmp_path):
    write_video(tmp_path / "film.mp4", WALK, options=REMUXED)
    whole = (tmp_path / "film.mp4").read_bytes()
    assert extract_photos(tmp_path / "film.mp4", tmp_path / "whole", STRETCHES)["photos"] == STRETCHES
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 2])
    refused("of 2.0 seconds are there", tmp_path / "half.mp4", tmp_path / "out")
    (tmp_path / "start.mp4").write_bytes(whole[: whole.index(b"mdat") + 4])
    refused("start.mp4: ", tmp_path / "start.mp4", tmp_path / "out")
    write_video(tmp_path / "film.mov", WALK)  # the header last, as phones write it
    (tmp_path / "half.mov").write_bytes((tmp_path / "film.mov").read_bytes()[:20000])
    refused("half.mov: this is not a video", tmp_path / "half.mov", tmp_path / "out")


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([WALK[0]] * LENGTH, "the camera hardly moves, 1 of 60 frames differ"),
        (WALK[:2], "too few frames in it (2)"),
        ([cv2.GaussianBlur(frame, (0, 0), 6) for frame in WALK], "its 60 frames are blurred"),
        ([np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * LENGTH, "its 60 frames are blurred"),
    ],
    ids=["still", "two frames", "blurred", "black"],
)
def test_videos_of_which_no_photos_remain(tmp_path, frames, says):
    write_video(tmp_path / "film.mp4", frames)
    refused(says, tmp_path / "film.mp4", tmp_path / "new")
    (tmp_path / "mine").mkdir()
    refused(says, tmp_path / "film.mp4", tmp_path / "mine")


def test_what_exists_is_not_overwritten(tmp_path):
    write_video(tmp_path / "film.mp4", WALK)
    (tmp_path / "out" / "images").mkdir(parents=True)
    refused("images exists", tmp_path / "film.mp4", tmp_path / "out")
    refused("no folder can be made there", tmp_path / "film.mp4", tmp_path / "film.mp4")


def test_an_interrupted_choice_leaves_nothing(tmp_path):
    write_video(tmp_path / "film.mp4", WALK)

    def interrupt(event, facts) -> None:
        if facts["done"] == 30:
            assert any((tmp_path / "out" / "images.tmp").iterdir())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_photos(tmp_path / "film.mp4", tmp_path / "out", STRETCHES, interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
