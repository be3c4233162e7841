"""Test that the names that a capture gives its files find them, however they are spelled."""

import os
import unicodedata

import numpy as np
import pytest
from PIL import Image

from refgs.capture import load_view, read_capture
from refgs.capture.files import Files, find_photos
from refgs.errors import InputError
from tests.makers.captures import edit, nerfstudio, write

UMLAUT = "Prüfstück 1"


@pytest.fixture
def folder(tmp_path):
    top = tmp_path / "capture"
    for name in (
        "images/0001.png",
        "images/cam1/0001.JPG",
        "masks/0001.png",
        "points/sparse_pc.ply",
        "images/render.0001.png",
    ):
        (top / name).parent.mkdir(parents=True, exist_ok=True)
        (top / name).touch()
    (top / "images" / f"{unicodedata.normalize('NFD', UMLAUT)}.png").touch()
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside" / "0002.png").touch()
    return top


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("images/0001.png", "images/0001.png"),
        ("./images/0001.png", "images/0001.png"),
        ("images/./0001.png", "images/0001.png"),
        ("images//0001.png", "images/0001.png"),
        (".\\images\\0001.png", "images/0001.png"),
        ("masks/../images/0001.png", "images/0001.png"),
        ("../capture/images/0001.png", "images/0001.png"),
        ("Images/0001.PNG", "images/0001.png"),
        ("images/0001", "images/0001.png"),
        ("images/0001.jpg", "images/0001.png"),
        ("images/CAM1/0001.jpg", "images/cam1/0001.JPG"),
        ("images/cam1/0001.heic", "images/cam1/0001.JPG"),
        (f"images/{UMLAUT}.png", f"images/{unicodedata.normalize('NFD', UMLAUT)}.png"),
        (f"images/{UMLAUT.upper()}", f"images/{unicodedata.normalize('NFD', UMLAUT)}.png"),
        ("images/render.0001", "images/render.0001.png"),
        ("images/render.0001.exr", "images/render.0001.png"),
        ("images/render", None),
        ("0001.png", "images/0001.png"),
        ("cam1/0001.jpg", "images/cam1/0001.JPG"),
        ("/home/else/scan/images/0001.png", "images/0001.png"),
        ("/home/else/scan/images/cam1/0001.jpg", "images/cam1/0001.JPG"),
        ("/home/else/photos/0001.png", "images/0001.png"),
        ("C:\\Users\\else\\images\\cam1\\0001.jpg", "images/cam1/0001.JPG"),
        ("c:/photos/0001.png", "images/0001.png"),
        ("\\\\server\\share\\0001.png", "images/0001.png"),
        ("../../else/images/0001.png", "images/0001.png"),
        ("../beside/0002.png", "../beside/0002.png"),
        ("images/0002.png", None),
        ("images", None),
        ("images/0001.png/..", None),
    ],
)
def test_names_find_their_files(folder, name, found):
    file = Files(folder).find(name, "images")
    assert file == (None if found is None else folder / found)
    assert file is None or file.is_file()


def test_absolute_names_of_this_machine(folder, monkeypatch):
    files = Files(folder)
    assert files.find(str(folder / "images" / "0001.png")) == folder / "images" / "0001.png"
    assert files.find(str(folder.parent / "beside" / "0002.png")) == folder.parent / "beside" / "0002.png"
    monkeypatch.chdir(folder)
    assert (
        Files(folder.relative_to(folder)).find(str(folder / "images" / "0001"))
        == folder.relative_to(folder) / "images/0001.png"
    )


def test_other_kinds_of_files_keep_their_suffix(folder):
    files = Files(folder)
    assert files.find("Points\\Sparse_PC.ply", suffixes=False) == folder / "points" / "sparse_pc.ply"
    assert files.find("/else/points/sparse_pc.ply", suffixes=False) == folder / "points" / "sparse_pc.ply"
    assert files.find("points/sparse_pc", suffixes=False) is None
    assert files.find("/else/0001.png", "masks") == folder / "masks" / "0001.png"


def test_the_exact_name_is_preferred(folder):
    for name in ("a.png", "A.png", "a.PNG", "b.exr", "b.jpg"):
        (folder / name).touch()
    files = Files(folder)
    for name, found in (("a.png", "a.png"), ("A.png", "A.png"), ("a.PNG", "a.PNG"), ("a", "A.png"), ("b", "b.jpg")):
        assert files.find(name) == folder / found
    assert files.find("b.exr") == folder / "b.exr"


def test_folders_are_listed_once(tmp_path, monkeypatch):
    """Check how often a capture's folders are listed. Photos are not looked at one by one."""
    folder = nerfstudio(tmp_path / "capture", 40)
    for i in range(40):
        write(folder / "masks" / f"{i:04d}.png", np.full((48, 64), 255 * (i % 2), np.uint8))
    listed, scandir = [], os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: listed.append(path) or scandir(path))
    monkeypatch.setattr(os.path, "isfile", lambda path: pytest.fail(f"looked for {path}"))
    assert len(read_capture(folder).views) == 40
    assert len(listed) < 12


def renamed(frames: list[dict]) -> None:
    spellings = ["./{}", ".\\{}", "images/../{}", "/home/else/{}", "D:\\scans\\{}"]
    for number, frame in enumerate(frames):
        frame["file_path"] = spellings[number % 5].format(frame["file_path"])
        if number % 3 == 0:
            frame["file_path"] = frame["file_path"].upper()
        if number % 4 == 0:
            frame["file_path"] = frame["file_path"][:-4] + ".jpeg"


def test_a_capture_whose_names_are_spelled_otherwise(tmp_path):
    before = read_capture(nerfstudio(tmp_path))
    edit(tmp_path / "transforms.json", lambda data: renamed(data["frames"]))
    after = read_capture(tmp_path)
    assert [v.image_path for v in after.views] == [v.image_path for v in before.views]
    assert after.fingerprint() == before.fingerprint() and not after.warnings


@pytest.mark.parametrize(
    "other",
    ["./images/../images/0000.png", "IMAGES/0000.png", "images/0000", "/else/images/0000.png", "images\\0000.jpg"],
)
def test_one_photo_by_two_names_is_one_photo(tmp_path, other):
    folder = nerfstudio(tmp_path)
    edit(folder / "transforms.json", lambda data: data["frames"].append(data["frames"][0] | {"file_path": other}))
    with pytest.raises(InputError, match=r"0000\.png: the capture names this photo 2 times"):
        read_capture(folder)


def test_lists_of_photos_spell_them_otherwise(tmp_path):
    folder = nerfstudio(tmp_path)

    def split(data):
        data["train_filenames"] = [f"./images/{i:04d}.PNG" for i in range(10)]
        data["test_filenames"] = ["/else/images/0012.png", "images\\0013.png"]

    edit(folder / "transforms.json", split)
    capture = read_capture(folder)
    assert [view.camera.name for view in capture.train_views] == [f"{i:04d}" for i in range(10)]
    assert [view.camera.name for view in capture.test_views] == ["0012", "0013"]


def test_a_mask_named_by_another_machine(tmp_path):
    folder = nerfstudio(tmp_path)

    def mask(data):
        for i, frame in enumerate(data["frames"]):
            write(folder / "masks" / f"{i:04d}.png", np.full((48, 64), 255 if i else 0, np.uint8))
            frame["mask_path"] = f"C:\\else\\{i:04d}.png"

    edit(folder / "transforms.json", mask)
    views = read_capture(folder).views
    assert [view.mask_path for view in views] == [folder / "masks" / f"{i:04d}.png" for i in range(16)]


def test_photos_in_subfolders(tmp_path):
    for name in ("cam2/IMG_1.jpg", "cam1/IMG_2.avif", "cam1/IMG_1.jfif", "IMG_0.JPG", "cam1/deep/a.png"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "images" / name).touch()
    for name in (
        ".cache/a.jpg",
        "._IMG_0.JPG",
        "masks/IMG_0.png",
        "cam1/Mask/IMG_1.png",
        "__MACOSX/IMG_0.JPG",
        "Thumbs.db",
        "cam1/._IMG_1.jfif",
        ".DS_Store",
    ):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "images" / name).touch()
    (tmp_path / "images" / "circle").symlink_to(tmp_path / "images")
    found = [path.relative_to(tmp_path / "images").as_posix() for path in find_photos(tmp_path)]
    assert found == ["IMG_0.JPG", "cam1/IMG_1.jfif", "cam1/IMG_2.avif", "cam1/deep/a.png", "cam2/IMG_1.jpg"]


def test_where_photos_are_looked_for(tmp_path):
    (tmp_path / "a.jpg").touch()
    (tmp_path / "images").mkdir()
    assert find_photos(tmp_path) == [tmp_path / "a.jpg"]  # for the folder images is empty
    (tmp_path / "Input").mkdir()
    (tmp_path / "Input" / "b.jpg").touch()
    assert find_photos(tmp_path) == [tmp_path / "Input" / "b.jpg"]
    (tmp_path / "images" / "c.webp").touch()
    assert find_photos(tmp_path) == [tmp_path / "images" / "c.webp"]


def test_masks_beside_photos_are_no_photos(tmp_path):
    photos = ["0001.jpg", "0002.jpg", "0003.jpg", "mask_9.jpg", "my_alpha.png"]
    for name in (*photos, "0001_alpha.png", "0002.jpg.mask.png", "mask_0003.png"):
        (tmp_path / name).touch()
    assert [path.name for path in find_photos(tmp_path)] == photos


def test_photos_in_other_folders_are_named(tmp_path):
    for camera in ("cam1", "cam2"):
        write(tmp_path / camera / "0001.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(InputError, match="is not a capture, but there are photos in 2 folders, first cam1"):
        read_capture(tmp_path)


@pytest.mark.parametrize("suffix", [".avif", ".jfif", ".jp2", ".tga"])
def test_every_format_that_is_read_is_found(tmp_path, suffix):
    folder = nerfstudio(tmp_path)
    for path in sorted((folder / "images").iterdir()):
        with Image.open(path) as picture:
            picture.save(path.with_suffix(suffix), "JPEG" if suffix == ".jfif" else None)
        path.unlink()
    assert len(find_photos(folder)) == 16
    views = read_capture(folder).views  # named .png in the file
    assert {view.image_path.suffix for view in views} == {suffix} and load_view(views[0]).image.shape == (48, 64, 3)


def test_points_of_another_machine(tmp_path):
    folder = nerfstudio(tmp_path)
    rows = "\n".join(f"{x} {y} 0" for x in range(3) for y in range(3))
    header = (
        "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (folder / "Sparse_PC.ply").write_text(header + rows + "\n")
    edit(folder / "transforms.json", lambda data: data.update(ply_file_path="/else/where/sparse_pc.ply"))
    assert read_capture(folder).points.shape == (9, 3)
