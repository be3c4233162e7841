"""Test captures at the ends of what a disk can hold: empty and huge photos, very many, and photos that change while they are read."""

import json
import struct
import sys
import zlib

import cv2
import numpy as np
import pytest

from refgs.capture import read_capture
from refgs.capture.images import load_view
from refgs.errors import InputError
from refgs.run import create_run
from refgs.run_folder import read_run_facts
from refgs.settings import load_settings
from tests.makers import fuzz
from tests.makers.captures import nerf_blender, nerfstudio, ring

measured = pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as Linux does")


def write_zeros(file, side):
    """Write a black PNG of `side` × `side` pixels with one bit each, which takes some kilobytes."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(1 + (side + 7) // 8)
    pixels = b"".join(packer.compress(row) for _ in range(side)) + packer.flush()
    header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)


def first_photo(folder):
    return sorted((folder / "images").iterdir())[0]


def test_an_empty_photo_is_named(tmp_path):
    photo = first_photo(nerfstudio(tmp_path / "a"))
    photo.write_bytes(b"")
    with pytest.raises(InputError, match=photo.name) as said:
        read_capture(tmp_path / "a")
    assert "\n" not in str(said.value)


@measured
def test_a_photo_of_400_million_pixels_is_refused_before_it_takes_memory(tmp_path):
    photo = first_photo(nerfstudio(tmp_path / "a"))
    write_zeros(photo, 20_000)
    assert photo.stat().st_size < 1 << 20
    fuzz.forget_peak()
    before = fuzz.memory("VmRSS")
    with pytest.raises(InputError, match=rf"{photo.name}.*20,?000") as said:
        read_capture(tmp_path / "a")
    assert "\n" not in str(said.value)
    assert fuzz.memory("VmHWM") - before < 100 << 20


@pytest.mark.parametrize("size", [(40, 30), (60, 60)])
def test_a_photo_that_changes_its_size_after_it_was_found_is_named(tmp_path, size):
    view = read_capture(nerfstudio(tmp_path / "a")).views[0]
    cv2.imwrite(str(view.image_path), np.zeros((*size[::-1], 3), np.uint8))
    with pytest.raises(InputError, match=view.image_path.name) as said:
        load_view(view, 16)
    assert "\n" not in str(said.value)


@measured
def test_2000_views_are_read_in_little_memory(tmp_path):
    folder = nerfstudio(tmp_path / "a")
    file = folder / "transforms.json"
    data, photo = json.loads(file.read_text()), first_photo(folder).read_bytes()
    frame = data["frames"][0]
    poses = [pose.tolist() for pose in ring(2000)]
    data["frames"] = [
        frame | {"file_path": f"images/n{i}.png", "transform_matrix": pose} for i, pose in enumerate(poses)
    ]
    for i in range(2000):
        (folder / "images" / f"n{i}.png").write_bytes(photo)
    file.write_text(json.dumps(data))
    fuzz.forget_peak()
    before = fuzz.memory("VmRSS")
    assert len(read_capture(folder).views) == 2000
    assert fuzz.memory("VmHWM") - before < 200 << 20


@pytest.mark.skipif(sys.platform == "win32", reason="no name there holds a newline")
def test_paths_with_newlines(tmp_path):
    capture = read_capture(nerf_blender(tmp_path / "two\nlines"))
    run = tmp_path / "run\nhere"
    create_run(run, capture, load_settings("quick"), "quick", "cpu")
    assert read_run_facts(run)[0].capture == str(tmp_path / "two\nlines")
