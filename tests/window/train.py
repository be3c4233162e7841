"""Act as an artist in a Blender window: train a capture with the real trainer, and take a screenshot of each step.

Arguments: the Python with the trainer, and the capture. stage.py shows the command line.
"""

import contextlib
import importlib.util
import time
import traceback

import bpy
from stage import (
    OUT,
    PATIENCE,
    WORDS,
    addon,
    area,
    choose_tab,
    click,
    install,
    jobs,
    panels,
    photograph,
    press,
    quit_blender,
    region,
    report,
    set_python,
    view,
)

PYTHON, CAPTURE = WORDS
report |= {"steps": {}, "longest": {}, "ours": {}, "clicks": {}}


def last(state):
    return lambda: jobs() and jobs()[-1].state == state


def tell(command):
    bpy.ops.refgs.tell(serial=jobs()[-1].serial, command=command)


def artist():
    """Install the extension, then press its buttons: check a capture, train, pause, stop, resume, finish, import and use the result.

    After each step, yield a function and the name of a screenshot, or None for no screenshot. The function returns true once the step's
    work is done. The screenshot is taken then.
    """
    install()
    area().spaces.active.show_region_ui = True
    bpy.data.objects.remove(bpy.data.objects["Cube"])  # it is where the object will be
    yield lambda: True, None
    choose_tab()
    yield lambda: True, "empty"
    measure_addon()
    set_python(PYTHON)
    settings = bpy.context.scene.refgs
    settings.capture, settings.preset, settings.limited, settings.minutes = CAPTURE, "quick", True, 2.0
    yield last("done"), None
    bpy.ops.refgs.check_capture()
    yield last("done"), "checked"
    report["checked"] = jobs()[-1].results["check"]["lines"]
    bpy.ops.refgs.show_cameras(serial=jobs()[-1].serial)
    bpy.ops.refgs.add_training_region()
    yield lambda: True, "cameras"
    report["cameras"] = sum(item.type == "CAMERA" for item in bpy.data.objects) - 1  # without Blender's default camera
    bpy.ops.refgs.put_away(serial=jobs()[-1].serial)
    bpy.ops.refgs.train()
    yield lambda: len(jobs()[-1].curve) > 4 and jobs()[-1].preview, "training"
    if numpy():
        bpy.ops.refgs.watch(serial=jobs()[-1].serial)
        yield lambda: any(item.type == "POINTCLOUD" and len(item.data.points) for item in bpy.data.objects), "live"
    tell("pause")
    yield last("paused"), "paused"
    tell("cancel")
    yield last("cancelled"), "stopped"
    folder = jobs()[-1].run
    report["run"], report["stopped"] = str(folder), jobs()[-1].progress["iteration"]
    bpy.ops.refgs.put_away(serial=jobs()[-1].serial)
    bpy.ops.refgs.resume(folder=str(folder))
    yield lambda: jobs()[-1].progress.get("iteration", 0) > report["stopped"], "resumed"
    tell("stop")
    yield last("done"), "done"
    try:
        report["imported"] = list(bpy.ops.refgs.import_trained(folder=str(folder)))
    except RuntimeError as error:
        report["imported"] = str(error)
    yield lambda: True, "imported"
    if numpy():
        yield from use_result(folder)


def use_result(folder):
    """Compare the result with its photos, relight, edit, apply the edits, render, and click on it for a hint. Yields as `artist` does."""
    report["left"] = [item.name for item in bpy.data.objects if "in training" in item.name]
    scene, manager = bpy.context.scene, bpy.context.window_manager
    area().spaces.active.shading.type = "MATERIAL"
    area().spaces.active.shading.use_scene_world = True
    with view():
        bpy.ops.refgs.next_camera()
        bpy.ops.refgs.photo()
    yield lambda: True, "photo"
    with view():
        bpy.ops.refgs.photo()
    manager.refgs_light = next(str(file) for file in addon("scene.world_light").hdris() if file.stem == "city")
    bpy.ops.refgs.match_light()
    yield lambda: True, "relit"
    bpy.ops.refgs.add_edit(where="Sphere", material="Gold")
    yield lambda: True, "edited"
    bpy.ops.refgs.apply_edits(filepath=str(OUT / "golden"))
    yield last("done"), "applied"
    report["applied"] = sorted(file.name for file in (OUT / "golden").iterdir())
    bpy.ops.refgs.render_preview(filepath=str(OUT / "preview.png"), size=256, samples=16)
    yield lambda: jobs()[-1].ended, "previewed"
    report["preview"] = jobs()[-1].state, jobs()[-1].line
    report["scene"] = scene.render.engine, scene.world.name
    run = addon("scene.run_parts").active_run(bpy.context)
    bpy.context.view_layer.objects.active = addon("scene.edit").splats_of(
        run
    )  # not the ball of the edit, which is a part, too
    with view():
        bpy.ops.refgs.hint("INVOKE_DEFAULT", kind="metal")
    yield lambda: True, None
    click_middle()
    yield lambda: True, None
    middle = region("WINDOW")
    press("RET", middle.x + middle.width // 2, middle.y + middle.height // 2)  # Train
    yield last("running"), "hinted"
    tell("cancel")
    yield last("cancelled"), None


def click_middle():
    """Click in the middle of the 3D view, where a photo's camera sees the object."""
    middle = region("WINDOW")
    click(middle.x + middle.width // 2, middle.y + middle.height // 2)


ours = 0.0  # seconds: longest wait of the window for the add-on since the last step


@contextlib.contextmanager
def measured():
    global ours
    start = time.perf_counter()
    yield
    ours = max(ours, time.perf_counter() - start)


def measure_addon():
    """Start to measure how long the add-on's timer and panels block the window. Clicks on buttons are not included."""
    timers = addon("job_timers")
    look = timers._poll_jobs

    def measured_look():
        with measured():
            return look()

    timers._poll_jobs = measured_look
    for cls in panels():
        cls.draw = measured_draw(cls.draw)


def measured_draw(draw):
    def measured_one(self, context):  # Blender checks the number of arguments
        with measured():
            draw(self, context)

    return measured_one


def numpy():
    return importlib.util.find_spec("numpy") is not None


steps, waiting, due, longest = artist(), None, time.perf_counter() + 3.0, 0.0


def tick() -> float | None:
    """Run the session's next step once the function that it waits for returns true. Blender calls this ten times a second.

    If the window is busy, the call is delayed. The longest delay of each step is recorded.
    """
    global waiting, due, longest, ours
    now = time.perf_counter()
    longest = max(longest, now - due)
    due = now + 0.1
    try:
        if waiting is None:
            with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
                found = next(steps, None)
            click = time.perf_counter() - now
            if found is None:
                return quit_blender()
            waiting = (*found, now + PATIENCE)
            if found[1]:
                report["clicks"][found[1]] = click
            due = time.perf_counter() + 3.0  # exclude the click itself, include its effects
            return 3.0  # time to draw
        condition, name, until = waiting
        if condition():
            waiting = None
            if name:
                report["longest"][name], longest = longest, 0.0
                report["ours"][name], ours = ours, 0.0
                photograph(name)
                report["steps"][name] = [(job.name, job.state, job.line) for job in jobs()]
            due = time.perf_counter() + 0.1
        elif now > until:
            raise TimeoutError(f"{name}: {[(job.name, job.state, job.line) for job in jobs()]}")
    except Exception:
        report["error"] = traceback.format_exc()
        return quit_blender()
    return 0.1


bpy.app.timers.register(tick, first_interval=3.0)
