"""List every kind of file and stream that the trainer reads: a valid sample, and how it is read."""

import json
import tempfile
from collections.abc import Callable
from functools import cache
from io import BytesIO, StringIO
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import tifffile
from PIL import Image
from pillow_heif import from_bytes, register_heif_opener
from plyfile import PlyData, PlyElement

from benchmarks.scenes.analytic import write_ball_capture
from refgs.batch import batch
from refgs.batch.listing import Ask, read_jobs
from refgs.batch.steps import Step, recorded
from refgs.camera import Camera
from refgs.capture import cached, load_depth, load_normals, masks, read_cameras, read_capture, read_run_cameras
from refgs.capture.check import describe
from refgs.capture.files import photo_view
from refgs.capture.images import load_view, read_codes, read_focal_length, read_header, read_mask
from refgs.capture.nerf_blender import read_nerf_blender
from refgs.capture.nerfstudio import read_nerfstudio
from refgs.capture.nero import read_nero
from refgs.capture.salience import SalienceModel
from refgs.capture.stanford_orb import novel_views
from refgs.capture.tensoir import read_tensoir
from refgs.capture.types import View
from refgs.capture.video import extract_photos
from refgs.compare.published import StanfordORBTruth
from refgs.compare.truth import GroundTruth
from refgs.formats import colmap as colmap_files
from refgs.formats import history
from refgs.formats.exr import write_exr
from refgs.formats.gltf import read_glb
from refgs.formats.hints import Hint, read_hints, write_hints
from refgs.formats.mesh import read_mesh, write_mesh
from refgs.formats.metrics import read_metrics
from refgs.formats.needs import Needs
from refgs.formats.panorama import read_environment
from refgs.formats.splats import read_splats, write_display_splats, write_splats
from refgs.formats.spz import read_spz, write_spz
from refgs.formats.validate import read_json
from refgs.geometry.visibility import Occluder
from refgs.lock import PROGRESS
from refgs.paths import write_text
from refgs.report.page import write_report
from refgs.run import open_run
from refgs.run_folder import read_run_facts
from refgs.settings import load_settings
from refgs.train.keep import snapshot
from refgs.worker import Worker
from tests.makers import captures
from tests.makers.ball import BOX, write_run
from tests.makers.captures import ring
from tests.makers.dng import write_dng
from tests.makers.films import film_ball
from tests.makers.models import write_model
from tests.makers.profiles import DISPLAY_P3, gamma, matrix_profile, table_profile
from tests.makers.splats import make
from tests.makers.spz import write_spz_2
from tests.makers.training import TINY, trained, trainer

CAMERA = Camera("a", 16, 12, 15.0, 15.0, 8.0, 6.0, np.linalg.inv(ring(1)[0] @ captures.FLIP))
PHOTO = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
P3 = matrix_profile(DISPLAY_P3, gamma(2.2))
TABLES = table_profile(b"RGB ", 3, lambda corner: (sum(corner) * 33, 0, 0))


class Reader(NamedTuple):
    """Read one kind of file.

    - `make` writes a valid sample into an empty folder.
    - `file` is the damaged one of its files, of the `kind` that `tests.makers.mutants` names; or a folder, whose kind is "folder".
    - `read` reads it from the folder. It may raise InputError.
    - `share` is how often it is tried, beside others: fast readers more often.
    """

    make: Callable[[Path], object]
    file: str
    kind: str
    read: Callable[[Path], object]
    share: float = 1.0


def _photo(suffix: str, write: Callable[[Path], object] | None = None, share: float = 1.0) -> Reader:
    """Read a photo of an image format: its header, its focal length and its pixels."""

    def read(folder: Path) -> None:
        file = folder / f"a{suffix}"
        read_header(file)
        read_focal_length(file)
        read_codes(file)

    return Reader(
        lambda folder: (write or (lambda file: captures.write(file, PHOTO)))(folder / f"a{suffix}"),
        f"a{suffix}",
        "bytes",
        read,
        share,
    )


def _pillow(image: np.ndarray, **options) -> Callable[[Path], None]:
    register_heif_opener()
    return lambda file: Image.fromarray(image).save(file, **options)


def _planes(file: Path) -> None:
    planes = np.ascontiguousarray(np.moveaxis(PHOTO.astype(np.uint16) * 257, -1, 0))
    tifffile.imwrite(file, planes, photometric="rgb", planarconfig="separate", metadata=None)


def _ten_bits(file: Path) -> None:
    from_bytes(mode="RGB;16", size=(16, 12), data=(PHOTO.astype(np.uint16) * 257).tobytes()).save(file)


def _view(folder: Path, **fields) -> View:
    return View(CAMERA, folder / "a.png", None, "train", **fields)


def _saved(name: str, values: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: (np.savez if name.endswith("z") else np.save)(folder / name, values)


def _small(make: Callable[..., Path], *options, **more) -> Callable[[Path], Path]:
    return lambda folder: make(folder / "capture", *options, **more)


def _points(folder: Path) -> None:
    captures.nerfstudio(folder / "capture", 4)
    rows = np.zeros(9, [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")])
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "capture" / "points.ply"))
    captures.edit(folder / "capture" / "transforms.json", lambda data: data.update(ply_file_path="points.ply"))


def _colmap(name: str, binary: bool) -> Reader:
    end = "bin" if binary else "txt"
    read = getattr(colmap_files, f"read_{'points' if name == 'points3D' else name}")
    file = f"capture/sparse/0/{name}.{end}"
    return Reader(
        _small(captures.colmap, binary, count=4), file, "bytes" if binary else "text", lambda f: read(f / file)
    )


def _cached(folder: Path) -> None:
    captures.nerfstudio(folder / "capture", 4)
    _read_cached(folder)
    next((folder / "photos").glob("*.image.*")).rename(folder / "image.npy")


def _read_cached(folder: Path) -> None:
    """Load photos that are cached, one of which is damaged."""
    views, before = read_capture(folder / "capture").views, cached.LARGE
    cached.LARGE = 0
    try:
        if (folder / "image.npy").is_file() and not (folder / "image.npy").is_symlink():
            next((folder / "photos").glob("*.image.*")).write_bytes((folder / "image.npy").read_bytes())
        cached.load_views(views, 32, folder / "photos")
    finally:
        cached.LARGE = before


def _ply_splats(suffix: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        file = folder / "a.ply"
        (write_display_splats if suffix == "3dgs" else write_splats)(file, make(5, 4, 4 if suffix == "ours" else 0))
        if suffix == "text":
            data = PlyData.read(str(file), mmap=False)
            data.text = True
            data.write(str(file))

    return write


def _film(folder: Path) -> None:
    film_ball(folder / "a.mp4", 8, 160, 120)


def _read_film(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as out:
        extract_photos(folder / "a.mp4", Path(out) / "photos", 5, lambda event, facts: None)


def _run(folder: Path) -> None:
    captures.nerf_blender(folder / "capture", {"train": 4, "test": 1})
    write_run(folder / "run", read_capture(folder / "capture"))
    write_mesh(folder / "run" / "occluder.ply", _box())
    (folder / "run" / "metrics.json").write_text(json.dumps(METRICS))
    (folder / "run" / "needs.json").write_text(json.dumps(NEEDS))
    (folder / "run" / "history.jsonl").write_text("".join(json.dumps(line) + "\n" for line in HISTORY))
    for kind in ("on", "off", "photo"):
        captures.write(folder / "run" / "needs" / f"{kind}.png", PHOTO)
    captures.write(folder / "run" / "pictures" / "test" / "color" / "a.png", PHOTO)


def _box():
    from refgs.formats.mesh import Mesh

    return Mesh(np.array(BOX.vertices), np.array(BOX.faces))


METRICS = {
    "psnr": 29.6, "ssim": 0.94, "seconds": 431.2, "splats": 19832, "split": "test", "lpips": None,
    "relight": {"studio": {"mesh": {"psnr_raw": 20.7, "flip_raw": 0.1}}}, "mesh": {"chamfer": 0.01},
    "doubt": {"part": 0.1, "what": "photos do not tell"}, "ambiguities": {"light": {"alone": 0.1, "what": "the light"}},
}  # fmt: skip
SHOWN = {kind: f"needs/{kind}.png" for kind in ("on", "off", "photo")} | {
    "view": "a",
    "psnr_on": 31.2,
    "psnr_off": 28.1,
}
NEEDS = [
    {"need": "specular", "what": "specular shading", "why": "it shines", "needed": True, "pictures": SHOWN},
    {"what": "exposures", "why": "they agree", "saved": "3 numbers"},
]
HISTORY = [
    {"iteration": 10 * n, "seconds": 1.5 * n, "loss": 1 / n, "psnr_train": 20.0 + n, "psnr_test": 19.0 + n, "flip_test": 0.2 / n,
     "splats": 900, "parts": {"raster": 0.5 * n, "other": float(n)}}
    for n in range(1, 7)
]  # fmt: skip


def _run_file(name: str, kind: str, read: Callable[[Path], object], share: float = 1.0) -> Reader:
    return Reader(_run, f"run/{name}", kind, lambda folder: read(folder / "run" / name), share)


def _whole_run(name: str, kind: str) -> Reader:
    return Reader(_run, f"run/{name}", kind, lambda folder: open_run(folder / "run"), 0.1)


def _reported(name: str, kind: str) -> Reader:
    def make(folder: Path) -> None:
        _run(folder)
        if name != history.FILE:  # its charts take most of the time
            (folder / "run" / history.FILE).unlink()

    return Reader(
        make,
        f"run/{name}",
        kind,
        lambda folder: write_report([folder / "run"], folder / "report.html"),
        0.05 if name != history.FILE else 0.01,
    )


@cache
def _training() -> object:
    """Make a training that is ready to take over checkpoints, once."""
    folder = Path(tempfile.mkdtemp())
    write_ball_capture(folder / "capture", 32, samples=1)
    return trainer(folder / "capture", folder / "run", *TINY, total=4)


def _checkpoint(folder: Path) -> None:
    made = trained(_training().state.capture, folder / "run", *TINY, total=4)
    made.save()
    (note,) = (folder / "run" / "checkpoints").glob("*.toml")
    for file in (note, note.with_suffix(".safetensors")):
        file.rename(file.with_stem("00000004"))


def _truth(folder: Path) -> None:
    for name, channels in {"normal": 3, "alpha": 1, "roughness": 1}.items():
        (folder / name).mkdir()
        write_exr(folder / name / "a.exr", np.full((12, 16, channels), 0.5, np.float32).squeeze())


def _stream(file: Path) -> str:
    """Read what comes by a stream, or by the command line. Neither is a link or a folder."""
    return "" if file.is_symlink() or file.is_dir() else file.read_text(encoding="utf-8", errors="surrogateescape")


COMMANDS = [
    {"command": "check", "capture": "a", "out": "b"},
    {
        "command": "train",
        "capture": "a",
        "out": "b",
        "minutes": 3.0,
        "settings": ["train.iterations=3"],
        "resume": False,
    },
    {"command": "export", "run": "a", "texture": 512},
    {"command": "pause"},
    {"command": "keep", "on": True},
]


def _listed(folder: Path) -> None:
    for name in ("cup", "jar"):
        (folder / name).mkdir()
    (folder / "more.toml").write_text('[[captures]]\nfolder = "jar"\nname = "pot"\n')
    lines = 'set = ["train.seed=1"]', 'include = ["more.toml"]', "minutes = 3.0"
    tables = '[[settings]]\nname = "fast"\npreset = "quick"', '[[captures]]\nfolder = "cup"\nset = ["train.seed=2"]'
    (folder / "list.toml").write_text("\n".join((*lines, *tables)))


def _made(folder: Path) -> None:
    (folder / "masks").mkdir()
    (folder / "masks" / "made.json").write_text(json.dumps(["a" * 64]))


def _pair(folder: Path) -> None:
    captures.nero(folder / "capture", 4, (["0"], ["1", "2", "3"]))


def _read_capture(folder: Path) -> None:
    """Read a capture as `refgs check` does, which loads all photos."""
    describe(read_capture(folder / "capture"))


def _folder(make: Callable[..., Path], *options, **more) -> Reader:
    return Reader(_small(make, *options, **more), "capture", "folder", _read_capture, 0.3)


def _with_masks_and_normals(folder: Path) -> Path:
    captures.nerfstudio(folder, 6)
    for photo in sorted((folder / "images").iterdir()):
        mask = np.zeros((48, 64), np.uint8)
        mask[12:36, 16:48] = 255
        captures.write(folder / "masks" / photo.name, mask)
        (folder / "normals").mkdir(exist_ok=True)
        normals = np.random.default_rng(0).normal(size=(48, 64, 3))
        np.save(folder / "normals" / f"{photo.stem}.npy", normals / np.linalg.norm(normals, axis=2, keepdims=True))
    return folder


READERS: dict[str, Reader] = {
    "a capture by nerfstudio": _folder(captures.nerfstudio, 6),
    "a capture with masks and normals": _folder(_with_masks_and_normals),
    "a capture by NeRF-Blender": _folder(captures.nerf_blender, {"train": 5, "test": 2}),
    "a capture by COLMAP, all files": _folder(captures.colmap, count=6),
    "a capture by COLMAP, all files as text": _folder(captures.colmap, False, count=6),
    "a capture of NeRO": _folder(captures.nero, 6),
    "a capture of TensoIR": _folder(captures.tensoir, {"train": 5, "test": 1}, 16),
    "nerfstudio's transforms.json": Reader(
        _small(captures.nerfstudio, 4), "capture/transforms.json", "json", lambda f: read_capture(f / "capture"), 0.5
    ),
    "a path of cameras": Reader(
        _small(captures.nerfstudio, 4), "capture/transforms.json", "json", lambda f: read_cameras(f / "capture" / "transforms.json")
    ),
    "transforms_train.json": Reader(
        _small(captures.nerf_blender, {"train": 4, "test": 1}),
        "capture/transforms_train.json", "json", lambda f: read_nerf_blender(f / "capture"),
    ),
    "transforms_novel.json": Reader(
        lambda f: captures.stanford_orb(f, side=16), "blender_HDR/ball_scene001/transforms_novel.json", "json",
        lambda f: novel_views(f / "blender_HDR" / "ball_scene001"),
    ),
    "TensoIR's metadata.json": Reader(
        _small(captures.tensoir, {"train": 2}, 16), "capture/train_000/metadata.json", "json", lambda f: read_tensoir(f / "capture")
    ),
    **{f"COLMAP's {name}, {'binary' if binary else 'text'}": _colmap(name, binary)
       for name in ("cameras", "images", "points3D") for binary in (True, False)},
    "a capture by COLMAP": Reader(
        _small(captures.colmap, False, count=4), "capture/sparse/0/images.txt", "text", lambda f: read_capture(f / "capture"), 0.5
    ),
    "NeRO's cameras": Reader(_pair, "capture/0-camera.pkl", "bytes", lambda f: read_nero(f / "capture")),
    "NeRO's split": Reader(_pair, "synthetic_split_128.pkl", "bytes", lambda f: read_nero(f / "capture")),
    "points of nerfstudio": Reader(_points, "capture/points.ply", "bytes", lambda f: read_nerfstudio(f / "capture")),
    "PNG": _photo(".png", share=2),
    "PNG, 16 bits": _photo(".png", lambda file: captures.write(file, PHOTO.astype(np.uint16) * 257)),
    "PNG with a palette": _photo(".png", lambda file: Image.fromarray(PHOTO).convert("P").save(file)),
    "JPEG": _photo(".jpg", lambda file: captures.write_as_phone(file, PHOTO, 1, 24), share=2),
    "TIFF": _photo(".tif", share=2),
    "TIFF, 16 bits": _photo(".tif", lambda file: captures.write(file, PHOTO.astype(np.uint16) * 257)),
    "TIFF in planes": _photo(".tif", _planes, 0.5),
    "PNG with a profile": _photo(".png", _pillow(PHOTO, icc_profile=P3)),
    "PNG with a profile of tables": _photo(".png", _pillow(PHOTO, icc_profile=TABLES), 0.5),
    "WebP": _photo(".webp"),
    "BMP": _photo(".bmp"),
    "HEIC": _photo(".heic", lambda file: captures.write_as_phone(file, PHOTO, 1, 24), 0.5),
    "HEIC, 10 bits": _photo(".heic", _ten_bits, 0.5),
    "AVIF": _photo(".avif", _pillow(PHOTO), 0.5),
    "DNG": _photo(".dng", lambda file: write_dng(file, np.full((32, 48, 3), 0.3), turns=1, film=24), 0.5),
    "EXR": _photo(".exr", lambda file: write_exr(file, PHOTO / 255), 2),
    "a mask": Reader(
        lambda f: captures.write(f / "a.png", PHOTO[..., 0]), "a.png", "bytes", lambda f: read_mask(f / "a.png", 0.5)
    ),
    "a photo and its camera": Reader(
        lambda f: captures.write(f / "a.png", PHOTO), "a.png", "bytes",
        lambda f: load_view(photo_view(f / "a.png", (CAMERA, None), "train", None, "a"), 8),
    ),
    "normals by NumPy": Reader(
        _saved("a.npy", PHOTO / 127.5 - 1), "a.npy", "bytes", lambda f: load_normals(_view(f, prior_normals=f / "a.npy")), 2
    ),
    "normals of a picture": Reader(
        lambda f: captures.write(f / "a.png", PHOTO), "a.png", "bytes", lambda f: load_normals(_view(f, prior_normals=f / "a.png"))
    ),
    "depth by NumPy": Reader(
        _saved("a.npz", PHOTO[..., 0] / 3.0), "a.npz", "bytes", lambda f: load_depth(_view(f, prior_depth=f / "a.npz"))
    ),
    "depth of an EXR": Reader(
        lambda f: write_exr(f / "a.exr", PHOTO[..., 0] / 3.0), "a.exr", "bytes", lambda f: load_depth(_view(f, prior_depth=f / "a.exr"))
    ),
    "depth of a TIFF": Reader(
        lambda f: captures.write(f / "a.tif", np.float32(PHOTO[..., 0])), "a.tif", "bytes",
        lambda f: load_depth(_view(f, prior_depth=f / "a.tif")),
    ),
    "maps of Stanford-ORB": Reader(
        lambda f: captures.stanford_orb(f, side=16), "ground_truth/ball_scene001/surface_normal/0000.npy", "bytes",
        lambda f: StanfordORBTruth(f / "blender_HDR" / "ball_scene001", np.eye(4)).maps(
            Camera("0000", 16, 16, 15.0, 15.0, 8.0, 8.0, np.eye(4))
        ),
    ),
    "ground truth": Reader(_truth, "normal/a.exr", "bytes", lambda f: GroundTruth(f, np.eye(4)).maps(CAMERA)),
    "photos that are cached": Reader(_cached, "image.npy", "bytes", _read_cached, 0.3),
    "masks that were made": Reader(
        _made, "masks/made.json", "json", masks._hashes,
    ),
    "splats": Reader(_ply_splats("ours"), "a.ply", "bytes", lambda f: read_splats(f / "a.ply"), 2),
    "splats of 3DGS": Reader(_ply_splats("3dgs"), "a.ply", "bytes", lambda f: read_splats(f / "a.ply")),
    "splats in SPZ": Reader(
        lambda f: write_spz(f / "a.spz", make(5, 4)), "a.spz", "bytes", lambda f: read_spz(f / "a.spz")
    ),
    "splats in SPZ of version 2": Reader(
        lambda f: write_spz_2(f / "a.spz", make(5, 4)), "a.spz", "bytes", lambda f: read_spz(f / "a.spz")
    ),
    "splats in text": Reader(_ply_splats("text"), "a.ply", "text", lambda f: read_splats(f / "a.ply")),
    "a mesh": Reader(
        lambda f: write_mesh(f / "a.ply", _box()), "a.ply", "bytes", lambda f: Occluder(read_mesh(f / "a.ply"))
    ),
    "a glTF mesh": Reader(lambda f: BOX.export(f / "a.glb"), "a.glb", "bytes", lambda f: read_glb(f / "a.glb")),
    "light, EXR": Reader(
        lambda f: write_exr(f / "a.exr", np.full((4, 8, 3), 0.5)), "a.exr", "bytes", lambda f: read_environment(f / "a.exr")
    ),
    "light, HDR": Reader(
        lambda f: cv2.imwrite(str(f / "a.hdr"), np.full((8, 16, 3), 0.5, np.float32)), "a.hdr", "bytes",
        lambda f: read_environment(f / "a.hdr"), 2,
    ),
    "a film": Reader(_film, "a.mp4", "bytes", _read_film, 0.05),
    "a model of masks": Reader(
        lambda f: write_model(f / "a.onnx", (8, 8)), "a.onnx", "bytes",
        lambda f: SalienceModel(f / "a.onnx")(PHOTO), 0.005,  # each starts a process
    ),
    "hints": Reader(
        lambda f: write_hints(f / "a.json", f, [Hint("metal", np.ones((2, 3)))]), "a.json", "json", lambda f: read_hints(f / "a.json")
    ),
    "run.toml": _run_file("run.toml", "toml", lambda file: read_run_facts(file.parent), 0.5),
    "cameras.json": _run_file("cameras.json", "json", read_run_cameras),
    "metrics.json": _run_file("metrics.json", "json", read_metrics),
    "needs.json": _run_file("needs.json", "json", lambda file: read_json(file, Needs, "")),
    **{f"a run's {name}": _whole_run(name, kind)
       for name, kind in {"run.toml": "toml", "cameras.json": "json", "splats.ply": "bytes", "occluder.ply": "bytes",
                          "environment.exr": "bytes"}.items()},
    **{f"{name}, reported": _reported(name, kind)
       for name, kind in {"run.toml": "toml", "metrics.json": "json", "needs.json": "json", "history.jsonl": "lines",
                          "needs/on.png": "bytes", "pictures/test/color/a.png": "bytes"}.items()},
    "a checkpoint's facts": Reader(
        _checkpoint, "run/checkpoints/00000004.toml", "toml", lambda f: snapshot.restore(_training().state, f / "run"), 0.1
    ),
    "a checkpoint's tensors": Reader(
        _checkpoint, "run/checkpoints/00000004.safetensors", "bytes", lambda f: snapshot.restore(_training().state, f / "run"), 0.1
    ),
    "a batch's list": Reader(
        _listed, "list.toml", "toml", lambda f: read_jobs(f / "list.toml", f / "runs", Ask()), 0.5
    ),
    "a batch's record of a step": Reader(
        lambda f: write_text(f / "a.json", json.dumps({"status": 0, "seconds": 3.5, "node": "a", "words": ["train", "b"]})),
        "a.json", "json", lambda f: recorded(Step("train", "b", ("train", "b"), f / "a.log")), 2,
    ),
    "a training's progress": Reader(
        lambda f: write_text(f / PROGRESS, json.dumps({"iteration": 3, "total": 10, "seconds_left": 4.5})), PROGRESS, "json",
        lambda f: batch._progress(f), 2,
    ),
    "a preset": Reader(
        lambda f: (f / "a.toml").write_text('base = "quick"\n[train]\niterations = 3\n[region]\nsize = [1, 2, 3]\n'),
        "a.toml", "toml", lambda f: load_settings(str(f / "a.toml")), 0.5,
    ),
    "--set": Reader(
        lambda f: (f / "a").write_text("region.size=[1, 2, 3]"), "a", "text", lambda f: load_settings("quick", [_stream(f / "a")]), 0.5
    ),
    "commands of a worker": Reader(
        lambda f: (f / "commands").write_text("".join(json.dumps(line) + "\n" for line in COMMANDS)), "commands", "lines",
        lambda f: Worker(StringIO()).listen(BytesIO(_stream(f / "commands").encode(errors="surrogateescape"))),
    ),
}  # fmt: skip
