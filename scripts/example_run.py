"""Make the run that the button Import Example imports: `python -m scripts.example_run FOLDER`.

The jar of `refgs demo` is photographed and trained small, in the new folder FOLDER. What the extension needs of the result is written to
refgs_addon/example/jar, without whatever names this machine. The extension stays small: that folder may have 300 kB.
"""

import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import drop_fields
from PIL import Image
from plyfile import PlyElement

from refgs.errors import InputError
from refgs.formats.exr import read_exr, write_exr
from refgs.formats.ply import read_ply, write_ply

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "refgs_addon" / "example" / "jar"
LARGEST = 300_000  # bytes of the example
PHOTOS = ("--size", "256", "--train", "60", "--test", "4")
SETTINGS = (
    "surfels.start=1800", "surfels.budget=2100", "image.max_side=256", "environment.resolution=16", "train.iterations=2500",
    "needs.reflections=off", "mesh.resolution=192", "mesh.triangles=2200", "mesh.texture=256",
)  # fmt: skip
LEFT_OUT = re.compile(r"f_rest_\d+|ind_\d+|received_[rgb]|doubt")  # columns of splats.ply that the add-on does not draw
SPLATS = 1750  # that are kept at most: the most opaque ones
BITS = 10  # of a number's mantissa that are kept: the rest is noise, which a zip cannot compress
QUALITY = {"baseColorTexture": 75, "metallicRoughnessTexture": 75, "normalTexture": 80}  # of the pictures, as JPEG
LIGHT_BITS = 7
COARSER = 2  # times along each side, of the light
EVERY = 8  # a camera of so many is kept


def main(folder: Path) -> None:
    capture, run = folder / "capture", folder / "run"
    if not capture.exists():
        _call("scripts.demo", "jar", "--out", capture, *PHOTOS)
    if not (run / "mesh.glb").exists():
        changes = [word for setting in SETTINGS for word in ("--set", setting)]
        _call("refgs.cli", "train", capture, "--out", run, "--preset", "quick", *changes)
        _call("refgs.cli", "export", run)
    shutil.rmtree(EXAMPLE, ignore_errors=True)
    EXAMPLE.mkdir(parents=True)
    shrink_run(run, EXAMPLE)
    sizes = {file.name: file.stat().st_size for file in sorted(EXAMPLE.iterdir())}
    print(*(f"{name}: {size:,} bytes" for name, size in sizes.items()), sep="\n")
    if sum(sizes.values()) > LARGEST:
        raise InputError(f"{EXAMPLE} has {sum(sizes.values()):,} bytes: it may have {LARGEST:,}")


def _call(module: str, *arguments: object) -> None:
    subprocess.run([sys.executable, "-m", module, *map(str, arguments)], cwd=ROOT, check=True)


def shrink_run(run: Path, out: Path) -> None:
    """Write into the folder `out` what Blender shows of a run, in few bytes."""
    data = read_ply(run / "splats.ply")
    rows = np.array(data["vertex"].data)
    rows = drop_fields(rows, [name for name in rows.dtype.names if LEFT_OUT.fullmatch(name)], usemask=False)
    rows = rows[np.sort(np.argsort(-rows["opacity"], kind="stable")[:SPLATS])]
    for name in rows.dtype.names:
        rows[name] = short(rows[name])
    write_ply(out / "splats.ply", [PlyElement.describe(rows, "vertex")], data.comments)
    light = read_exr(run / "environment.exr")
    height, width, channels = light.shape
    light = light.reshape(height // COARSER, COARSER, width // COARSER, COARSER, channels).mean(axis=(1, 3))
    write_exr(out / "environment.exr", short(light, LIGHT_BITS))
    (out / "mesh.glb").write_bytes(small_mesh((run / "mesh.glb").read_bytes()))
    cameras = json.loads((run / "cameras.json").read_text(encoding="utf-8"))
    cameras["frames"] = [
        {key: value for key, value in frame.items() if key not in ("photo", "mask")}
        for frame in cameras["frames"][::EVERY]
    ]
    (out / "cameras.json").write_text(json.dumps(cameras, separators=(",", ":")) + "\n", encoding="utf-8")
    # The photos are not there: a path would lead into another machine's folders.
    told = (run / "run.toml").read_text(encoding="utf-8")
    (out / "run.toml").write_text(re.sub(r'(?m)^capture = ".*"$', 'capture = ""', told), encoding="utf-8")


def short(values: np.ndarray, bits: int = BITS) -> np.ndarray:
    """Round float32 numbers to `bits` bits of their mantissas."""
    unused = 23 - bits
    whole = np.ascontiguousarray(values, "<f4").view("<u4").astype(np.uint64) + (1 << (unused - 1))
    return (whole >> unused << unused).astype("<u4").view("<f4")


def small_mesh(data: bytes) -> bytes:
    """Write a run's mesh.glb anew: without tangents, which Blender computes, with short indices, and with its pictures as JPEG."""
    length = int.from_bytes(data[12:16], "little")
    tree, buffer = json.loads(data[20 : 20 + length]), data[28 + length :]
    whole, views = bytearray(), []

    def part(number: int) -> bytes:
        view = tree["bufferViews"][number]
        start = view.get("byteOffset", 0)
        return buffer[start : start + view["byteLength"]]

    def add(new: bytes) -> int:
        views.append({"buffer": 0, "byteOffset": len(whole), "byteLength": len(new)})
        whole.extend(new + bytes(-len(new) % 4))
        return len(views) - 1

    primitive, accessors = tree["meshes"][0]["primitives"][0], []
    for name, number in [*primitive["attributes"].items(), (None, primitive["indices"])]:
        accessor = tree["accessors"][number]
        if name == "TANGENT":
            continue
        if name is None:
            accessor["bufferView"] = add(np.frombuffer(part(accessor["bufferView"]), "<u4").astype("<u2").tobytes())
            accessor["componentType"] = 5123
        else:
            values = short(np.frombuffer(part(accessor["bufferView"]), "<f4")).reshape(accessor["count"], -1)
            accessor["bufferView"] = add(values.tobytes())
            accessor["min"], accessor["max"] = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        accessor.pop("byteOffset", None)
        accessors.append(accessor)
    primitive["attributes"] = {
        name: place for place, name in enumerate(name for name in primitive["attributes"] if name != "TANGENT")
    }
    primitive["indices"] = len(accessors) - 1
    material, pictures = tree["materials"][0], []
    for key, quality in QUALITY.items():
        texture = material["pbrMetallicRoughness"].get(key) or material[key]
        old, picture = tree["images"][tree["textures"][texture["index"]]["source"]]["bufferView"], io.BytesIO()
        source = Image.open(io.BytesIO(part(old)))
        source.convert("RGB").save(picture, "JPEG", quality=quality, subsampling=0, optimize=True)
        new = {"bufferView": add(picture.getvalue()), "mimeType": "image/jpeg"}
        pictures += [(image, new) for image in tree["images"] if image["bufferView"] == old]
    for image, new in pictures:
        image |= new
    tree |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(whole)}]}
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [len(text).to_bytes(4, "little"), b"JSON", text, len(whole).to_bytes(4, "little"), b"BIN\0", bytes(whole)]
    size = 12 + sum(map(len, chunks))
    return b"".join([b"glTF", (2).to_bytes(4, "little"), size.to_bytes(4, "little"), *chunks])


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]).resolve())
    except InputError as error:
        sys.exit(str(error))
