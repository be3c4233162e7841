"""Define the operator that trains a run again with a hint: a part of the object's surface is metal, or is paint."""

import bpy
from bpy.props import EnumProperty, FloatVectorProperty, IntProperty
from bpy_extras.view3d_utils import region_2d_to_origin_3d, region_2d_to_vector_3d
from mathutils import Vector

from ..errors import InputError
from ..scene import training
from ..scene.questions import questions
from ..scene.run_parts import active_run
from .operators import OnRun, has_trainer

KINDS = "metal", "paint"


class Hint(OnRun, bpy.types.Operator):
    """Train the active run again with a hint: the material of a part of the object, metal or paint.

    The part is the piece of a `question` (see `scene.questions`), counted from 1. If it is 0, the part is what the artist has selected:
    splats in Edit Mode, or a box or ball around splats. If nothing is selected, wait for a click on the part in the 3D view.
    """

    bl_idname = "refgs.hint"
    bl_label = "This Part Is"

    kind: EnumProperty(name="Material", items=[("metal", "Metal", ""), ("paint", "Paint", "")])
    origin: FloatVectorProperty(name="Origin", description="Of the ray through the clicked pixel", options={"HIDDEN"})
    direction: FloatVectorProperty(name="Direction", description="Of this ray; zero without", options={"HIDDEN"})
    question: IntProperty(name="Question", description="Number of the question that is answered; 0: none", min=0)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_trainer(cls) and super().poll(context)

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        what = {"metal": "metal, such as chrome", "paint": "no metal: paint, plastic, glaze"}[properties.kind]
        if properties.question:
            return f"Train again, where the outlined piece is {what}"
        return (
            f"Train again, where a part is {what}. Click on the part: it is taken up to its creases. "
            "Or first select its splats in Edit Mode, or the box or ball of a material edit around them"
        )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        from ..scene.edit import splats_of
        from ..scene.hints import chosen_part

        if self.question or chosen_part(splats_of(active_run(context)), context.view_layer.objects.active) is not None:
            return self.execute(context)
        context.window.cursor_modal_set("EYEDROPPER")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in ("RIGHTMOUSE", "ESC"):
            context.window.cursor_modal_restore()
            return {"CANCELLED"}
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}  # the view can be turned
        context.window.cursor_modal_restore()
        ray = clicked_ray(context.screen, event.mouse_x, event.mouse_y)
        if ray is None:
            return {"CANCELLED"}
        self.origin, self.direction = ray
        return self.execute(context)

    def work(self, context: bpy.types.Context) -> None:
        ray = (Vector(self.origin), Vector(self.direction)) if any(self.direction) else None
        run, points = active_run(context), None
        if self.question:
            asked = questions(run)
            if self.question > len(asked):
                raise InputError(f"{run.name} has no question {self.question}: import it again")
            points = asked[self.question - 1].points
        job = training.train_with_hint(context.scene, run, self.kind, ray, points)
        self.report({"INFO"}, f"Training {job.name} with this part as {self.kind}")


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


CLASSES = (Hint,)
