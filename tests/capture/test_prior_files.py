"""Test how files of normals and depth from other programs are found and read."""

import cv2
import numpy as np
import pytest

from refgs.capture import load_depth, load_normals, read_capture
from refgs.capture.check import describe
from refgs.errors import InputError
from refgs.formats.exr import write_exr
from tests.makers.captures import colmap, edit, nerf_blender, nerfstudio
from tests.makers.priors import encoded

WIDTH, HEIGHT = 64, 48


def chosen(folder) -> dict[str, str]:
    """Return the files of normals that views have, by the photo's name."""
    views = read_capture(folder).views
    return {v.camera.name: v.prior_normals.name for v in views if v.prior_normals is not None}


def touch(folder, *names) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def first(folder):
    """Return the first training view."""
    return read_capture(folder).train_views[0]


def slopes(width=WIDTH, height=HEIGHT) -> np.ndarray:
    """Make smooth unit normals (H, W, 3) that lean to all sides: x right, y up, z to the camera."""
    y, x = np.meshgrid(np.linspace(0.7, -0.7, height), np.linspace(-0.6, 0.6, width), indexing="ij")
    return np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(1 + x**2 + y**2)[..., None]


def put(folder, name, values) -> None:
    """Write the file `name` for the first photo, in the format of its suffix."""
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".exr":
        write_exr(path, values)
    elif path.suffix == ".npz":
        np.savez_compressed(path, depth=values)
    elif path.suffix == ".npy":
        np.save(path, values)
    else:
        cv2.imwrite(str(path), values)


def test_files_have_their_photos_names_and_words_that_programs_append(tmp_path):
    nerfstudio(tmp_path)
    names = "0001.png", "0002_pred.npy", "0003_normals.png", "0004-dpt_large.png", "0005.png.png", "images/0006.exr"
    touch(tmp_path / "normals", *names, "0007.txt", "notes.png", "0008.png")
    held_out = {view.camera.name for view in read_capture(tmp_path).test_views}
    assert "0008" in held_out
    assert chosen(tmp_path) == {f"000{i}": name.split("/")[-1] for i, name in enumerate(names, start=1)}


def test_other_spellings_of_names(tmp_path):
    folder = nerfstudio(tmp_path)
    (folder / "images" / "0003.png").rename(folder / "images" / "Ü_3.png")
    edit(folder / "transforms.json", lambda data: data["frames"][3].update(file_path="images/Ü_3.png"))
    touch(folder, "Normals/U\u0308_3_pred.npy", "Normals/._0002.npy")
    views = read_capture(folder).views
    assert {v.image_path.name: v.prior_normals for v in views if v.prior_normals} == {
        "Ü_3.png": folder / "Normals" / "U\u0308_3_pred.npy"
    }


def test_exact_files_are_taken_before_pictures_of_them(tmp_path):
    nerfstudio(tmp_path)
    touch(tmp_path / "normals", "0001.jpg", "0001.npz", "0002_normals.png", "0002.png")
    assert chosen(tmp_path) == {"0001": "0001.npz", "0002": "0002.png"}


def test_files_lie_beside_the_photos_folder(tmp_path):
    colmap(tmp_path / "colmap")
    touch(tmp_path / "colmap" / "normals", "0001.png")
    assert chosen(tmp_path / "colmap") == {"0001": "0001.png"}
    nerf_blender(tmp_path / "blender")  # r_0 is also the name of a held-out photo
    touch(tmp_path / "blender" / "normals", "r_0.png", "train/r_1.png", "test/r_2.png")
    assert chosen(tmp_path / "blender") == {"r_0": "r_0.png", "r_1": "r_1.png"}


@pytest.mark.parametrize(
    ("name", "write_as", "tolerance"),
    [
        ("a.png", encoded, 0.01),
        ("a.png", lambda n: np.rint((n[..., ::-1] + 1) * 32767.5).astype(np.uint16), 1e-3),
        ("a.exr", lambda n: n, 1e-3),
        ("a.exr", lambda n: (n + 1) / 2, 1e-3),
        ("a.npy", lambda n: n.transpose(2, 0, 1)[None], 1e-3),
        ("a.npy", lambda n: np.rint((n + 1) * 127.5).astype(np.uint8), 0.01),
    ],
    ids=["8 bits", "16 bits", "exr", "encoded exr", "channels first", "integers"],
)
def test_normals_are_read_from_each_format(tmp_path, name, write_as, tolerance):
    nerfstudio(tmp_path)
    put(tmp_path, f"normals/0001{name[1:]}", write_as(slopes()))
    prior = load_normals(first(tmp_path))
    assert prior.known.all() and prior.values.dtype == np.float32
    np.testing.assert_allclose(prior.values, slopes(), atol=tolerance)


def test_black_pixels_and_transparent_ones_are_not_known(tmp_path):
    nerfstudio(tmp_path)
    normals = slopes()
    normals[:, :20] = 0
    picture = np.dstack([encoded(normals), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    picture[:, 50:, 3] = 0
    put(tmp_path, "normals/0001.png", picture)
    prior = load_normals(first(tmp_path))
    assert prior.known[:, 20:50].all() and not prior.known[:, :20].any() and not prior.known[:, 50:].any()
    assert not prior.values[~prior.known].any()


@pytest.mark.parametrize("scale", [0.5, 2, 20])
def test_files_of_another_size_have_the_photos_camera(tmp_path, scale):
    nerfstudio(tmp_path)
    put(tmp_path, "normals/0001.exr", slopes(int(scale * WIDTH), int(scale * HEIGHT)))
    prior, view = load_normals(first(tmp_path)), first(tmp_path)
    height, width = prior.known.shape
    assert (width, height) == (prior.camera.width, prior.camera.height) and width <= WIDTH
    assert prior.camera.fx / prior.camera.width == pytest.approx(view.camera.fx / view.camera.width)
    np.testing.assert_allclose(prior.values, slopes(width, height), atol=0.02)


def test_files_are_undistorted_as_their_photos(tmp_path):
    nerfstudio(tmp_path)
    edit(tmp_path / "transforms.json", lambda data: data.update(k1=0.3, k2=0.05))
    view = first(tmp_path)
    straight = slopes().astype(np.float32)
    distorted = cv2.remap(
        straight, *view.lens.maps_back(view.camera), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    put(tmp_path, "normals/0001.exr", distorted)
    prior = load_normals(first(tmp_path))
    inner = slice(3, -3), slice(3, -3)
    assert np.abs(prior.values - straight)[inner].max() < 0.01 < np.abs(distorted - straight)[inner].max()


@pytest.mark.parametrize("name", ["a.png", "a.npy", "a.npz", "a.exr", "a.tif"])
def test_depth_is_read_from_each_format(tmp_path, name):
    nerfstudio(tmp_path)
    depth = np.tile(np.linspace(0.2, 0.9, WIDTH, dtype=np.float32), (HEIGHT, 1))
    depth[:10] = 0
    put(tmp_path, f"depth/0001{name[1:]}", np.rint(65535 * depth).astype(np.uint16) if name == "a.png" else depth)
    prior = load_depth(first(tmp_path))
    np.testing.assert_allclose(prior.values, depth, atol=1e-4)
    assert prior.known[10:].all() and not prior.known[:10].any()


def test_unknown_depth_does_not_mix_with_known_one(tmp_path):
    nerfstudio(tmp_path)
    edit(tmp_path / "transforms.json", lambda data: data.update(k1=0.3, k2=0.05))
    depth = np.zeros((3 * HEIGHT, 3 * WIDTH), np.float32)
    depth[20:, 31:] = 2.0
    put(tmp_path, "depth/0001.npy", depth + np.linspace(0, 0.1, 3 * WIDTH, dtype=np.float32) * (depth > 0))
    prior = load_depth(first(tmp_path))
    assert prior.known.any() and prior.values[prior.known].min() >= 2 - 1e-4 and not prior.values[~prior.known].any()


RAINBOW = cv2.applyColorMap(np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1)), cv2.COLORMAP_TURBO)


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("normals/0001.png", encoded(slopes(48, 48)), "48×48 pixels, which is not the shape of the photo .64×48."),
        ("normals/0001.png", np.zeros((48, 64, 3), np.uint8), "no normals in it"),
        ("normals/0001.npy", np.zeros((48, 64, 2)), "48×64×2 is no map of 3 numbers"),
        ("normals/0001.exr", np.zeros((48, 64)), "1 channels where there should be 3"),
        ("depth/0001.png", RAINBOW, "false colours"),
        ("depth/0001.npy", np.ones((48, 64)), "no depth in it"),
        ("depth/0001.npy", 1 + slopes(32, 48)[..., 0], "32×48 pixels"),
        ("normals/0001.npy", np.zeros((0, 0, 3)), "an array of 0×0×3 is no map of 3 numbers"),
        ("depth/0001.npy", np.zeros((0, 4)), "an array of 0×4 is no map of 1 numbers"),
    ],
)
def test_files_that_do_not_fit_are_refused(tmp_path, name, values, says):
    nerfstudio(tmp_path)
    put(tmp_path, name, values)
    with pytest.raises(InputError, match=f"0001.*{says}"):
        load_normals(first(tmp_path)) or load_depth(first(tmp_path))


@pytest.mark.parametrize("name", ["normals/0001.png", "normals/0001.exr", "depth/0001.npy", "depth/0001.npz"])
def test_broken_files_are_refused(tmp_path, name):
    nerfstudio(tmp_path)
    touch(tmp_path, name)
    with pytest.raises(InputError, match=name):
        load_normals(first(tmp_path)) or load_depth(first(tmp_path))
    with pytest.raises(InputError, match=name):
        describe(read_capture(tmp_path))


def test_the_check_counts_them(tmp_path):
    nerfstudio(tmp_path)
    assert not any("Normals" in line or "Depth" in line for line in describe(read_capture(tmp_path)))
    for name in ("0001", "0003"):
        put(tmp_path, f"normals/{name}.png", encoded(slopes()))
    put(tmp_path, "depth/0001.npy", 1.0 + slopes()[..., 0])
    lines = describe(read_capture(tmp_path))
    assert "Normals: for 2 of 14 views to train on" in lines and "Depth: for 1 of 14 views to train on" in lines


def test_files_that_the_cameras_name(tmp_path):
    """Check nerfstudio's depth: 16 bits, millimetres, 0 is unknown. Names may be another machine's; other files are ignored."""
    nerfstudio(tmp_path)
    depth = np.tile(np.linspace(1500, 3500, WIDTH).astype(np.uint16), (HEIGHT, 1))
    depth[:10] = 0
    put(tmp_path, "sensor/a.png", depth)
    put(tmp_path, "sensor/b.tiff", depth.astype(np.float32))
    put(tmp_path, "n/a.png", encoded(slopes()))
    touch(tmp_path, "depth/0001.png", "depth/0004.npy", "normals/0002.png", "sensor/c.npy.gz")

    def name_them(data):
        for number, name in (
            (1, "./sensor/a.png"),
            (2, "/data/them/Sensor/b.tiff"),
            (3, "sensor/c.npy.gz"),
            (8, "sensor/a.png"),
        ):
            data["frames"][number]["depth_file_path"] = name
        data["frames"][1]["normal_file_path"] = "n/a.png"
        data["frames"][5]["depth_file_path"] = "/data/images/0005.png"  # a photo is no depth
        data["frames"][6]["normal_file_path"] = None

    edit(tmp_path / "transforms.json", name_them)
    capture = read_capture(tmp_path)
    views = {view.camera.name: view for view in capture.views}
    assert {name: view.prior_depth.name for name, view in views.items() if view.prior_depth} == {
        "0001": "a.png",
        "0002": "b.tiff",
        "0004": "0004.npy",
    }
    assert {name: view.prior_normals.parent.name for name, view in views.items() if view.prior_normals} == {
        "0001": "n",
        "0002": "normals",
    }
    assert capture.warnings == [
        "2 of the 6 files of depth or normals that transforms.json names are missing, or of a format that is not read: "
        "first sensor/c.npy.gz"
    ]
    for name, unit in (("0001", 65535), ("0002", 1)):
        prior = load_depth(views[name])
        np.testing.assert_allclose(prior.values * unit, depth, atol=0.01)
        assert prior.known[10:].all() and not prior.known[:10].any()
