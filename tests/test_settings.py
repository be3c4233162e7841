import json

import pytest
import tomli_w

from refgs.errors import InputError
from refgs.run_folder import read_run_facts
from refgs.settings import load_settings, preset_names, recorded_settings
from scripts import settings_page


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_is_valid(name):
    settings = load_settings(name)
    assert settings.surfels.start <= settings.surfels.budget
    assert settings.region == load_settings("standard").region  # a training for a time takes one box for two presets


def test_set_changes_one_value():
    settings = load_settings("quick", ["train.iterations=7", "shading=sh", "image.background=[0.0, 0.5, 1.0]"])
    assert settings.train.iterations == 7 and settings.render.shading == "sh"
    assert settings.image.background == (0.0, 0.5, 1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("train.iteration=5", ["train.iteration", "iterations"]),
        ("trian.iterations=5", ["trian"]),
        ("train.iterations=0", ["train.iterations", "greater than or equal to 1"]),
        ("train.iterations=many", ["train.iterations", "integer"]),
        ("shading=phong", ["render.shading", "deferred"]),
        ("reflection=mirror", ["render", "diffuse = sh"]),
        ("iterations", ["section.key=value"]),
        ("rates.decay=2", ["rates.decay", "less than or equal to 1"]),
        ("region.size=[1, -1, 1]", ["region.size.1", "greater than or equal to 0"]),
        ("region.size=[1, 0, 1]", ["region", "[1.0, 0.0, 1.0]", "greater than 0"]),
        ("region.size=1", ["region.size", "tuple"]),
        ("region.centre=[0, 0]", ["region.centre.2"]),
        ("region.up=[0, 0, nan]", ["region.up.2", "finite"]),
        (f"region.up={'[' * 50_000}", ["nested too deeply"]),
        (f"train.iterations={'9' * 5000}", ["train.iterations", "integer"]),
    ],
)
def test_a_wrong_change_is_named(change, words):
    with pytest.raises(InputError) as error:
        load_settings("quick", [change])
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


def test_a_file_may_start_from_a_preset(tmp_path):
    file = tmp_path / "mine é.toml"
    file.write_text('base = "quick"\n[train]\niterations = 12\n', encoding="utf-8")
    settings = load_settings(str(file))
    assert settings.train.iterations == 12
    assert settings.train.seed == load_settings("quick").train.seed


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[train]\niterations = 3\n", "missing"),
        ('base = "nothing"\n', "nothing"),
        ("[train\n", "TOML"),
        (f"base = {'[' * 50_000}", "nested too deeply"),
        ('base = "quick"\n[loss]\nlambda = 1\n', "loss.lambda"),
        ('base = "quick"\nloss = 3\n', "loss"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, word):
    file = tmp_path / "mine.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=word) as error:
        load_settings(str(file))
    assert "\n" not in str(error.value)


def test_an_unknown_preset_lists_the_known():
    with pytest.raises(InputError, match="quick, standard"):
        load_settings("fast")


def test_the_page_is_what_the_code_generates():
    assert settings_page.PAGE.read_text(encoding="utf-8") == settings_page.page()


def test_a_run_of_before_a_setting_still_opens():
    settings = load_settings("quick")
    recorded = settings.model_dump(mode="json")
    del recorded["loss"]["light"], recorded["mesh"], recorded["light"]
    recorded["loss"]["dark"] = 0.15  # releases until 0.2 had it
    opened = recorded_settings(recorded, "run.toml")
    assert opened.train == settings.train
    assert opened.mesh == load_settings("standard").mesh
    assert (opened.light.frame, opened.light.exposure) == ("world", "off")  # runs that lack these keys were trained so


@pytest.mark.parametrize(
    ("made_by", "says"),
    [
        ("0.9.0", "update RefGS"),
        ("1.0.0", "update RefGS"),
        ("0.2.9", "run.capture is missing"),
        ("one", "run.refgs"),
        (5, "run.refgs"),
    ],
)
def test_a_run_of_a_newer_release_is_not_read(tmp_path, made_by, says):
    """Check that results of a newer minor or major release are refused with "update RefGS". A newer patch release is accepted.

    The file in this test has nothing else. If its release is accepted, reading therefore fails later.
    """
    (tmp_path / "run.toml").write_text(f"[run]\nrefgs = {json.dumps(made_by)}\n")
    with pytest.raises(InputError, match=says):
        read_run_facts(tmp_path)


RUN = {
    "refgs": "0.1.0",
    "capture": "/a",
    "fingerprint": "f",
    "preset": "quick",
    "centre": [0.0, 1.0, 2.0],
    "radius": 1.5,
}
RUN |= {"bounded": True}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"radius": -1.0}, "run.radius should be greater than 0"),
        ({"radius": float("nan")}, "run.radius should be a finite number"),
        ({"centre": [0.0, 1.0]}, "run.centre.2 is missing"),
        ({"capture": 3}, "run.capture should be a valid string"),
        ({"bounded": []}, "run.bounded should be a valid boolean"),
    ],
)
def test_a_wrong_value_of_run_toml_is_named(tmp_path, change, says):
    settings = load_settings("quick").model_dump(mode="json")
    file = tmp_path / "run.toml"
    file.write_text(tomli_w.dumps({"run": RUN, "settings": settings}))
    assert read_run_facts(tmp_path)[0].centre == (0.0, 1.0, 2.0)
    file.write_text(tomli_w.dumps({"run": RUN | change, "settings": settings}))
    with pytest.raises(InputError, match=says) as error:
        read_run_facts(tmp_path)
    assert str(error.value).startswith(f"{file}: ") and "\n" not in str(error.value)


def test_a_link_to_a_device_is_no_preset(tmp_path):
    """Check that reading ends at once: a device may have no end."""
    (tmp_path / "mine.toml").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="not a file"):
        load_settings(str(tmp_path / "mine.toml"))
