"""Test that the pages, headings, commands, options and buttons that the docs name exist."""

import re
from pathlib import Path

import pytest
import typer

from refgs.cli import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
FOLDERS = ("backend", "refgs_addon", "tests", "benchmarks", "scripts")
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")
COMMAND = re.compile(r"refgs ([a-z]+)\b([^\n`#|]*)")
BUTTON = re.compile(r"\*\*(\w[^*]+)\*\*")
EACH_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def anchors(page):
    """Return the anchors that GitHub gives a page's headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@EACH_PAGE
def test_links_lead_somewhere(page):
    for path, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        target = page.parent / path if path else page
        assert target.exists(), f"{path} is missing"
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}: no such heading"


@EACH_PAGE
def test_commands_and_options_exist(page):
    commands = typer.main.get_command(app).commands
    code = re.findall(r"```sh\n(.*?)```|`(refgs [^`]*)`", page.read_text(encoding="utf-8"), re.DOTALL)
    for name, words in COMMAND.findall("\n".join(block or inline for block, inline in code)):
        assert name in commands, f"refgs {name}"
        options = {option for param in commands[name].params for option in param.opts}
        if name != "bench":  # skip bench, whose options differ between benchmarks
            assert set(re.findall(r"--[a-z-]+", words)) <= options, f"refgs {name}{words}"


@pytest.mark.parametrize("name", ["blender.md", "first-ten-minutes.md"])
def test_buttons_exist(name):
    addon = "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "refgs_addon").rglob("*.py")).lower()
    for label in BUTTON.findall((ROOT / "docs" / name).read_text(encoding="utf-8")):
        for part in " ".join(label.split()).lower().split(" > "):
            assert part in addon, f"no button {part}"


def test_pages_that_the_code_names_exist():
    for file in (file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")):
        for page in re.findall(r"docs/[\w/-]+\.md", file.read_text(encoding="utf-8")):
            assert (ROOT / page).exists(), f"{file} names {page}"
