"""Define the operator that trains a run again with a hint: a part of the object's surface is metal, or is paint."""

from typing import TYPE_CHECKING, ClassVar

import bpy
from bpy.props import EnumProperty, FloatVectorProperty, IntProperty
from bpy_extras.view3d_utils import region_2d_to_origin_3d, region_2d_to_vector_3d
from mathutils import Vector

from ... import jobs
from ...errors import InputError, missing_module
from ...preferences import wrapped_text
from ...scene.doubt import has_doubt
from ...scene.run_parts import active_run
from ...ui.icons import thumbnail
from ...ui.materials_panel import MaterialPanel
from ...ui.operators import OnRun
from ..scene import training
from ..scene.questions import KINDS, questions
from . import highlight
from .on_capture import has_trainer

if TYPE_CHECKING:
    import numpy as np

WIDTH = 400  # pixels of the dialogue


class Hint(OnRun, bpy.types.Operator):
    """Train the active run again with a hint: the material of a part of the object, metal or paint.

    The part is the piece of a `question` (see `scene.questions`), counted from 1. If it is 0, the part is what the artist has selected:
    splats in Edit Mode, or a box or ball around splats. If nothing is selected, wait for a click on the part in the 3D view. Before the
    training, the part is coloured in the 3D views and the artist is asked.
    """

    bl_idname = "refgs.hint"
    bl_label = "This Part Is"
    bl_options: ClassVar = {"REGISTER"}

    kind: EnumProperty(name="Material", items=[("metal", "Metal", ""), ("paint", "Paint", "")])
    origin: FloatVectorProperty(
        name="Origin", description="Of the ray through the clicked pixel", options={"HIDDEN", "SKIP_SAVE"}
    )
    direction: FloatVectorProperty(
        name="Direction", description="Of this ray; zero without", options={"HIDDEN", "SKIP_SAVE"}
    )
    question: IntProperty(
        name="Question", description="Number of the question that is answered; 0: none", min=0, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_trainer(cls) and super().poll(context)

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        what = {"metal": "metal, such as chrome", "paint": "no metal: paint, plastic, glaze"}[properties.kind]
        if properties.question:
            return f"Train again, where the outlined piece is {what}. You are asked before it begins"
        return (
            f"Train again, where a part is {what}. Click on the part: it is taken up to its creases. "
            "Or first select its splats in Edit Mode, or the box or ball of a material edit around them. "
            "You are asked before it begins"
        )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        try:
            return self._begin(context)
        except InputError as error:
            self.report({"ERROR"}, str(error))
        except ModuleNotFoundError as error:
            self.report({"ERROR"}, missing_module(error))
        return {"CANCELLED"}

    def _begin(self, context: bpy.types.Context) -> set[str]:
        """Ask whether to train, or wait for a click where no part is known yet."""
        from ...scene.edit import splats_of
        from ..scene.hints import Surface, chosen_part

        run = active_run(context)
        plan, splats = training.plan_hint(context.scene, run), splats_of(run)
        points = self._asked_about(run)
        if points is None and not any(self.direction):
            points = chosen_part(splats, context.view_layer.objects.active)
        surface = Surface(splats)
        if points is not None:
            part = surface.nearest(points)
        elif any(self.direction):
            seed = surface.hit(Vector(self.origin), Vector(self.direction))
            if seed is None:
                raise InputError("no splat is under the cursor: click on the part")
            part = surface.smooth_part(seed)
        else:
            self._surface, self._hovered = surface, None
            context.window.cursor_modal_set("EYEDROPPER")
            context.workspace.status_text_set(f"Click on the part that is {self.kind}. Esc cancels")
            context.window_manager.modal_handler_add(self)
            return {"RUNNING_MODAL"}
        self._words = confirmation(plan, self.kind, float(part.mean()), context.scene.refgs.mesh)
        highlight.show(surface.corners(part))
        title = f"Train Again with This Part as {self.kind.capitalize()}?"
        return context.window_manager.invoke_props_dialog(self, width=WIDTH, title=title, confirm_text="Train")

    def draw(self, context: bpy.types.Context) -> None:
        for words in self._words:
            wrapped_text(self.layout, words, WIDTH // 7)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in ("RIGHTMOUSE", "ESC"):
            self._end_click(context)
            return {"CANCELLED"}
        if event.type == "MOUSEMOVE":
            self._hover(clicked_ray(context.screen, event.mouse_x, event.mouse_y))
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}  # the view can be turned
        ray = clicked_ray(context.screen, event.mouse_x, event.mouse_y)
        if ray is not None and self._surface.hit(*ray) is None:
            self.report({"WARNING"}, "No splat is under the cursor: click on the part. Esc cancels")
            return {"RUNNING_MODAL"}
        self._end_click(context)
        if ray is not None:
            try:  # in an operator of its own: one that waits for clicks cannot open a dialogue
                bpy.ops.refgs.hint("INVOKE_DEFAULT", kind=self.kind, origin=ray[0], direction=ray[1])
            except RuntimeError as error:
                self.report({"ERROR"}, str(error))
        return {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Clean up where the dialogue is cancelled, or Blender ends the wait for a click."""
        self._end_click(context)

    def _end_click(self, context: bpy.types.Context) -> None:
        highlight.clear()
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)

    def _hover(self, ray: tuple[Vector, Vector] | None) -> None:
        """Colour the part that a ray hits. The part that was coloured before is kept while the ray stays in it, because that is fast."""
        seed = self._surface.hit(*ray) if ray else None
        if seed is None:
            self._hovered = None
            highlight.clear()
        elif self._hovered is None or not self._hovered[seed]:
            self._hovered = self._surface.smooth_part(seed)
            highlight.show(self._surface.corners(self._hovered))

    def _asked_about(self, run: bpy.types.Collection) -> "np.ndarray | None":
        """Return the positions (P, 3) of the splats that the question is about, or None without a question."""
        if not self.question:
            return None
        asked = questions(run)
        if self.question > len(asked):
            raise InputError(f"{run.name} has no question {self.question}: import it again")
        return asked[self.question - 1].points

    def execute(self, context: bpy.types.Context) -> set[str]:
        highlight.clear()
        return super().execute(context)

    def work(self, context: bpy.types.Context) -> None:
        ray = (Vector(self.origin), Vector(self.direction)) if any(self.direction) else None
        run = active_run(context)
        job = training.train_with_hint(context.scene, run, self.kind, ray, self._asked_about(run))
        self.report({"INFO"}, f"Training {job.name} with this part as {self.kind}")


def confirmation(plan: training.HintPlan, kind: str, part: float, mesh: bool) -> list[str]:
    """Say what a training with a hint does, in lines for a dialogue. `part` is the fraction of the splats that are held as `kind`."""
    minutes = "a minute" if plan.minutes == 1 else f"{plan.minutes} minutes"
    share = f"{part:.0%}" if part >= 0.01 else "less than 1%"
    lines = [
        f"The orange part, {share} of the splats, is held as {kind}.",
        f"The later part of the training is repeated. This takes about {minutes}{', then the mesh is made' if mesh else ''}.",
        f"The result is a new run, “{plan.out.name}”. This run stays as it is.",
    ]
    if jobs.trainings():
        lines.append("It begins when the trainings before it have ended.")
    return lines


def clicked_ray(screen: bpy.types.Screen, x: int, y: int) -> tuple[Vector, Vector] | None:
    """Return the ray through a pixel of a 3D view, as origin and direction in world space.

    `x` and `y` count pixels from the lower left corner of the window. Returns None if the pixel is not in a 3D view, or is in a 3D view's
    header or sidebar.
    """
    regions = [region for area in screen.areas if area.type == "VIEW_3D" for region in area.regions]
    there = [r for r in regions if r.x <= x < r.x + r.width and r.y <= y < r.y + r.height]
    if not there or any(region.type != "WINDOW" for region in there):  # the sidebar and the header lie over the view
        return None
    region, place = there[0], (x - there[0].x, y - there[0].y)
    return region_2d_to_origin_3d(region, region.data, place), region_2d_to_vector_3d(region, region.data, place)


def _draw(self, context: bpy.types.Context) -> None:
    """Draw the questions about the active run's materials at the end of the Materials panel, and buttons for hints without a question."""
    layout, run = self.layout, active_run(context)
    for number, question in enumerate(questions(run) if run and has_doubt(run) else (), 1):
        box = layout.box()
        box.label(text=f"Metal or paint? {question.part:.0%}, now {question.now}", icon="QUESTION")
        if shown := thumbnail(question.picture, round(1e4 * question.part)):
            box.template_icon(icon_value=shown, scale=8)
        row = box.row(align=True)
        for kind in KINDS:
            button = row.operator(Hint.bl_idname, text=kind.capitalize(), depress=kind == question.now)
            button.kind, button.question = kind, number
    row = layout.row(align=True)
    metal = row.operator(Hint.bl_idname, text="This Part Is Metal")
    paint = row.operator(Hint.bl_idname, text="This Part Is Paint")
    metal.kind, paint.kind = KINDS
    metal.question = paint.question = 0


CLASSES = (Hint,)


def register() -> None:
    MaterialPanel.append(_draw)


def unregister() -> None:
    MaterialPanel.remove(_draw)
