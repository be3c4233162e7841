"""Test that a part of a run is found by a click or by what the artist has chosen, and that a training with a hint about it starts."""

import json
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from refgs.train import hints as trained_again
from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.scene.deleted_splats import add_points
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.regions import REGION
from refgs_addon.trainer.scene import training
from refgs_addon.trainer.scene.hints import Surface, chosen_part, part_at
from refgs_addon.trainer.ui.hint_buttons import clicked_ray, confirmation
from tests.makers.distances import spread
from tests.makers.still_life import BALL, FAINT, SIDE, write_still_life
from tests.makers.waiting import final_state, until


@pytest.fixture
def still(addon, fake_trainer, tmp_path):
    """Import a ball on a floor, moved, turned and made smaller."""
    run = import_run(write_still_life(tmp_path / "still"), bpy.context.scene)
    move(run)
    return run


def move(run):
    """Move, turn and shrink a run as the artist does, by its Empty."""
    run.root.location, run.root.scale, run.root.rotation_euler = (5, -4, 3), (0.1, 0.1, 0.1), (0.3, 0.2, 1.0)
    bpy.context.view_layer.update()


def ray(run, origin, target):
    """Return a ray in world space from one point to another of the run's own coordinates."""
    start, end = (run.splats.matrix_world @ Vector(point) for point in (origin, target))
    return start, (end - start).normalized()


def test_a_click_takes_a_part_up_to_its_creases(still):
    ball = part_at(still.splats, *ray(still, (0.5, -9, 0.5), (0, 0, 0)))
    radius = np.linalg.norm(ball, axis=1)
    assert (radius < 1.01).all() and ((radius > 0.99).sum(), (radius < 0.91).sum()) == (BALL, FAINT)
    floor = part_at(still.splats, *ray(still, (1.8, 1.8, 9), (1.8, 1.8, -1)))
    assert len(floor) == SIDE * SIDE and (floor[:, 2] < -1.04).all()
    with pytest.raises(InputError, match="no splat is under the cursor"):
        part_at(still.splats, *ray(still, (0, -9, 5), (0, 9, 5)))


def test_a_click_while_the_mesh_is_shown(still, tmp_path):
    """Check that splats are found where they stand, though Blender does not update them while they are hidden."""
    again = import_run(tmp_path / "still", bpy.context.scene)
    again.splats.hide_viewport = True
    move(again)
    ball = part_at(again.splats, *ray(still, (0.5, -9, 0.5), (0, 0, 0)))
    assert len(ball) == BALL + FAINT


def screen(*regions):
    """Describe a screen with one 3D view, whose regions are given as (type, x, y, width, height)."""
    # A camera at (0, -9, 0) that looks along +y, with a field of view of 90 degrees.
    view = Matrix(((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, -9), (0, 0, 0, 1)))
    lens = Matrix(((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, -1.01, -0.2), (0, 0, -1, 0)))
    data = SimpleNamespace(is_perspective=True, view_matrix=view, perspective_matrix=lens @ view)
    names = ("type", "x", "y", "width", "height")
    made = [SimpleNamespace(data=data, **dict(zip(names, region, strict=True))) for region in regions]
    return SimpleNamespace(areas=[SimpleNamespace(type="VIEW_3D", regions=made)])


def test_the_ray_through_a_clicked_pixel():
    shown = screen(("WINDOW", 100, 50, 400, 400), ("UI", 400, 50, 100, 400))
    origin, direction = clicked_ray(shown, 300, 250)
    assert (origin - Vector((0, -9, 0))).length < 1e-5 and (direction - Vector((0, 1, 0))).length < 1e-5
    _, direction = clicked_ray(shown, 300, 449)
    assert abs(direction.z / direction.y - 1) < 0.02 and abs(direction.x) < 1e-5
    assert clicked_ray(shown, 450, 250) is None, "the sidebar lies over the view"
    assert clicked_ray(shown, 50, 250) is None


def test_what_is_behind_the_view_is_not_clicked(still):
    floor = part_at(still.splats, *ray(still, (0, 0, -1.02), (0, 0, -9)))
    assert (floor[:, 2] < -1.04).all()


def test_points_that_are_selected_in_edit_mode(still):
    points = add_points(still.splats)
    assert chosen_part(still.splats, points) is None
    bpy.context.view_layer.objects.active = points
    points.data.vertices.foreach_set("select", np.arange(len(points.data.vertices)) < 7)
    bpy.ops.object.mode_set(mode="EDIT")
    np.testing.assert_allclose(chosen_part(still.splats, points), spread(BALL)[:7], atol=1e-6)
    bpy.ops.mesh.select_all(action="DESELECT")
    assert chosen_part(still.splats, points) is None
    bpy.ops.object.mode_set(mode="OBJECT")


@pytest.mark.parametrize("where", ["Box", "Sphere", "Similar"])
def test_a_region_of_an_edit(still, where):
    add_edit(still.collection, where)
    region = next(item for item in still.collection.objects if REGION in item)
    region.location, region.scale = still.splats.matrix_basis @ Vector((0, 0, 1)), (0.4, 0.4, 0.4)
    bpy.context.view_layer.update()
    part, ball = chosen_part(still.splats, region), spread(BALL)
    if where == "Similar":
        assert part is None
        return
    apart = np.abs(ball - [0, 0, 1])
    inside = (apart.max(axis=1) if where == "Box" else np.linalg.norm(apart, axis=1)) <= 0.4
    assert abs(len(part) - inside.sum()) <= 0.1 * inside.sum() + FAINT / 10 and (np.abs(part - [0, 0, 1]) < 0.41).all()
    region.location = 9, 9, 9
    bpy.context.view_layer.update()
    assert chosen_part(still.splats, region) is None


def test_the_button_starts_a_training_with_the_hint(still, addon, tmp_path):
    origin, direction = ray(still, (0.5, -9, 0.5), (0, 0, 0))
    addon.refgs.mesh = False
    assert bpy.ops.refgs.hint(kind="metal", origin=origin, direction=direction) == {"FINISHED"}
    job, out = jobs.JOBS[-1], tmp_path / "still 2"
    assert job.run == out and [known.folder for known in addon.refgs.runs] == [str(out)]
    assert final_state(job) == "done"
    asked = json.loads((out / "started").read_text())
    assert asked["from"] == str(tmp_path / "still") and asked["capture"] == str(tmp_path / "good photos")
    with open(asked["hints"]) as file:
        (hint,) = json.load(file)["hints"]
    assert hint["kind"] == "metal" and len(hint["points"]) == BALL + FAINT
    assert np.linalg.norm(hint["points"], axis=1).max() < 1.01


def test_each_hint_has_a_folder_and_a_file_of_its_own(still, addon):
    down = ray(still, (1.8, 1.8, 9), (1.8, 1.8, -1))
    files = set()
    for kind in ("paint", "metal"):
        job = training.train_with_hint(addon, still.collection, kind, down)
        files.add(job.commands[0]["hints"])
    assert len(files) == 2 and [job.run.name for job in jobs.JOBS[-2:]] == ["still 2", "still 3"]
    until(lambda: job.ended, 60)


@pytest.mark.parametrize(
    ("metrics", "minutes"),
    [({"training_seconds": 20}, 1), ({"training_seconds": 100}, 1), ({"training_seconds": 9999}, 2), ({}, 2)],
)
def test_a_hint_says_what_it_will_do(still, addon, tmp_path, metrics, minutes):
    """Check the words of the dialogue, and that making them starts and writes nothing."""
    assert pytest.approx(training.REPEATED) == 1 - trained_again.AGAIN
    assert training.AT_MOST == trained_again.AT_MOST
    (tmp_path / "still" / "metrics.json").write_text(json.dumps(metrics))
    before, begun = {*tmp_path.rglob("*")}, len(jobs.JOBS)
    plan = training.plan_hint(addon, still.collection)
    assert plan == (tmp_path / "still", tmp_path / "good photos", tmp_path / "still 2", minutes)
    first, second, third = confirmation(plan, "metal", 0.25, True)
    assert first == "The orange part, 25% of the splats, is held as metal."
    assert second.endswith(f"about {'a minute' if minutes == 1 else '2 minutes'}, then the mesh is made.")
    assert "“still 2”" in third
    assert {*tmp_path.rglob("*")} == before and len(jobs.JOBS) == begun and not addon.refgs.runs


def test_the_highlight_lies_on_the_part(still):
    surface = Surface(still.splats)
    ball = surface.smooth_part(surface.hit(*ray(still, (0.5, -9, 0.5), (0, 0, 0))))
    np.testing.assert_array_equal(surface.nearest(surface.position[ball] + 1e-4), ball)
    corners = surface.corners(ball).reshape(-1, 3)
    inverse = np.array(still.splats.matrix_world.inverted())
    radius = np.linalg.norm(corners @ inverse[:3, :3].T + inverse[:3, 3], axis=1)
    assert len(corners) == 4 * (BALL + FAINT) and radius.max() < 1.1 and np.median(radius) > 1


def test_what_a_hint_needs(still, addon, tmp_path):
    with pytest.raises(InputError, match="no part is chosen"):
        training.train_with_hint(addon, still.collection, "metal")
    down = ray(still, (1.8, 1.8, 9), (1.8, 1.8, -1))
    (tmp_path / "good photos").rmdir()
    with pytest.raises(InputError, match="photos of still are no longer at"):
        training.train_with_hint(addon, still.collection, "metal", down)
    (tmp_path / "still" / "checkpoints" / "00000010.toml").unlink()
    with pytest.raises(InputError, match="still has no checkpoint"):
        training.train_with_hint(addon, still.collection, "metal", down)
    assert not addon.refgs.runs and not (tmp_path / "still 2").exists()


def test_an_answer_to_a_question_starts_a_training_with_the_hint(still, addon, tmp_path):
    points = spread(BALL)[:9].tolist()
    row = {"part": 0.2, "now": "paint", "picture": "questions/1.png", "points": points}
    (tmp_path / "still" / "questions.json").write_text(json.dumps({"questions": [row]}))
    addon.refgs.mesh = False
    with pytest.raises(RuntimeError, match="has no question 2: import it again"):
        bpy.ops.refgs.hint(kind="metal", question=2)
    assert bpy.ops.refgs.hint(kind="metal", question=1) == {"FINISHED"}
    assert final_state(jobs.JOBS[-1]) == "done"
    with open(json.loads((tmp_path / "still 2" / "started").read_text())["hints"]) as file:
        (hint,) = json.load(file)["hints"]
    assert hint == {"kind": "metal", "points": points}
