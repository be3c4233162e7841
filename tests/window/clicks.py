"""Click as an artist does who sees a run for the first time, and report what the clicks did.

Arguments: the Python with the trainer, and the run folder. stage.py shows the command line.
"""

import bpy
from stage import (
    WORDS,
    act,
    addon,
    after,
    area,
    choose_tab,
    click,
    hover,
    install,
    jobs,
    panels,
    photograph,
    press,
    region,
    report,
    set_python,
    view,
)

PYTHON, RUN = WORDS


def artist():
    """Install the extension, import a run, and click. Each `yield` gives a function; the next step waits until it returns true."""
    install()
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.object.delete()
    bpy.ops.refgs.import_run(directory=RUN)
    area().spaces.active.show_region_ui = True
    yield after(2.0)
    choose_tab()
    report["imported"] = area().spaces.active.shading.type
    yield after(15.0)  # to compile shaders
    photograph("imported")
    yield from choose_light()
    yield from show_photos()
    yield from edit_regions()
    yield from paint()
    yield from hint()


def choose_light():
    """Click on the light's picture, then on a picture in the menu that opens below it."""
    registered = panels()
    for cls in registered:
        if cls.__name__ != "LightPanel":  # the only panel's place in the sidebar is known
            bpy.utils.unregister_class(cls)
    area().tag_redraw()
    yield after(3.0)
    sidebar = region("UI")
    middle, top = sidebar.x + sidebar.width // 2, sidebar.y + sidebar.height
    click(middle, top - 90)
    yield after(3.0)
    photograph("lights")
    click(middle - 212, top - 225)
    yield after(2.0)
    photograph("lit")
    report["light"] = bpy.context.scene.world.node_tree.nodes["RefGS HDRI"].image.filepath
    bpy.ops.refgs.recovered_light()
    for cls in registered:
        if cls.__name__ != "LightPanel":
            bpy.utils.register_class(cls)


def show_photos():
    """Lay a photo over its camera's view, and step to the next camera."""
    with view():
        bpy.ops.refgs.photo()
    yield after(3.0)
    photograph("left")
    with view():
        bpy.ops.refgs.next_camera()
    yield after(3.0)
    photograph("right")
    with view():
        bpy.ops.refgs.photo()
        bpy.ops.view3d.view_camera()  # back
    yield after(3.0)
    photograph("no photo")


def edit_regions():
    """Edit the material in a box, in a ball, and where it is similar. The view is Solid before each."""
    report["edited"] = {}
    for where in ("Box", "Sphere", "Similar"):
        area().spaces.active.shading.type = "SOLID"
        with view():
            bpy.ops.refgs.add_edit(where=where)
        region = bpy.context.view_layer.objects.active
        report["edited"][where] = area().spaces.active.shading.type, region.name
        yield after(8.0)
        photograph(where)
        splats = bpy.data.objects["still splats"]
        bpy.ops.refgs.remove_edit(splats=splats.name, edit=addon("scene.edit").edits(splats)[0].name)
        yield after(1.0)


def paint():
    """Paint the whole mesh, then show the splats and the mesh."""
    with view():
        bpy.ops.refgs.add_edit(where="Painted")
    canvas = bpy.context.view_layer.objects.active
    report["painting"] = bpy.context.mode
    canvas.vertex_groups.active.add(range(len(canvas.data.vertices)), 1.0, "REPLACE")
    for part in ("splats", "mesh"):
        with view():
            bpy.ops.refgs.show(collection="RefGS still", part=part)
        yield after(8.0)
        photograph(f"painted {part}")
    bpy.ops.refgs.remove_edit(
        splats="still splats", edit=addon("scene.edit").edits(bpy.data.objects["still splats"])[0].name
    )
    yield after(1.0)


def hint():
    """Say that the ball is metal. Cancel before the click, then the dialogue, then train; then answer a question, and cancel."""
    set_python(PYTHON)
    bpy.context.scene.refgs.mesh = False
    bpy.context.view_layer.objects.active = bpy.data.objects["still mesh"]
    shown = region("WINDOW")
    ball = shown.x + shown.width // 2, shown.y + shown.height // 2
    report["begun"], highlighted = {}, addon("trainer.ui.highlight")

    def count(step):
        begun = sum(job.run is not None for job in jobs())
        report["begun"][step] = begun, len(bpy.context.scene.refgs.runs), highlighted._handler is not None

    yield after(3.0)
    for step in ("hovered", "asked", "agreed"):
        with view():
            bpy.ops.refgs.hint("INVOKE_DEFAULT", kind="metal")
        yield after(1.0)
        hover(*ball)
        yield after(3.0)
        if step == "hovered":
            photograph("hovered")
            count("hovering")
        else:
            click(*ball)
            yield after(3.0)
        if step == "asked":
            photograph("asked")
            count("asking")
        press("RET" if step == "agreed" else "ESC", *ball)
        yield after(2.0)
        if step == "asked":
            photograph("cancelled")
        count(step)
    yield lambda: jobs()[-1].ended
    report["hinted"] = jobs()[-1].state, jobs()[-1].name
    with view():
        bpy.ops.refgs.hint("INVOKE_DEFAULT", kind="paint", question=1)
    yield after(3.0)
    photograph("question")
    press("ESC", *ball)
    yield after(2.0)
    count("answered")


act(artist())
