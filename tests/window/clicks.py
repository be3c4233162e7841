"""Click through the first ten minutes as an artist does, from an empty file to a relit picture, and report what the clicks did.

Arguments: the Python with the trainer, and the run folder. stage.py shows the command line.
"""

import shutil

import bpy
from hands import choose_file, choose_tab, click, point, press, push
from stage import OUT, WORDS, act, addon, after, area, install, jobs, photograph, region, report, set_python

PYTHON, RUN = WORDS
WHERE = "Everywhere", "Box", "Sphere", "Similar", "Painted"  # the entries of the menu Edit Material
# Steps to the right and up, in pixels.
LIGHT = 0, 70  # from the button below the light's picture to the picture
SUNRISE, SUNSET = (80, 297), (-802, 150)  # from there to the panoramas in the menu, which opens above it
EDIT = 0, -26  # from the button above the menu Edit Material to the menu
MATERIALS = -68, 0  # from the button that removes an edit to its materials
COPPER = 6, 184  # from there to Copper


def artist():
    """Install the extensions, empty the file, and click. Each `yield` gives a function; the next step waits until it returns true."""
    report["xdotool"] = shutil.which("xdotool") is not None
    if not report["xdotool"]:
        return
    bpy.context.preferences.system.use_region_overlap = False  # else each look for a button draws the 3D view again
    install()
    set_python(PYTHON)
    bpy.context.scene.refgs.mesh = False
    yield after(1.0)
    for key in ("a", "Delete", "n"):
        yield from press(key, 600, 480)
    report["left"] = len(bpy.data.objects)
    yield from choose_tab()
    yield from push("refgs.import_run")
    yield from choose_file(RUN)
    report["imported"] = area().spaces.active.shading.type
    yield after(10.0)  # to compile shaders
    photograph("imported")
    yield from push("refgs.relight", beside=LIGHT, entry=SUNRISE)
    yield after(3.0)
    photograph("lit")
    report["light"] = light()
    yield from push("refgs.recovered_light")
    yield from show_photos()
    yield from edit_regions()
    yield from paint()
    yield from hint()
    yield from make_picture()


def light():
    """Return the file of the panorama that lights the scene."""
    return bpy.context.scene.world.node_tree.nodes["RefGS HDRI"].image.filepath


def show_photos():
    """Lay a photo over its camera's view, step to the next camera, take the photo away, and leave the camera."""
    for name, button, part in (
        ("left", "refgs.photo()", 0.4),
        ("right", "refgs.next_camera(steps=1)", 0.91),
        ("no photo", "refgs.photo()", 0.3),
    ):
        yield from push(button, part)
        yield after(3.0)
        photograph(name)
    yield from press("KP_0", *middle())
    report["perspective"] = area().spaces.active.region_3d.view_perspective


def middle():
    """Return the middle of the 3D view, where the ball is."""
    shown = region("WINDOW")
    return shown.x + shown.width // 2, shown.y + shown.height // 2


def add_edit(where):
    yield from push("refgs.show_doubt", beside=EDIT, entry=(0, -24 - 23 * WHERE.index(where)))


def remove_edit():
    yield from push("refgs.remove_edit", 0.91)


def edit_regions():
    """Edit the material in a box, in a ball, and where it is similar. The view is Solid before each."""
    report["edited"] = {}
    for where in ("Box", "Sphere", "Similar"):
        area().spaces.active.shading.type = "SOLID"
        yield from add_edit(where)
        report["edited"][where] = area().spaces.active.shading.type, bpy.context.view_layer.objects.active.name
        yield after(4.0)
        photograph(where)
        yield from remove_edit()


def paint():
    """Paint the whole mesh, then show the splats and the mesh."""
    yield from add_edit("Painted")
    report["painting"] = bpy.context.mode
    canvas = bpy.context.view_layer.objects.active  # painted by a script: Debian's Blender comes without brushes
    canvas.vertex_groups.active.add(range(len(canvas.data.vertices)), 1.0, "REPLACE")
    for name, part in (("splats", 0.15), ("mesh", 0.5)):
        yield from push(f"part='{name}'", part)
        yield after(4.0)
        photograph(f"painted {name}")
    yield from remove_edit()


def hint():
    """Say that the ball is metal. Cancel before the click, then the dialogue, then train; then answer a question, and cancel."""
    report["begun"], highlighted = {}, addon("trainer.ui.highlight")

    def count(step):
        begun = sum(job.run is not None for job in jobs())
        report["begun"][step] = begun, len(bpy.context.scene.refgs.runs), highlighted._handler is not None

    for step in ("hovered", "asked", "agreed"):
        yield from push("refgs.hint(kind='metal', question=0)")
        point(*middle())
        yield after(3.0)
        if step == "hovered":
            photograph("hovered")
            count("hovering")
        else:
            yield from click(*middle())
            yield after(2.0)
        if step == "asked":
            photograph("asked")
            count("asking")
        yield from press("Return" if step == "agreed" else "Escape", *middle())
        if step == "asked":
            photograph("cancelled")
        count(step)
    yield lambda: jobs()[-1].ended
    report["hinted"] = jobs()[-1].state, jobs()[-1].name
    yield from push("refgs.hint(kind='paint', question=1)", 0.7)
    yield after(2.0)
    photograph("question")
    yield from press("Escape", *middle())
    count("answered")


def make_picture():
    """Make a ball of copper, light it by another panorama as the photos' light did, and save a picture of it."""
    yield from add_edit("Sphere")
    yield from push("refgs.remove_edit", 0.91, beside=MATERIALS, entry=COPPER)
    report["edit"] = addon("scene.edit").edits(bpy.data.objects["still splats"])[0].name
    yield from push("refgs.relight", beside=LIGHT, entry=SUNSET)
    yield from push("refgs.match_light")
    yield after(4.0)
    photograph("relit")
    report["relit"] = light()
    yield from push("refgs.render_preview")
    yield from choose_file(str(OUT), "relit ball.png")
    yield lambda: jobs()[-1].ended
    yield after(2.0)
    photograph("picture")
    report["picture"] = jobs()[-1].state, jobs()[-1].line


act(artist(), pause=0.02)
