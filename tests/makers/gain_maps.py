"""Write photos with gain maps, as phones do: a standard picture, and how much brighter its parts are on an HDR screen."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from pillow_heif import register_heif_opener

from tests.makers.profiles import DISPLAY_P3, gamma, matrix_profile

ADOBE = "http://ns.adobe.com/hdr-gain-map/1.0/"
APPLE = "urn:com:apple:photo:2020:aux:hdrgainmap"
ISO = b"urn:iso:std:iso:ts:21496:-1\0\0\0\0\0"
WIDTH, HEIGHT = 64, 48
CODE = 200, 100, 50  # of the whole picture, in Display P3 with a gamma of 2.2


def _xmp(name: str) -> bytes:
    described = f'<rdf:Description xmlns:hdrgm="{name}" hdrgm:Version="1.0"/>'
    return f'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">{described}</rdf:RDF>'.encode()


def _jpeg(first: dict, second: dict | None) -> Callable[[Path], None]:
    """Return a function that writes a JPEG. `first` and `second` are arguments of Pillow for its pictures; None for no second one."""

    def write(path: Path) -> None:
        picture = Image.new("RGB", (WIDTH, HEIGHT), CODE)
        profile = matrix_profile(DISPLAY_P3, gamma(2.2))
        small = io.BytesIO()
        Image.new("RGB", (WIDTH // 4, HEIGHT // 4), (255, 0, 255)).save(small, "JPEG", **second or {})
        others = {} if second is None else {"save_all": True, "append_images": [_Stored(small.getvalue())]}
        kind = "JPEG" if second is None else "MPO"
        picture.save(path, kind, icc_profile=profile, quality=98, **others, **first)

    return write


class _Stored(Image.Image):
    """Hold a JPEG that Pillow writes as it is, with its segments."""

    def __init__(self, data: bytes):
        super().__init__()
        self.data, self.encoderinfo = data, {}
        self._size = WIDTH // 4, HEIGHT // 4

    def save(self, file, *_, **__) -> None:
        file.write(self.data)


def _heic(change: Callable[[bytes], bytes], alpha: bool = False) -> Callable[[Path], None]:
    """Return a function that writes a HEIC and changes its bytes."""

    def write(path: Path) -> None:
        register_heif_opener()
        pixels = np.full((HEIGHT, WIDTH, 4), (*CODE, 128), np.uint8)[..., : 3 + alpha]
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, "HEIF", quality=95)
        path.write_bytes(change(data.getvalue()))

    return write


def _branded(data: bytes) -> bytes:
    """Put the brand of gain maps in the place of another."""
    assert b"miaf" in data[:32]
    return data.replace(b"miaf", b"tmap", 1)


def _auxiliary(data: bytes) -> bytes:
    """Name a HEIC's alpha as Apple names its gain map. The box meta grows, and is moved to the end, so that no offset changes."""
    old, new = b"urn:mpeg:hevc:2015:auxid:1", APPLE.encode()
    start = data.index(b"meta") - 4
    size = int.from_bytes(data[start : start + 4], "big")
    meta = bytearray(data[start : start + size])
    for kind in (b"meta", b"iprp", b"ipco", b"auxC"):
        at = meta.index(kind) - 4
        grown = int.from_bytes(meta[at : at + 4], "big") + len(new) - len(old)
        meta[at : at + 4] = grown.to_bytes(4, "big")
    return data[: start + 4] + b"free" + data[start + 8 :] + bytes(meta).replace(old, new)


_SEGMENT = b"\xff\xe2" + (len(ISO) + 2).to_bytes(2, "big") + ISO

# Functions that write a photo with a gain map, by what the photo is.
WITH = {
    "Ultra HDR.jpg": _jpeg({"xmp": _xmp(ADOBE)}, {"xmp": _xmp(ADOBE)}),
    "in XMP alone.jpg": _jpeg({"xmp": _xmp(ADOBE)}, None),
    "in the second's XMP.jpg": _jpeg({}, {"xmp": _xmp(ADOBE)}),
    "Apple.jpg": _jpeg({}, {"xmp": _xmp(APPLE)}),
    "ISO 21496-1.jpg": _jpeg({}, {"extra": _SEGMENT}),
    "Apple.heic": _heic(_auxiliary, alpha=True),
    "ISO 21496-1.heic": _heic(_branded),
}
WITHOUT = {
    "plain.jpg": _jpeg({}, None),
    "with a preview.jpg": _jpeg({}, {}),
    "plain.heic": _heic(bytes),
    "with alpha.heic": _heic(bytes, alpha=True),
}
