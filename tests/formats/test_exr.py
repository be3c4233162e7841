import tracemalloc

import numpy as np
import OpenEXR
import pytest

from refgs.errors import InputError
from refgs.formats.exr import read_exr, read_exr_header, write_exr
from refgs.formats.panorama import read_environment

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("shape", [(9, 7), (9, 7, 3), (9, 7, 4)])
def test_round_trip(tmp_path, shape):
    pixels = RNG.normal(size=shape).astype(np.float32) * 1e5
    path = tmp_path / "un été.exr"
    write_exr(path, pixels)
    np.testing.assert_array_equal(read_exr(path), pixels)
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_says_what_it_is(tmp_path):
    write_exr(tmp_path / "e.exr", np.ones((4, 8, 3), np.float32))
    with OpenEXR.File(str(tmp_path / "e.exr")) as file:
        header = file.header()
        assert list(file.channels()) == ["RGB"]
        assert header["compression"] == OpenEXR.ZIP_COMPRESSION
        rec709 = 0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329
        np.testing.assert_allclose(header["chromaticities"], rec709, rtol=1e-6)


def test_a_panorama_takes_twice_its_memory_while_it_is_read(tmp_path):
    """Check that the pixels are held twice, as channels and as a picture, and not more often: one of 8192×4096 has 400 MB."""
    write_exr(tmp_path / "e.exr", RNG.normal(size=(256, 512, 3)).astype(np.float32))
    read_environment(tmp_path / "e.exr")
    tracemalloc.start()
    try:
        read = read_environment(tmp_path / "e.exr")
        assert tracemalloc.get_traced_memory()[1] < 2.3 * read.nbytes
    finally:
        tracemalloc.stop()


def test_of_several_parts_the_first_in_colour_is_read(tmp_path):
    """Check that an EXR file of several parts (depth, left eye, right eye) is read from its first part with colours."""

    def part(name, channels):
        header = {"name": name, "type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
        return OpenEXR.Part(header, channels, name)

    left, right = (np.full((4, 8, 3), value, np.float32) for value in (1, 2))
    depth = {name: np.ones((4, 8), np.float32) for name in "ZA"}
    parts = [part("depth", depth), part("left", {"RGB": left}), part("right", {"RGB": right})]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    np.testing.assert_array_equal(read_exr(tmp_path / "parts.exr"), left)
    OpenEXR.File(parts[:1]).write(str(tmp_path / "depth.exr"))
    with pytest.raises(InputError, match="has the channels A, Z"):
        read_exr(tmp_path / "depth.exr")


def test_colours_of_other_primaries_become_rec709(tmp_path):
    """Check ACEScg against the matrix that ACES publishes, and that data stays as it is."""
    cg = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
    matrix = np.array([[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]])
    pixels = RNG.random((9, 7, 4)).astype(np.float32) * 10

    def write(**header) -> None:
        header |= {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
        OpenEXR.File(header, {"RGBA": pixels}).write(str(tmp_path / "a.exr"))

    write(chromaticities=cg)
    found = read_exr(tmp_path / "a.exr")
    np.testing.assert_allclose(found[..., :3], pixels[..., :3] @ matrix.T, atol=3e-4)
    np.testing.assert_array_equal(found[..., 3], pixels[..., 3])
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr", is_data=True), pixels)
    write()
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), pixels)
    write(chromaticities=(0.3,) * 8)
    with pytest.raises(InputError, match="chromaticities span no colours"):
        read_exr(tmp_path / "a.exr")


def test_deep_files_are_refused(tmp_path):
    samples = np.empty((2, 2), object)
    for number in range(4):
        samples.flat[number] = np.ones(number + 1, np.float32)
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, dict.fromkeys("RGB", samples)).write(str(tmp_path / "a.exr"))
    for read in (read_exr, read_exr_header):
        with pytest.raises(InputError, match=r"a\.exr is a deep EXR: save it flattened"):
            read(tmp_path / "a.exr")


def test_bad_files_are_named(tmp_path):
    with pytest.raises(InputError, match="missing"):
        read_exr(tmp_path / "none.exr")
    path = tmp_path / "a.exr"
    write_exr(path, RNG.random((64, 64, 3)))
    whole = path.read_bytes()
    for broken in (b"", b"text", whole[:100], whole[: len(whole) // 2]):
        path.write_bytes(broken)
        with pytest.raises(InputError, match="not a whole OpenEXR"):
            read_exr(path)
    write_exr(path, np.ones((10, 10, 3)))
    with pytest.raises(InputError, match="10×10"):
        read_environment(path)


def test_a_file_of_a_kilobyte_takes_no_memory_for_the_pixels_that_it_declares(tmp_path):
    file = tmp_path / "light.exr"
    write_exr(file, np.zeros((8, 8, 3), np.float32))
    windows = np.array([0, 0, 7, 7], "<i4").tobytes()
    claimed = np.array([0, 0, 9999, 4999], "<i4").tobytes()
    file.write_bytes(file.read_bytes().replace(windows, claimed))
    with pytest.raises(InputError, match="10000×5000 pixels do not fit into so small a file"):
        read_exr(file)
    with pytest.raises(InputError, match="do not fit"):
        read_exr_header(file)


def test_deep_pictures_are_refused(tmp_path):
    """Check that a picture with several samples a pixel, as compositing programs write, is told from a broken file."""
    samples = np.empty((2, 3), object)
    for pixel in np.ndindex(samples.shape):
        samples[pixel] = np.ones(2, np.float32)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    OpenEXR.File(header, dict.fromkeys("RGB", samples)).write(str(tmp_path / "deep.exr"))
    for read in (read_exr, read_exr_header):
        with pytest.raises(InputError, match=r"deep\.exr is a deep EXR: save it flattened"):
            read(tmp_path / "deep.exr")
