"""Test that pictures are refused by the size that they declare, before they are decoded, and that large photos are not."""

import os
import shutil
import struct
import subprocess
import sys
import zlib
from contextlib import nullcontext

import cv2
import numpy as np
import pytest
from PIL import Image

from refgs.capture.images import read_codes, read_header, read_image, read_mask, write_for_colmap
from refgs.errors import InputError
from refgs.formats.exr import read_exr, write_exr
from refgs.formats.panorama import read_environment
from refgs.formats.pixels import DEEP_PHOTO, MOST_OF_PHOTO, PHOTO, check_pixels, decode, read_png
from refgs.paths import ROOT
from tests.makers import fuzz
from tests.makers.captures import write, write_as_phone

SIDE = 64  # pixels of the files whose size is then replaced


def patched(path, side, edits):
    """Replace numbers in a file: each of `edits` is a format of `struct`, and the numbers that it holds before; SIDE becomes `side`."""
    data = path.read_bytes()
    for kind, *numbers in edits:
        old = struct.pack(kind, *numbers)
        assert old in data
        data = data.replace(
            old, struct.pack(kind, *(n + side - SIDE if n in (SIDE, SIDE - 1) else n for n in numbers)), 1
        )
    if data[12:16] == b"IHDR":
        data = data[:29] + zlib.crc32(data[12:29]).to_bytes(4, "big") + data[33:]
    path.write_bytes(data)


def photo(path):
    write_as_phone(path, np.zeros((SIDE, SIDE, 3), np.uint8))


FILES = {  # a writer, a reader, and where the size is
    "a.jpg": (photo, read_image, [(">HH", SIDE, SIDE)]),
    "a.png": (photo, read_mask, [(">II", SIDE, SIDE)]),
    "a.heic": (photo, read_image, [(">II", SIDE, SIDE)]),
    "a.tif": (photo, read_image, [("<HHII", 256, 4, 1, SIDE), ("<HHII", 257, 4, 1, SIDE)]),
    "a.exr": (lambda path: write_exr(path, np.zeros((SIDE, SIDE, 3))), read_exr, [("<4i", 0, 0, SIDE - 1, SIDE - 1)]),
    "light.exr": (
        lambda path: write_exr(path, np.zeros((SIDE, SIDE))),
        read_environment,
        [("<4i", 0, 0, SIDE - 1, SIDE - 1)],
    ),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    ("side", "says"), [(20_000, "more than the 256 million"), (13_000, "do not fit into so small a file")]
)
def test_declared_sizes(tmp_path, name, side, says):
    path, (write, read, edits) = tmp_path / name, FILES[name]
    write(path)
    patched(path, side, edits)
    with pytest.raises(InputError, match=f"{side}×{side} pixels .*{says}") as error:
        read(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_declared_size_of_a_radiance_picture(tmp_path):
    path = tmp_path / "light.hdr"
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 20000 +X 40000\n" + bytes(100))
    with pytest.raises(InputError, match="40000×20000 pixels are more than"):
        read_environment(path)


def test_photos_of_two_hundred_megapixels(tmp_path):
    Image.new("1", (16320, 12240)).save(tmp_path / "a.png")
    assert read_header(tmp_path / "a.png").upright == (16320, 12240)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".heic", ".dng", ".exr"])
def test_empty_files(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.touch()
    with pytest.raises(InputError, match=f"a{suffix}") as error:
        read_image(path)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as Linux does")
def test_a_chunk_that_is_longer_than_its_file_takes_no_memory(tmp_path):
    """Check a PNG that Pillow decodes, and whose pixels are declared to take three gigabytes."""
    file = tmp_path / "a.png"
    write(file, np.full((12, 16, 3), 300, np.uint16))
    data = file.read_bytes()
    at = data.index(b"IDAT") - 4
    file.write_bytes(data[:at] + struct.pack(">I", 0xB4000000) + data[at + 4 :])
    fuzz.forget_peak()
    before = fuzz.memory("VmRSS")
    with pytest.raises(InputError, match=r"a\.png: the image is truncated or broken"):
        read_codes(file)
    assert fuzz.memory("VmHWM") - before < 100 << 20


def test_a_panorama_is_no_larger_than_its_pixels(tmp_path):
    path = tmp_path / "light.hdr"
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n" + bytes(32))
    assert read_environment(path).shape == (2, 4, 3)
    with open(path, "r+b") as file:
        file.truncate(30 << 30)  # without taking room on the disk
    with pytest.raises(InputError, match="larger than its 4×2 pixels can be"):
        read_environment(path)


def test_opencv_is_given_no_other_kinds_than_png_tiff_and_radiance(tmp_path, monkeypatch):
    """Check that JPEG 2000 never reaches OpenCV's decoder, by whatever name: that of 4.11 writes out of bounds (CVE-2025-53644)."""
    given = []
    known = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: (given.append(bytes(data[:4])), known(data, flags))[1])
    Image.new("RGB", (16, 8), "red").save(tmp_path / "a.jp2")
    for name in ("a.hdr", "a.png", "a.tif"):
        shutil.copy(tmp_path / "a.jp2", tmp_path / name)
        assert decode(tmp_path / name, cv2.IMREAD_UNCHANGED, 16, 8) is None
    assert read_png(tmp_path / "a.png") is None
    with pytest.raises(InputError, match=r"a\.hdr: this is not a Radiance picture"):
        read_environment(tmp_path / "a.hdr")
    assert given == []
    write(tmp_path / "b.png", np.full((8, 16, 3), 7, np.uint16))
    assert decode(tmp_path / "b.png", cv2.IMREAD_UNCHANGED, 16, 8).max() == 7 and given == [b"\x89PNG"]


def test_only_pngs_of_runs_are_shown(tmp_path):
    Image.new("RGB", (16, 8), "red").save(tmp_path / "a.jpg")
    shutil.copy(tmp_path / "a.jpg", tmp_path / "b.png")
    write(tmp_path / "c.png", np.full((8, 16, 3), 7, np.uint8))
    assert read_png(tmp_path / "b.png") is None and read_png(tmp_path / "gone.png") is None
    assert read_png(tmp_path / "c.png").shape == (8, 16, 3)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as Linux does")
def test_a_small_file_does_not_take_gigabytes(tmp_path):
    """Check a PNG of 254 million pixels in about a megabyte: deflate packs as many of one colour."""
    path = tmp_path / "a.png"
    Image.new("RGB", (15_900, 16), "red").save(path)
    data = path.read_bytes()
    header = data[12:16] + struct.pack(">II", 15_900, 16_000) + data[24:29]
    path.write_bytes(data[:12] + header + zlib.crc32(header).to_bytes(4, "big") + data[33:] + bytes(1_100_000))
    fuzz.forget_peak()
    before = fuzz.memory("VmRSS")
    with pytest.raises(InputError, match=r"15900×16000 pixels do not fit into so small a file"):
        read_codes(path)
    assert fuzz.memory("VmHWM") - before < 100 << 20


@pytest.mark.parametrize(
    ("size", "bits", "bytes_", "read"),
    [
        ((14_204, 10_652), 8, 10_000_000, True),  # a medium-format camera's, well compressed
        ((14_204, 10_652), 16, 10_000_000, True),
        ((16_320, 12_240), 8, 10_000_000, True),  # a phone's
        ((14_204, 10_652), 8, 1_000_000, False),
        ((14_204, 10_652), 16, 1_000_000, False),
        ((12_000, 9_000), 16, 1_000_000, False),
    ],
)
def test_photos_as_large_as_cameras_take(tmp_path, size, bits, bytes_, read):
    path = tmp_path / "a.png"
    path.touch()
    os.truncate(path, bytes_)
    limits = (PHOTO if bits == 8 else DEEP_PHOTO), MOST_OF_PHOTO
    with nullcontext() if read else pytest.raises(InputError, match="do not fit into so small a file"):
        check_pixels(path, *size, *limits)


def jpeg_of_scans(path, scans):
    """Write a progressive JPEG, and repeat its last scan until there are so many."""
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8)).save(path, progressive=True)
    data = path.read_bytes()
    last = data.rindex(b"\xff\xda")
    comment = b"\xff\xfe\x00\x04\xff\xd9"  # has the letters of the end
    path.write_bytes(data[:-2] + (comment + data[last:-2]) * (scans - data.count(b"\xff\xda")) + b"\xff\xd9")


def test_jpegs_of_many_scans_are_refused(tmp_path):
    jpeg_of_scans(tmp_path / "few.jpg", 100)
    jpeg_of_scans(tmp_path / "many.jpg", 101)
    assert read_image(tmp_path / "few.jpg")[0].shape == (64, 64, 3)
    with pytest.raises(InputError, match=r"many\.jpg: the JPEG has more than 100 scans"):
        read_image(tmp_path / "many.jpg")
    with pytest.raises(InputError, match=r"many\.jpg: the JPEG has more than 100 scans"):
        write_for_colmap(tmp_path / "many.jpg", tmp_path / "out.jpg")


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as Linux does")
@pytest.mark.parametrize(("mode", "size"), [("L", (16_000, 15_900)), ("RGB", (14_204, 9_000))])
def test_the_largest_pictures_of_small_files_are_decoded_in_a_gigabyte(tmp_path, mode, size):
    """Check a mask of 254 million pixels, and a photo of a little less than PHOTO, each of one colour."""
    code = f"""
import sys
from pathlib import Path
from PIL import Image
from refgs.capture.images import read_codes, read_mask
from refgs.paths import ROOT
from tests.makers import fuzz
path = Path({str(tmp_path)!r}) / "a.png"
Image.new({mode!r}, {size}, "white").save(path, compress_level=1)
fuzz.forget_peak()
before = fuzz.memory("VmRSS")
found = read_mask(path) if {mode!r} == "L" else read_codes(path)[0]
assert found.shape[1::-1] == {size} and found[-1, -1].min() == 255
print(fuzz.memory("VmHWM") - before)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < fuzz.MOST
