"""Test the panels in the sidebar at its default width: Blender cuts texts that are too long for their buttons and labels."""

import json
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import blf
import bpy

from refgs_addon import hooks, jobs
from refgs_addon.nodes.edit_tree import REGIONS
from refgs_addon.scene.deleted_splats import add_points
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import show
from refgs_addon.trainer.scene import training
from refgs_addon.trainer.ui.many_panel import ManyPanel
from refgs_addon.trainer.ui.train_panel import TrainPanel
from refgs_addon.ui.light_panel import LightPanel
from refgs_addon.ui.materials_panel import MaterialPanel
from refgs_addon.ui.panels import PreviewPanel, RunPanel
from tests.makers.still_life import add_mesh_light_and_photos, write_still_life
from tests.makers.waiting import until

SIDEBAR, PANEL, BOX = 291, 235, 9  # pixels as in a screenshot: the region, what a panel has of it, and what a box takes
ICON, MARGIN, ARROW = 20, 5, 18  # pixels: of a button's icon, beside its text, and of a menu's arrow
PANELS = TrainPanel, ManyPanel, RunPanel, MaterialPanel, LightPanel, PreviewPanel


class Layout:
    """Stand in for Blender's layout, and record its texts with the room that Blender gives them."""

    def __init__(self, above=None, across=False, inset=0, part=None):
        """Make a layout in the layout `above`. It has `inset` pixels less, or a `part` of the room in a row."""
        self.across, self.inset, self.part, self.items = across, inset, part, []
        self.use_property_split = bool(above and above.use_property_split)
        if above:
            above.items.append(self)

    def row(self, heading="", **_):
        return Layout(self, across=True, inset=0.4 * PANEL if heading else 0)

    def column(self, **_):
        return Layout(self)

    def box(self):
        return Layout(self, inset=BOX)

    def panel(self, *_, **__):
        return Layout(self), Layout(self)

    def label(self, text="", icon="NONE"):
        self.items.append((text, icon != "NONE", 0))

    def progress(self, text="", **_):
        self.items.append((text, False, 0))

    def operator(self, name, text=None, icon="NONE", **_):
        kind = getattr(bpy.types, "_OT_".join((name.split(".")[0].upper(), name.split(".")[1])), None)
        self.items.append((kind.bl_label if text is None and kind else text or "", icon != "NONE", 0))
        return SimpleNamespace()

    def operator_menu_enum(self, name, _, text=None, icon="NONE"):
        self.items.append((text, True, ARROW))
        return SimpleNamespace()

    def popover(self, *_, **__):
        self.items.append(("", True, 0))

    def prop(self, owner, name, text=None, toggle=0, **_):
        found = owner.bl_rna.properties.get(name)
        shown = text if text is not None or found is None else found.name
        boolean = found is not None and found.type == "BOOLEAN"
        if boolean or not self.use_property_split:
            self.items.append((shown or "", boolean, 0))
            return
        pair = Layout(self, across=True)
        label, value = Layout(pair, part=0.4), Layout(pair, part=0.6)
        label.items.append((shown, False, 0))
        for item in found.enum_items if found is not None and found.type == "ENUM" else ():
            value.items.append((item.name, False, ARROW))

    def prop_search(self, owner, path, *_, text):
        self.items.append((text, False, 0))

    def __getattr__(self, name):
        return lambda *_, **__: Mock()


def cut(layout, room):
    """List the texts of a layout that `room` pixels are too few for."""
    room, found = room - layout.inset, []
    fixed = [item for item in layout.items if isinstance(item, tuple) and not item[0]]
    others = [item for item in layout.items if item not in fixed]
    for item in others:
        share = (room - ICON * len(fixed)) / len(others) if layout.across else room
        if isinstance(item, Layout):
            found += cut(item, room * item.part if item.part else share)
        elif blf.dimensions(0, item[0])[0] > share - MARGIN - ICON * item[1] - item[2]:
            found.append(item[0])
    return found


def drawn(panel):
    """Draw a panel in a sidebar of the default width, and return its layout."""
    layout, context = Layout(), bpy.context
    stand_in = SimpleNamespace(
        scene=context.scene,
        view_layer=context.view_layer,
        window_manager=context.window_manager,
        region=SimpleNamespace(width=SIDEBAR),
        workspace=SimpleNamespace(use_filter_by_owner=False),
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
    )
    methods = {name: value for name, value in vars(panel).items() if callable(value)}
    panel.draw(type("Drawn", (), methods | {"layout": layout})(), stand_in)
    return layout


def cut_texts():
    """Draw all panels. Returns the texts that do not fit."""
    blf.size(0, 11)
    return [text for panel in PANELS for text in cut(drawn(panel), PANEL)]


def test_no_text_of_an_empty_scene_is_cut(addon):
    assert cut_texts() == []


def test_the_example_is_offered_while_there_is_no_run(addon):
    assert "Import Example" in texts(drawn(RunPanel))
    bpy.ops.refgs.import_example()
    assert "Import Example" not in texts(drawn(RunPanel)) and cut_texts() == []


def test_a_line_says_where_the_trainer_is(addon, monkeypatch):
    assert "The trainer is another extension" not in texts(drawn(RunPanel))
    monkeypatch.setattr(hooks, "mesh_maker", None)  # as without the trainer's extension
    assert "The trainer is another extension" in texts(drawn(RunPanel)) and cut_texts() == []


def test_no_text_of_a_run_is_cut(addon, fake_trainer, tmp_path):
    folder = write_still_life(tmp_path / "still")
    add_mesh_light_and_photos(folder)
    asked = {"part": 0.55, "now": "metal", "picture": "1.png", "points": [[0, -1, 0], [1, 0, 0]]}
    (folder / "questions.json").write_text(json.dumps({"questions": [asked]}))
    run = import_run(folder, addon)
    for number, opacity in enumerate(run.splats.data.attributes.new("doubt", "FLOAT", "POINT").data):
        opacity.value = number % 2
    for where in REGIONS:
        add_edit(run.collection, where)
    add_points(run.splats)
    show(run.collection, "splats")
    assert cut_texts() == []
    folder.rename(tmp_path / "elsewhere")
    assert cut_texts() == []


def test_no_text_of_a_job_is_cut(addon, fake_trainer, tmp_path):
    for name in ("good photos", "slow photos of a capture with a long name"):
        (tmp_path / name).mkdir()
    addon.refgs.capture = str(tmp_path / "good photos")
    training.check(addon)
    training.extract_photos(addon, Path(__file__), tmp_path / "photos of a film", 100)
    until(lambda: all(job.ended for job in jobs.JOBS))
    jobs.JOBS[-1].warnings.append(f"{tmp_path}/a_long_name_without_any_space/in_a_folder.jpg is dark: {60 * 'of '}")
    addon.refgs.capture = str(tmp_path / "slow photos of a capture with a long name")
    for _ in range(2):
        training.train(addon)
    until(lambda: jobs.JOBS[-2].curve)
    lost = addon.refgs.runs.add()
    lost.folder = str(tmp_path / "a folder with a long name that is gone")
    found = cut_texts()
    assert [text for text in found if "a capture with a long name" not in text] == []


def test_a_training_stays_above_reports(addon, fake_trainer, tmp_path):
    """Check that the box of a training is the first below its button, and that of the last report when nothing runs."""
    (tmp_path / "slow photos").mkdir()
    addon.refgs.capture = str(tmp_path / "slow photos")
    training.check(addon)
    until(lambda: jobs.JOBS[-1].ended)
    first, second = training.train(addon), training.train(addon)
    assert names_drawn() == [first.name, second.name, "slow photos"]
    first.stop()
    until(lambda: first.ended)
    assert names_drawn() == [second.name, first.name, "slow photos"]


def names_drawn():
    """Return the names of the jobs in the panel Train, from top to bottom."""
    return [text for text in texts(drawn(TrainPanel)) if text in [job.name for job in jobs.JOBS]]


def texts(layout):
    """List the texts of a layout, from top to bottom."""
    found = []
    for item in layout.items:
        found += texts(item) if isinstance(item, Layout) else [item[0]]
    return found
