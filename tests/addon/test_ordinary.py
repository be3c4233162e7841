"""Test that the add-on opens ordinary files only, and of a glTF file and a batch's table only what lies beside them."""

import json
import os
import struct

import pytest

from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.json_file import read_json
from refgs_addon.ordinary import check_gltf, open_file, read_text

posix = pytest.mark.skipif(os.name != "posix", reason="needs pipes")


@posix
def test_pipes_and_devices_are_not_opened(tmp_path):
    """Check that nobody waits for a pipe. The test's time limit ends it otherwise."""
    pipe = tmp_path / "a.json"
    os.mkfifo(pipe)
    for path in (pipe, "/dev/zero", "/proc/self/pagemap", tmp_path):
        with pytest.raises(OSError, match=r"this is not a file|the file is empty"):
            open_file(path)
    with pytest.raises(InputError, match=r"cannot read .*a\.json: this is not a file"):
        read_json(pipe)
    os.mkfifo(tmp_path / jobs.LOCK)
    assert jobs.run_state(tmp_path) == ""


def test_text_files_are_bounded(tmp_path):
    (tmp_path / "a.json").write_text("[1]")
    assert read_json(tmp_path / "a.json") == [1]
    os.truncate(tmp_path / "a.json", 30 << 30)
    with pytest.raises(ValueError, match="larger than such a file can be"):
        read_text(tmp_path / "a.json")
    with pytest.raises(InputError, match=r"a\.json is no whole JSON file"):
        read_json(tmp_path / "a.json")


def write_gltf(path, tree, binary):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk if binary else text)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("uri", "says"),
    [
        ("/etc/passwd", "outside of its folder, /etc/passwd"),
        ("%2Fetc%2Fpasswd", "outside of its folder"),
        ("../a.png", "outside of its folder"),
        ("textures/%2e%2e/%2e%2e/a.png", "outside of its folder"),
        ("textures\\..\\..\\a.png", "outside of its folder"),
        ("file:///etc/passwd", "outside of its folder"),
        ("https://example.org/a.png", "outside of its folder"),
        ("C:/a.png", "outside of its folder"),
        ("//server/a.png", "outside of its folder"),
        ("folder", "this is not a file"),
        ("gone.png", "No such file"),
    ],
)
@pytest.mark.parametrize("where", ["images", "buffers"])
def test_gltf_that_names_other_files(tmp_path, uri, says, where, binary):
    (tmp_path / "folder").mkdir()
    write_gltf(tmp_path / "a.glb", {"asset": {"version": "2.0"}, where: [{"uri": uri}]}, binary)
    with pytest.raises(InputError, match=says) as error:
        check_gltf(tmp_path / "a.glb")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("binary", [True, False])
def test_gltf_of_files_beside_it(tmp_path, binary):
    (tmp_path / "textures").mkdir()
    (tmp_path / "textures" / "base color.png").write_bytes(b"png")
    images = [{"uri": "textures/base%20color.png"}, {"uri": "data:image/png;base64,AAAA"}, {"bufferView": 0}]
    write_gltf(tmp_path / "a.glb", {"asset": {"version": "2.0"}, "images": images}, binary)
    check_gltf(tmp_path / "a.glb")


@pytest.mark.parametrize("data", [b"", b"glTF", b"glTF" + bytes(30), b"[" * 100_000, b"\xff" * 40])
def test_broken_gltf(tmp_path, data):
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.glb"):
        check_gltf(tmp_path / "a.glb")
