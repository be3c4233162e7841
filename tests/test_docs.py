"""Test that the pages, headings, commands, options and buttons that the docs name exist."""

import ast
import re
from pathlib import Path

import pytest
import typer

from refgs.cli import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
FOLDERS = ("backend", "refgs_addon", "refgs_trainer", "tests", "benchmarks", "scripts")
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")
COMMAND = re.compile(r"refgs ([a-z]+)\b([^\n`#|]*)")
BUTTON = re.compile(r"\*\*(\w[^*]+)\*\*")
LABELS = {
    "bl_label",
    "bl_category",
    "text",
    "cancel_text",
    "name",
    "items",
}  # attributes and arguments that Blender shows
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


def drawn_labels():
    """Return the labels that the add-on gives its buttons, properties, menus and tabs.

    They are the strings in values of LABELS, directly or in a constant of the same file, without "…" and endings such as " (.ply)".
    """
    found = set()
    for file in (*(ROOT / "refgs_addon").rglob("*.py"), *(ROOT / "refgs_trainer").rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        assigned = [(node.targets[0], node.value) for node in ast.walk(tree) if isinstance(node, ast.Assign)]
        values = {target.id: value for target, value in assigned if isinstance(target, ast.Name)}
        shown = [value for target, value in assigned if isinstance(target, ast.Name) and target.id in LABELS]
        shown += [node.value for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg in LABELS]
        for part in (part for value in shown for part in ast.walk(value)):
            inside = ast.walk(values[part.id]) if isinstance(part, ast.Name) and part.id in values else [part]
            found |= {word.value for word in inside if isinstance(word, ast.Constant) and isinstance(word.value, str)}
    return {re.sub(r"…$| \(\S+\)$", "", label) for label in found}


@pytest.mark.parametrize("name", ["blender.md", "first-ten-minutes.md"])
def test_buttons_exist(name):
    buttons = BUTTON.findall((ROOT / "docs" / name).read_text(encoding="utf-8"))
    parts = {part for button in buttons for part in " ".join(button.split()).split(" > ")}
    assert parts
    missing = parts - drawn_labels()
    assert not missing, f"no such button: {missing}"


def test_pages_that_the_code_names_exist():
    named = {
        page: file
        for folder in FOLDERS
        for file in (ROOT / folder).rglob("*.py")
        for page in re.findall(r"docs/[\w/-]+\.md", file.read_text(encoding="utf-8"))
    }
    assert named
    for page, file in named.items():
        assert (ROOT / page).exists(), f"{file} names {page}"
