"""Test that photos of a large capture are mapped from files, and read anew when the files no longer fit."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from refgs.capture import LoadedView, cached, load_view, load_views, read_capture, reduced_views, release_memory

SIDE = 40


@pytest.fixture
def views(sharp_ball, monkeypatch):
    """Return the views of a small capture, which then counts as large."""
    monkeypatch.setattr(cached, "LARGE", 0)
    return read_capture(sharp_ball).views[:6]


def mapped(array: np.ndarray) -> bool:
    """Tell whether an array's values lie in a file."""
    while array is not None and not isinstance(array, np.memmap):
        array = array.base
    return array is not None


def check_same(one, other):
    np.testing.assert_array_equal(one.image, other.image)
    np.testing.assert_array_equal(one.alpha, other.alpha)
    assert one.white == other.white and one.camera.width == other.camera.width and one.camera.fx == other.camera.fx


def test_large_photos_are_mapped_and_not_read_again(views, tmp_path, monkeypatch):
    folder = tmp_path / "run" / "photos"
    first = load_views(views, SIDE, folder)
    for view, loaded in zip(views, first, strict=True):
        assert mapped(loaded.image) and mapped(loaded.alpha)
        check_same(loaded, load_view(view, SIDE))
    monkeypatch.setattr(cached, "load_view", None)
    for one, other in zip(first, load_views(views, SIDE, folder), strict=True):
        check_same(one, other)
    assert len([*folder.iterdir()]) == 2 * len(views)


def test_photos_of_another_size_or_changed_since_are_read_anew(views, tmp_path):
    first = load_views(views, SIDE, tmp_path)
    before = first[0].image.copy()
    assert load_views(views, 32, tmp_path)[0].camera.width == 32
    assert len([*tmp_path.iterdir()]) == 2 * len(views)  # those of the other size are gone
    path = views[0].image_path
    changed = path.stat().st_mtime_ns
    os.utime(path, ns=(changed, changed + 1000))
    try:
        load_views(views, 32, tmp_path)
    finally:
        os.utime(path, ns=(changed, changed))
    np.testing.assert_array_equal(first[0].image, before)  # a mapped photo stays readable
    assert len([*tmp_path.iterdir()]) == 2 * len(views)


def test_a_file_that_is_mapped_still_stays_on_windows(views, tmp_path, monkeypatch):
    load_views(views, SIDE, tmp_path)

    def refuse(file, missing_ok=False):
        raise PermissionError(13, "Access is denied", str(file))

    with monkeypatch.context() as patched:
        patched.setattr(type(tmp_path), "unlink", refuse)
        patched.setattr("refgs.paths.Path.unlink", refuse)
        smaller = load_views(views, 32, tmp_path)
    for view, loaded in zip(views, smaller, strict=True):
        check_same(loaded, load_view(view, 32))
    load_views(views, 32, tmp_path)
    assert len([file for file in tmp_path.iterdir() if file.suffix == ".npy"]) == 2 * len(views)


def test_half_a_file_does_not_count(views, tmp_path):
    load_views(views, SIDE, tmp_path)
    for file in tmp_path.glob("*.image.*"):
        file.unlink()
    for view, loaded in zip(views, load_views(views, SIDE, tmp_path), strict=True):
        check_same(loaded, load_view(view, SIDE))


@pytest.mark.parametrize(
    "damage", [lambda data: data[:200], lambda data: b"", lambda data: data.replace(b"|u1", b"|i1")]
)
def test_a_damaged_file_is_made_anew(views, tmp_path, damage):
    load_views(views, SIDE, tmp_path)
    for file in tmp_path.glob("*.npy"):
        file.write_bytes(damage(file.read_bytes()))
    for view, loaded in zip(views, load_views(views, SIDE, tmp_path), strict=True):
        assert mapped(loaded.image)
        check_same(loaded, load_view(view, SIDE))


def test_a_full_disk_leaves_photos_in_memory(views, tmp_path, monkeypatch):
    monkeypatch.setattr(cached.shutil, "disk_usage", lambda folder: type("", (), {"free": 0}))
    for view, loaded in zip(views, load_views(views, SIDE, tmp_path / "photos"), strict=True):
        assert not mapped(loaded.image)
        check_same(loaded, load_view(view, SIDE))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can be told")
def test_mapped_photos_leave_the_processs_memory_and_come_back(views, tmp_path):
    def mapped_bytes():
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.partition("RssFile:")[2].split()[0])

    large = np.random.default_rng(0).integers(0, 255, (3000, 4000, 3), np.uint8)
    camera = views[0].camera.resized(4000, 3000)
    view = cached._cached(LoadedView(large, None, camera), tmp_path, "large")
    assert view.image.sum() == large.sum()
    before = mapped_bytes()
    release_memory([view, LoadedView(large, None, camera)])
    assert before - mapped_bytes() > 30e6
    np.testing.assert_array_equal(view.image, large)
    before = mapped_bytes()
    reduced_views([view], 4, tmp_path)
    assert before - mapped_bytes() > 30e6


def test_few_photos_stay_in_memory(sharp_ball, tmp_path):
    loaded = load_views(read_capture(sharp_ball).views[:2], SIDE, tmp_path / "photos")
    assert not mapped(loaded[0].image) and not (tmp_path / "photos").exists()


def test_reduced_views_are_as_if_loaded_smaller(sharp_ball, tmp_path):
    views = read_capture(sharp_ball).views[:4]
    whole = [load_view(view, 64) for view in views]
    for view, small in zip(views, reduced_views(whole, 2, tmp_path / "photos"), strict=True):
        wanted = load_view(view, 32)
        assert small.camera.width == 32 and small.camera.fx == wanted.camera.fx and not mapped(small.image)
        assert np.abs(small.image.astype(int) - wanted.image).max() <= 1
        assert np.abs(small.alpha.astype(int) - wanted.alpha).max() <= 1
    assert all(mapped(small.image) for small in reduced_views(whole, 2, tmp_path))
