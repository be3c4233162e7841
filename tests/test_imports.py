"""Test scripts/check_imports.py: it finds forbidden imports and import cycles in small examples, and none in this repository."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def check(root):
    """Run scripts/check_imports.py on the folder `root`. Return its exit status and output."""
    command = [sys.executable, ROOT / "scripts" / "check_imports.py", root]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return done.returncode, done.stdout


def write(root, files):
    """Write a small source tree into `root` that obeys the import rules. Then add or replace `files`, a mapping of path to text."""
    right = {
        "backend/refgs/__init__.py": "",
        "backend/refgs/camera.py": "import numpy",
        "backend/refgs/model/__init__.py": "",
        "backend/refgs/model/surfels.py": "import torch\nfrom refgs.camera import Camera",
        "backend/refgs/render/__init__.py": "",
        "backend/refgs/render/reference.py": "",
        "backend/refgs/train/__init__.py": "",
        "backend/refgs/train/learn/__init__.py": "",
        "backend/refgs/train/learn/loop.py": "from refgs.model import surfels\nfrom refgs.train.learn.adam import Adam",
        "backend/refgs/train/learn/adam.py": "from refgs.model.surfels import Surfels",
        "refgs_addon/__init__.py": "import bpy",
        "refgs_addon/jobs.py": "from . import errors",
        "refgs_addon/errors.py": "",
        "refgs_addon/scene/__init__.py": "",
        "refgs_addon/scene/run.py": "from ..jobs import start",
        "refgs_addon/trainer/__init__.py": "from ..jobs import start",
        "refgs_addon/trainer/install.py": "from ..scene import run\nfrom . import ui",
        "refgs_addon/trainer/ui.py": "",
        "refgs_trainer/__init__.py": "import bpy",
    }
    for name, text in (right | files).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def test_this_clone_keeps_the_rules():
    status, said = check(ROOT)
    assert status == 0, said


def test_imports_of_lower_floors_are_allowed(tmp_path):
    write(tmp_path, {})
    assert check(tmp_path) == (0, "")


UP = "def f():\n    from refgs.train.learn.loop import Loop\n"
HIDDEN = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from refgs.train.learn.loop import Loop\n"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("backend/refgs/model/surfels.py", UP, ["surfels.py:2", "refgs.train.learn.loop, which is on a floor above"]),
        ("backend/refgs/model/light.py", HIDDEN, ["light.py:3", "refgs.train.learn.loop, which is on a floor above"]),
        ("backend/refgs/model/light.py", "from refgs import train", ["light.py:1", "refgs.train, which is on a floor"]),
        ("backend/refgs/train/learn/adam.py", "import refgs.train.learn.loop", ["circle", "loop.py:2", "adam.py:1"]),
        ("backend/refgs/train/learn/adam.py", UP, ["circle", "loop.py:2", "adam.py:2"]),
        ("backend/refgs/train/learn/adam.py", HIDDEN, ["circle", "loop.py:2", "adam.py:3"]),
        ("backend/refgs/train/learn/adam.py", "from .loop import Loop", ["circle", "loop.py:2", "adam.py:1"]),
        ("refgs_addon/errors.py", "from .scene.run import f", ["circle", "jobs.py:1", "run.py:1", "errors.py:1"]),
        ("backend/refgs/camera.py", "def f():\n    import bpy", ["camera.py:2", "nothing under backend/ imports bpy"]),
        ("backend/refgs/camera.py", "from bpy.types import A", ["camera.py:1", "nothing under backend/ imports bpy"]),
        ("refgs_addon/jobs.py", "import torch.cuda", ["jobs.py:1", "nothing under refgs_addon/ imports torch"]),
        ("refgs_addon/jobs.py", "from refgs import run", ["jobs.py:1", "nothing under refgs_addon/ imports refgs"]),
        ("refgs_addon/jobs.py", "from . import trainer", ["jobs.py:1", "only modules of refgs_addon.trainer do"]),
        ("refgs_addon/scene/run.py", "from ..trainer.ui import f", ["run.py:1", "only modules of refgs_addon.trainer"]),
        ("refgs_trainer/__init__.py", "import refgs_addon", ["nothing under refgs_trainer/ imports refgs_addon"]),
        (
            "backend/refgs/train/adam.py",
            "from refgs.render import reference",
            ["adam.py:1", "refgs.render.reference: only tests and benchmarks do"],
        ),
        ("backend/refgs/new.py", "", ["new.py", "refgs.new has no floor"]),
    ],
)
def test_each_rule_finds_what_breaks_it(tmp_path, name, text, expected):
    write(tmp_path, {name: text})
    status, said = check(tmp_path)
    assert status == 1
    for words in expected:
        assert words in said


def test_no_test_imports_another():
    """Check that tests import shared code only from tests/makers, never from each other."""
    for file in (ROOT / "tests").rglob("*.py"):
        imported = re.findall(r"(?m)^ *(?:from|import) ((?:tests\.|test_|makers|conftest)\S*)", file.read_text("utf-8"))
        assert all(name.startswith("tests.makers") for name in imported), f"{file}: {imported}"


def test_every_module_of_tests_has_a_name_of_its_own():
    """Check what pytest needs where its folders are no packages: of two modules with one name it collects one, and reports an error."""
    names = [file.name for file in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
