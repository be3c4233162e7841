"""Move the real mouse and press real keys by xdotool, for scripts in a Blender window that is started without --enable-event-simulate.

The functions that wait are generators: call them with `yield from` in the steps of `stage.act`.
"""

import functools
import subprocess

import bpy
from stage import after, area, photograph, region

STEP = 18  # pixels between two looks for a button, which is 20 high
_seen = {}  # where buttons were seen last: how far the sidebar was scrolled, and their height


def xdotool(*words):
    return subprocess.run(["xdotool", *map(str, words)], check=True, capture_output=True, text=True).stdout.strip()


@functools.cache
def number(window=0):
    """Return the X server's number of one of Blender's windows, oldest first. `window` is its place among them."""
    return sorted(map(int, xdotool("search", "--onlyvisible", "--class", "Blender").split()))[window]


def point(x, y, window=0):
    """Move the mouse in one of Blender's windows. `x` and `y` count pixels from its lower left corner."""
    height = bpy.context.window_manager.windows[window].height
    xdotool("mousemove", "--window", number(window), int(x), int(height - y))


def click(x, y, window=0):
    point(x, y, window)
    yield after(0.3)  # Blender highlights a button before it can be pressed
    xdotool("click", 1)
    yield after(1.0)


def press(key, x, y):
    """Move the mouse and press a key, named as X11 does."""
    point(x, y)
    yield after(0.4)
    xdotool("windowfocus", number(), "key", key)
    yield after(1.0)


def choose_tab():
    """Click on the sidebar's tabs until RefGS is shown."""
    sidebar = region("UI")
    for y in range(sidebar.y + sidebar.height - 20, sidebar.y, -2 * STEP):
        if sidebar.active_panel_category == "RefGS":
            return
        yield from click(sidebar.x + sidebar.width - 12, y)
    raise AssertionError("the sidebar has no tab RefGS")


def find(words, part=0.4):
    """Look for a button of the sidebar, and scroll to it. Returns its position.

    `words` are a part of its operator as Python, or of its property. `part` is where it is between the sidebar's left and right edges.
    """
    sidebar = region("UI")
    x = sidebar.x + part * (sidebar.width - 24)
    rows = range(sidebar.y + sidebar.height - STEP, sidebar.y + STEP, -STEP)
    looks = [(page, rows) for page in range(6)]
    known = [place for button, place in _seen.items() if words in button]
    if known:  # it may have moved since
        page, place = known[-1]
        looks.insert(0, (page, sorted(rows, key=lambda y: abs(y - place))))
    for page, heights in looks:
        point(x, sidebar.y + sidebar.height // 2)
        yield after(0.1)
        for clicks, wheel in ((40, 4), (8 * page, 5)):
            if clicks:
                xdotool("click", "--repeat", clicks, "--delay", 10, wheel)
        yield after(0.3)
        for y in heights:
            point(x, y)
            yield after(0.03)
            button = _under_mouse(sidebar)
            if button:
                _seen[button] = page, y
            if words in button:
                return x, y
    raise AssertionError(f"the sidebar has no button {words}")


def _under_mouse(sidebar):
    """Ask Blender for the button under the mouse, by what its context menu copies."""
    manager = bpy.context.window_manager
    manager.clipboard = ""
    with bpy.context.temp_override(window=manager.windows[0], area=area(), region=sidebar):
        for copy in (bpy.ops.ui.copy_python_command_button, bpy.ops.ui.copy_data_path_button):
            if copy.poll():
                copy()
                break
    return manager.clipboard


def push(words, part=0.4, beside=(0, 0), entry=None):
    """Click on a button of the sidebar that `find` finds, or `beside` it, and then on an entry of its menu.

    `beside` and `entry` are steps to the right and up, in pixels: from the found button to the pressed one, and from there to the entry.
    """
    x, y = yield from find(words, part)
    x, y = x + beside[0], y + beside[1]
    yield from click(x, y)
    if entry is not None:
        photograph("menu")
        yield from click(x + entry[0], y + entry[1])


def choose_file(folder, name=None):
    """Type a folder, and a file's name, into the file browser that has opened, and press its button."""
    yield lambda: len(bpy.context.window_manager.windows) > 1
    yield after(1.0)
    xdotool("windowfocus", number(1))  # not every window manager does
    path, below = (
        next(region for region in bpy.context.window_manager.windows[1].screen.areas[0].regions if region.type == kind)
        for kind in ("UI", "EXECUTE")
    )
    for place, part, text in ((path, 0.38, folder), (below, 0.33, name)):
        if text is not None:
            yield from click(place.x + part * place.width, place.y + place.height / 2, window=1)
            xdotool("key", "ctrl+a")
            xdotool("type", "--delay", 20, text)
            xdotool("key", "Return")
            yield after(1.5)
    yield from click(below.x + 0.91 * below.width, below.y + below.height / 2, window=1)
    yield lambda: len(bpy.context.window_manager.windows) == 1
    number.cache_clear()  # the next file browser is another window
