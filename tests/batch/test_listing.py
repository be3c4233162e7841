"""Test what a batch is read from: lists of captures and settings, and folders of captures. Mistakes are one line."""

import pytest

from refgs.batch.graph import steps_of
from refgs.batch.listing import Ask, read_jobs
from refgs.errors import InputError
from tests.makers.captures import nerfstudio


@pytest.fixture
def shelf(tmp_path):
    """Make a folder of two captures, whose files are empty, and return it."""
    for name in ("cup", "jar"):
        (tmp_path / "shelf" / name).mkdir(parents=True)
        (tmp_path / "shelf" / name / "0.jpg").touch()
    return tmp_path / "shelf"


def read(shelf, text, ask=None):
    (shelf / "list.toml").write_text(text)
    return read_jobs(shelf / "list.toml", shelf.parent / "runs", ask or Ask())


def test_each_folder_is_a_capture(shelf):
    (shelf / ".trash").mkdir()
    (shelf / "notes.txt").touch()
    jobs = read_jobs(shelf, shelf.parent / "runs", Ask(preset="quick"))
    assert [(job.name, job.capture, job.ask.preset) for job in jobs] == [
        ("cup", shelf / "cup", "quick"),
        ("jar", shelf / "jar", "quick"),
    ]


def test_no_two_steps_of_a_run_work_at_once(shelf):
    """Check that each step follows the one before: `export` locks the run and removes what `evaluate` would be writing."""
    nodes = steps_of(read_jobs(shelf, shelf.parent / "runs", Ask())[0], shelf.parent / "runs", "cpu")
    names = [node.step.name for node in nodes]
    assert names == ["poses", "masks", "train", "evaluate", "export"]
    assert all(before in node.after + node.may_fail for before, node in zip(names, nodes[1:], strict=False))


def test_captures_times_settings_and_a_line_overrides(shelf):
    jobs = read(
        shelf,
        """
        set = ["train.seed=1"]
        [[settings]]
        name = "fast"
        preset = "quick"
        [[settings]]
        name = "fine"
        set = ["surfels.budget=9000"]
        [[captures]]
        folder = "cup"
        [[captures]]
        folder = "jar"
        name = "pot"
        preset = "standard"
        set = ["train.seed=2"]
        """,
        Ask(preset="paper", set=["train.seed=0"]),
    )
    found = {job.name: (job.ask.preset, job.settings().train.seed, job.settings().surfels.budget) for job in jobs}
    assert found.keys() == {"cup-fast", "cup-fine", "pot-fast", "pot-fine"}
    assert found["cup-fast"][:2] == ("quick", 1) and found["cup-fine"] == ("paper", 1, 9000)
    assert found["pot-fast"][:2] == ("standard", 2) and found["pot-fine"] == ("standard", 2, 9000)


def test_a_list_includes_others(shelf):
    (shelf / "jar" / "more.toml").write_text('[[captures]]\nfolder = "."')
    jobs = read(shelf, 'include = ["jar/more.toml"]\n[[captures]]\nfolder = "cup"')
    assert [job.name for job in jobs] == ["jar", "cup"]


CUP = '[[captures]]\nfolder = "cup"\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (2 * CUP, "cup is listed twice"),
        (CUP + CUP + 'name = "other"', "cup is listed twice"),
        (CUP + '[[captures]]\nfolder = "jar"\nname = "Cup"', "jar would both be trained into"),
        ('[[captures]]\nfolder = "mug"', "mug: there is no such folder"),
        ('include = ["list.toml"]', "list.toml includes .*list.toml, which includes it"),
        ('include = ["none.toml"]', "none.toml: there is no such file"),
        (CUP + 'preset = "slow"', "cup: no preset slow"),
        (CUP + 'set = ["train.iterations=0"]', "cup: quick: train.iterations = 0"),
        (CUP + 'name = "logs"', "'logs' cannot be the name"),
        (CUP + 'name = "../cup"', "'../cup' cannot be the name"),
        (CUP + "color = 1", r"captures\.0\.color is not known"),
        ("captures = 1", "captures should be a valid list"),
        ("captures = [", "list.toml: not TOML"),
        ('include = ["a\\u0000b"]', "is no path"),
        (f'[[captures]]\nfolder = "{500 * "é"}"', "there is no such folder"),
        ("", "no captures in it"),
    ],
)
def test_a_mistake_is_one_line(shelf, text, says):
    with pytest.raises(InputError, match=says) as said:
        read(shelf, text, Ask(preset="quick"))
    assert "\n" not in str(said.value)


def test_a_circle_of_lists(shelf):
    (shelf / "a.toml").write_text('include = ["list.toml"]')
    with pytest.raises(InputError, match=r"a.toml includes .*list.toml, which includes it"):
        read(shelf, 'include = ["a.toml"]')


def test_folders_that_are_not_of_captures(shelf):
    with pytest.raises(InputError, match="choose another place for the runs"):
        read_jobs(shelf, shelf / "cup", Ask())
    with pytest.raises(InputError, match="is a capture itself"):
        read_jobs(nerfstudio(shelf / "jar", 3), shelf.parent / "runs", Ask())
