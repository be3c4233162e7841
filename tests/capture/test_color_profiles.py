"""Test that photos have the colours that their files declare. Values are compared with float64 sums over published matrices."""

import io
import warnings
import zlib

import numpy as np
import pillow_heif
import pytest
import tifffile
from PIL import ExifTags, Image, ImageCms

from refgs.camera import Camera
from refgs.capture import View, color_profiles, load_normals, load_view
from refgs.capture.images import read_codes, read_image, read_mask
from refgs.errors import InputWarning
from tests.makers import profiles
from tests.makers.captures import write
from tests.makers.profiles import ADOBE_RGB, DISPLAY_P3, PROPHOTO, SRGB, formula, gamma, matrix_profile, table

COLORS = np.array([(212, 175, 55), (200, 30, 30), (40, 160, 60), (30, 60, 190), (128, 128, 128), (184, 115, 51)])
SPACES = {
    "p3": (DISPLAY_P3, formula(*profiles.SRGB_CURVE), profiles.srgb_decoded, profiles.srgb_encoded),
    "adobe": (ADOBE_RGB, gamma(563 / 256), lambda codes: codes ** (563 / 256), lambda linear: linear ** (256 / 563)),
    "prophoto": (PROPHOTO, gamma(461 / 256), lambda codes: codes ** (461 / 256), lambda linear: linear ** (256 / 461)),
    "linear": (SRGB, gamma(1), lambda codes: codes, lambda linear: linear),
}  # colorants, curve, and what decodes and encodes
SAME = 5e-5  # in linear light
RNG = np.random.default_rng(0)


def profile_of(space: str) -> bytes:
    return matrix_profile(*SPACES[space][:2])


def patches(space: str) -> np.ndarray:
    """Draw flat patches of COLORS in a colour space: codes (16, 96, 3) uint8."""
    colorants, _, _, encode = SPACES[space]
    linear = np.clip(profiles.srgb_decoded(COLORS / 255) @ (np.linalg.inv(colorants) @ SRGB).T, 0, 1)
    return np.repeat(np.repeat(np.rint(encode(linear) * 255).astype(np.uint8)[None], 16, axis=0), 16, axis=1)


def true_codes(codes: np.ndarray, space: str) -> np.ndarray:
    """Return the sRGB codes of codes (..., 3) of another space, not rounded, in float64."""
    colorants, _, decode, _ = SPACES[space]
    largest = np.iinfo(codes.dtype).max
    return profiles.srgb_encoded(decode(codes / largest) @ (np.linalg.inv(SRGB) @ colorants).T) * largest


def apart(image: np.ndarray, stored: np.ndarray, space: str) -> float:
    """Return how far sRGB codes are from those of `stored`, at most, in linear light beyond the rounding of a code.

    Published colorants have five digits, so that white is off by 0.00003.
    """
    true, largest = true_codes(stored, space), np.iinfo(image.dtype).max
    low, high = (profiles.srgb_decoded(np.clip(true + side, 0, largest) / largest) for side in (-0.51, 0.51))
    found = profiles.srgb_decoded(image / largest)
    return float(np.maximum(low - found, found - high).max())


def noise(dtype=np.uint8, channels: int = 3) -> np.ndarray:
    """Draw random codes (40, 30, channels)."""
    return RNG.integers(0, np.iinfo(dtype).max + 1, (40, 30, channels)).astype(dtype)


def save(path, codes: np.ndarray, profile: bytes) -> None:
    """Save codes of 8 or 16 bits, as PNG or TIFF, with a profile."""
    if codes.dtype == np.uint8:
        Image.fromarray(codes).save(path, icc_profile=profile)
    elif path.suffix == ".png":
        write(path, codes)
        profiles.add_chunk(path, b"iCCP", b"profile\0\0" + zlib.compress(profile))
    else:
        tags = [(34675, "B", len(profile), profile, False)]
        tifffile.imwrite(path, codes, photometric="rgb", metadata=None, extratags=tags)


def srgb_profiles() -> dict[str, bytes]:
    """Make profiles of sRGB: that of LittleCMS, a formula, and a table as in the profile that most cameras embed."""
    curve = table(profiles.srgb_decoded(np.linspace(0, 1, 1024)))
    return {
        "LittleCMS": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
        "formula": matrix_profile(SRGB, formula(*profiles.SRGB_CURVE)),
        "table": matrix_profile(SRGB, curve),
    }


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".heic", ".avif"])
def test_gold_is_gold_whatever_the_file(tmp_path, suffix, space):
    """Check patches against what exact decoding gives, and against COLORS: codes of 8 bits were rounded, in linear spaces coarsely."""
    path, stored = tmp_path / f"a{suffix}", patches(space)
    best = {
        ".jpg": {"quality": 100, "subsampling": 0},
        ".webp": {"lossless": True},
        ".heic": {"quality": -1, "chroma": 444, "matrix_coefficients": 0},
        ".avif": {"quality": 100, "subsampling": "4:4:4"},
    }
    Image.fromarray(stored).save(path, icc_profile=profile_of(space), **best.get(suffix, {}))
    found = read_image(path)[0][8, 8::16].astype(int)
    decoded = read_image(path, is_data=True)[0]  # of lossy formats one code off
    assert np.abs(decoded.astype(int) - stored).max() <= (3 if suffix == ".avif" else 1)
    assert apart(read_image(path)[0], decoded, space) < SAME
    if suffix in (".png", ".tif", ".webp", ".heic") and space != "linear":
        assert np.abs(found - COLORS)[[0, 4, 5]].max() <= 1


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize(("dtype", "suffix"), [(np.uint8, ".png"), (np.uint16, ".png"), (np.uint16, ".tif")])
def test_codes_against_float64(tmp_path, space, dtype, suffix):
    """Check random codes, many of them beyond sRGB: those of 16 bits keep their precision."""
    path, stored = tmp_path / f"a{suffix}", noise(dtype)
    save(path, stored, profile_of(space))
    image, alpha, white = read_codes(path)
    assert image.dtype == dtype and white == np.iinfo(dtype).max and alpha is None
    assert apart(image, stored, space) < SAME
    assert np.abs(image - true_codes(stored, space)).mean() < (0.3 if dtype == np.uint8 else 2)


@pytest.mark.parametrize("kind", srgb_profiles())
@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_srgb_stays_as_it_is(tmp_path, kind, suffix, dtype):
    stored = noise(dtype)
    save(tmp_path / f"a{suffix}", stored, srgb_profiles()[kind])
    assert np.array_equal(read_codes(tmp_path / f"a{suffix}")[0], stored)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_chunks_of_png(tmp_path, dtype):
    """Check gAMA, cHRM, sRGB and cICP. A chunk that the PNG specification prefers hides the others."""
    stored, path, largest = noise(dtype), tmp_path / "a.png", np.iinfo(dtype).max

    def read(**chunks: bytes) -> np.ndarray:
        write(path, stored)
        for name, data in chunks.items():
            profiles.add_chunk(path, name.encode(), data)
        return read_codes(path)[0]

    def numbers(*values: float) -> bytes:
        return np.rint(np.array(values) * 100_000).astype(">u4").tobytes()

    p3 = numbers(0.3127, 0.3290, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060)
    half, whole = numbers(0.45455), numbers(1)
    for same in ({}, {"gAMA": half}, {"gAMA": whole, "sRGB": b"\0"}, {"cICP": bytes((1, 13, 0, 1)), "gAMA": whole}):
        assert np.array_equal(read(**same), stored), same
    assert apart(read(gAMA=whole), stored, "linear") < SAME
    power = profiles.srgb_encoded((stored / largest) ** (1 / 0.55556)) * largest
    assert np.abs(read(gAMA=numbers(0.55556)) - power).max() < 0.6
    for chunks in ({"cHRM": p3}, {"cHRM": p3, "gAMA": half}, {"cICP": bytes((12, 13, 0, 1)), "gAMA": whole}):
        assert apart(read(**chunks), stored, "p3") < SAME, chunks
    assert np.array_equal(read_image(path, is_data=True)[0], np.rint(stored / largest * 255))


def test_greyscale(tmp_path):
    """Check a grey profile, and a profile for RGB in a grey picture, which all editors write."""
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    expected = profiles.srgb_encoded((grey / 255) ** 1.75) * 255
    Image.fromarray(grey).save(tmp_path / "a.png", icc_profile=profiles.grey_profile(gamma(1.75)))
    assert np.abs(read_image(tmp_path / "a.png")[0] - expected[..., None]).max() < 0.6
    Image.fromarray(grey).save(tmp_path / "b.jpg", icc_profile=profile_of("p3"), quality=100)
    decoded = read_image(tmp_path / "b.jpg", is_data=True)[0]
    assert np.array_equal(read_image(tmp_path / "b.jpg")[0], decoded)  # P3 has the grey of sRGB


def test_tables_and_cmyk(tmp_path):
    """Check profiles that are tables: the corners of the cube are white, black and colours of known Lab."""
    labs = {(0, 0, 0): (0, 0, 0), (1, 1, 1): (100, 0, 0), (1, 0, 0): (53, 60, 40), (0, 1, 0): (70, -50, 40)}
    codes = np.array([[(0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 255, 0)]], np.uint8)
    # XYZ of these Lab by CIE 15 over D50, then Rec.709 by the colorants of sRGB.
    expected = [
        profiles.srgb_encoded(np.linalg.inv(SRGB) @ lab_to_xyz(labs[tuple(code)])) * 255 for code in codes[0] // 255
    ]
    profile = profiles.table_profile(b"RGB ", 3, lambda corner: labs.get(corner, (50, 0, 0)))
    for dtype, suffix in ((np.uint8, ".png"), (np.uint16, ".tif")):
        save(tmp_path / f"a{suffix}", codes.astype(dtype) * dtype(np.iinfo(dtype).max // 255), profile)
        assert np.abs(read_image(tmp_path / f"a{suffix}")[0][0] - expected).max() <= 1.5
    inks = {(0, 0, 0, 0): (100, 0, 0), (1, 1, 1, 1): (0, 0, 0), (0, 1, 1, 0): (53, 60, 40), (1, 0, 1, 0): (70, -50, 40)}
    profile = profiles.table_profile(b"CMYK", 4, lambda corner: inks.get(corner, (10, 0, 0)))
    cmyk = np.array([[(255,) * 4, (0,) * 4, (0, 255, 255, 0), (255, 0, 255, 0)]], np.uint8)
    Image.fromarray(cmyk, "CMYK").save(tmp_path / "b.tif", icc_profile=profile)
    assert np.abs(read_image(tmp_path / "b.tif")[0][0] - expected).max() <= 1.5


def lab_to_xyz(lab) -> np.ndarray:
    L, a, b = lab
    y = (L + 16) / 116
    t = np.array([y + a / 500, y, y - b / 200])
    return np.where(t > 6 / 29, t**3, 3 * (6 / 29) ** 2 * (t - 4 / 29)) * [0.9642, 1, 0.8249]


@pytest.mark.parametrize(
    ("profile", "says"),
    [
        (b"no profile at all" * 20, "it is broken"),
        (matrix_profile(DISPLAY_P3, gamma(1))[:200], "it is broken"),
        (matrix_profile(0 * DISPLAY_P3, gamma(1)), "its white is no white"),
        (matrix_profile(DISPLAY_P3, b"none" + bytes(20)), "unknown curve"),
        (profiles.grey_profile(gamma(1)), "for greyscale pictures"),
        (profiles.table_profile(b"CMYK", 4, lambda corner: (50, 0, 0)), "not for RGB"),
        (profiles.table_profile(b"Lab ", 3, lambda corner: (50, 0, 0)), "its colour space is Lab"),
    ],
    ids=["text", "truncated", "black", "curve", "grey", "CMYK", "Lab"],
)
def test_a_profile_that_cannot_be_used_is_ignored_with_one_line(tmp_path, monkeypatch, profile, says):
    monkeypatch.setattr(color_profiles, "_told", set())
    stored = noise()
    for name in ("a.png", "b.png"):
        Image.fromarray(stored).save(tmp_path / name, icc_profile=profile)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for name in ("a.png", "b.png", "a.png"):
            assert np.array_equal(read_image(tmp_path / name)[0], stored)
    (warning,) = caught
    assert warning.category is InputWarning and "\n" not in str(warning.message)
    assert "a.png: its colour profile is ignored" in str(warning.message) and says in str(warning.message)


def test_masks_and_maps_are_no_colours(tmp_path):
    """Check that a profile, as editors embed it in whatever they save, changes no mask and no normals."""
    normals = np.array([[(0.36, 0.48, 0.8), (0.6, 0, 0.8)]] * 2)
    codes = np.rint((normals + 1) / 2 * 65535).astype(np.uint16)
    save(tmp_path / "n.png", codes, profile_of("linear"))
    view = View(
        Camera("a", 2, 2, 2, 2, 1, 1, np.eye(4)), tmp_path / "n.png", None, "train", prior_normals=tmp_path / "n.png"
    )
    found = load_normals(view)
    assert np.abs(found.values - normals).max() < 1e-3
    mask = np.arange(256, dtype=np.uint8).reshape(16, 16)
    Image.fromarray(mask).save(tmp_path / "m.png", icc_profile=profiles.grey_profile(gamma(1)))
    assert np.array_equal(read_mask(tmp_path / "m.png"), mask)


def test_reduced_photos_are_converted(tmp_path):
    """Check a JPEG that its decoder reduces, and what training sees of it."""
    large = np.full((64, 96, 3), (206, 176, 78), np.uint8)
    Image.fromarray(large).save(tmp_path / "a.jpg", icc_profile=profile_of("p3"), quality=100, subsampling=0)
    image = read_image(tmp_path / "a.jpg", 4)[0]
    assert image.shape == (16, 24, 3) and np.abs(image.astype(int) - COLORS[0]).max() <= 1
    view = View(Camera("a", 96, 64, 90, 90, 48, 32, np.eye(4)), tmp_path / "a.jpg", None, "train")
    for side in (None, 12):
        assert np.abs(load_view(view, side).image.astype(int) - COLORS[0]).max() <= 1


def test_alpha_and_turns_stay(tmp_path):
    stored = np.dstack([patches("p3"), RNG.integers(0, 256, (16, 96)).astype(np.uint8)])
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(stored).save(tmp_path / "a.png", icc_profile=profile_of("p3"), exif=exif)
    image, alpha = read_image(tmp_path / "a.png")
    assert np.array_equal(np.rot90(alpha), stored[..., 3])
    assert np.abs(np.rot90(image)[8, 8::16].astype(int) - COLORS).max() <= 1


def test_adobe_rgb_by_exif(tmp_path):
    """Check the EXIF of a camera that is set to Adobe RGB but embeds no profile (DCF 2.0)."""
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.ColorSpace] = 65535
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {1: "R03"}
    Image.fromarray(patches("adobe")).save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    decoded = read_image(tmp_path / "a.jpg", is_data=True)[0]
    assert apart(read_image(tmp_path / "a.jpg")[0], decoded, "adobe") < SAME


def heic(path, codes: np.ndarray, **options) -> None:
    """Save 16-bit codes as HEIC with 10 bits, without loss. `options` are H.273's code points."""
    height, width, channels = codes.shape
    mode = {3: "RGB;16", 4: "RGBA;16"}[channels]
    heif = pillow_heif.from_bytes(mode=mode, size=(width, height), data=codes.tobytes())
    heif.save(path, quality=-1, chroma=444, matrix_coefficients=0, **options)


def test_heic_with_10_bits(tmp_path):
    """Check that all 1,024 codes are told apart, that the largest is white, and that primaries of nclx are followed."""
    ten = np.arange(1024).reshape(32, 32)
    codes = np.dstack([ten, ten[::-1], ten.T, ten]).astype(np.uint16) * 64
    heic(tmp_path / "a.heic", codes)
    image, alpha, white = read_codes(tmp_path / "a.heic")
    assert image.dtype == np.uint16 and white == 65535
    np.testing.assert_allclose(image, codes[..., :3] / 64 * 65535 / 1023, atol=0.51)
    np.testing.assert_allclose(alpha, ten * 255 / 1023, atol=0.51)
    heic(tmp_path / "b.heic", codes[..., :3].copy(), color_primaries=12, transfer_characteristics=13)
    image, _, white = read_codes(tmp_path / "b.heic")
    stored = np.rint(codes[..., :3] / 64 * 65535 / 1023).astype(np.uint16)
    assert white == 65535 and apart(image, stored, "p3") < SAME


@pytest.mark.parametrize(("transfer", "code", "white"), [(16, 0.5807, 10_000 / 203), (18, 0.75, 1 / 0.26496)])
def test_hdr_photos_are_brighter_than_white(tmp_path, transfer, code, white):
    """Check PQ and HLG: white of diffuse surfaces by BT.2408 becomes white, and the largest code is as bright as the standards say."""
    codes = np.array([[0, round(code * 1023), 1023]] * 2, np.uint16)[..., None].repeat(3, axis=2) * 64
    heic(tmp_path / "a.heic", codes, color_primaries=9, transfer_characteristics=transfer)
    view = View(Camera("a", 3, 2, 2, 2, 1, 1, np.eye(4)), tmp_path / "a.heic", None, "train")
    loaded = load_view(view)
    linear = profiles.srgb_decoded(loaded.encoded[0])
    np.testing.assert_allclose(linear[:2], [[0] * 3, [1] * 3], atol=0.01)
    np.testing.assert_allclose(linear[2], white, rtol=0.005)
    assert np.array_equal(loaded.bytes[0, 1:], np.full((2, 3), 255)) or loaded.bytes[0, 1].min() >= 254


def test_avif_without_a_profile(tmp_path):
    """Check the code points of an AVIF: Pillow writes those of sRGB, which are replaced by Display P3's."""
    buffer = io.BytesIO()
    Image.fromarray(patches("p3")).save(buffer, "AVIF", quality=100, subsampling="4:4:4")
    data = buffer.getvalue()
    (tmp_path / "a.avif").write_bytes(data)
    decoded = read_image(tmp_path / "a.avif")[0]
    assert np.array_equal(decoded, read_image(tmp_path / "a.avif", is_data=True)[0])
    at = data.index(b"colrnclx") + 8
    (tmp_path / "b.avif").write_bytes(data[:at] + b"\0\x0c" + data[at + 2 :])
    assert apart(read_image(tmp_path / "b.avif")[0], decoded, "p3") < SAME
