"""Foot IK of jaxik for Blender: puts the feet of an animation onto uneven ground.

The panel is in the sidebar of the 3D view, under jaxik. Choose an armature with an action and an
object as its ground, and press Bake Foot IK: the armature gets a new action in which legs, pelvis
and spine follow the ground, and the one before is kept. Ctrl-Z takes all of it back. In the new
action, custom properties of the armature say when each foot stands and how far the pelvis has
moved. Baking again begins with the animation as it was before.

jaxik computes in a process of its own, in a Python of its own; the preferences say how to install
it. Scripts may call `bpy.ops.jaxik.bake()`, which waits for the end.
"""

import time

import bpy
from bpy.props import EnumProperty, FloatProperty, PointerProperty, StringProperty

from . import exchange, job, process
from .exchange import Refusal

TICK = 0.05  # s between the steps of a job
SHARE = 0.03  # s of them that a job takes
PASSED = {"MOUSEMOVE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "MIDDLEMOUSE", "INBETWEEN_MOUSEMOVE"}
SYSTEMS = [
    (job.AUTO, "Automatic", "What jaxik chooses: stride where all feet stand in turn"),
    ("stride", "Stride", "For people on uneven ground: steps, slopes, rubble"),
    ("record", "Record", "Behind a game engine's parameter record"),
    ("unreal", "Unreal", "As in Unreal's sample character"),
    ("ozz", "ozz", "As in ozz-animation's sample"),
    ("mec", "Mec", "As in Mec's foot IK for Unity"),
    (job.FILE, "Parameter file", "A parameters.toml, of a fit or written by hand"),
]
ROOTS = [
    ("auto", "Automatic", "The root follows the ground where foot IK alone does not reach it"),
    ("animation", "As animated", "The root stays where it is"),
    ("ground", "On the ground", "The root follows the ground below it"),
]
TRAVELS = [
    ("auto", "Automatic", "A walk in place travels as its stances imply"),
    ("stances", "By stances", "The root travels so that standing feet stay put"),
    ("none", "As animated", "The root travels as it does"),
]


class Running:
    """The job of this session, if there is one: what it does and how far it is."""

    step: job.Step | None = None


def is_mesh(_, thing: bpy.types.Object) -> bool:
    """Whether an object may have faces."""
    return thing.type in {"MESH", "CURVE", "SURFACE", "META", "FONT"}


class JaxikSettings(bpy.types.PropertyGroup):
    """What the panel shows; stored with the scene."""

    armature: PointerProperty(
        name="Armature",
        type=bpy.types.Object,
        poll=lambda _, thing: thing.type == "ARMATURE",
        description="The character, with an action on flat ground",
    )
    ground: PointerProperty(
        name="Ground",
        type=bpy.types.Object,
        poll=is_mesh,
        description="What it is to walk on, with modifiers",
    )
    system: EnumProperty(name="System", items=SYSTEMS, description="Which foot IK")
    parameters: StringProperty(
        name="File", subtype="FILE_PATH", description="parameters.toml of a run of jaxik"
    )
    root: EnumProperty(name="Root", items=ROOTS, description="Height of the whole character")
    travel: EnumProperty(name="Travel", items=TRAVELS, description="Way of the whole character")
    floor: FloatProperty(
        name="Floor", subtype="DISTANCE", description="Height on which the animation was made"
    )
    sole: FloatProperty(
        name="Sole",
        subtype="DISTANCE",
        min=0.0,
        description="Height of the balls of the feet over their soles; 0 is measured",
    )
    metres: FloatProperty(
        name="Metres per unit",
        min=0.0,
        soft_max=1.0,
        precision=4,
        description="0 is the unit scale of the scene; 0.01 for a character in centimetres",
    )


for role in exchange.roles():  # pelvis, hip_left ...
    JaxikSettings.__annotations__[role] = StringProperty(
        name=role.replace("_", " ").capitalize(), description="Empty: by the names of the bones"
    )


class JaxikPreferences(bpy.types.AddonPreferences):
    """Where jaxik is."""

    bl_idname = __package__

    python: StringProperty(
        name="Python of jaxik",
        subtype="FILE_PATH",
        description="Of the environment in which jaxik is installed; empty: the one that wrote "
        "this add-on, or the command jaxik on PATH",
    )

    def draw(self, _) -> None:
        """Says how to get it."""
        self.layout.prop(self, "python")
        self.layout.label(text="To install jaxik, in a terminal:")
        row = self.layout.row()
        row.label(text=process.INSTALL)
        row.operator("jaxik.copy_command", icon="COPYDOWN")
        self.layout.label(text="Then choose jaxik/bin/python (Windows: jaxik\\Scripts\\python.exe)")


class JAXIK_OT_copy_command(bpy.types.Operator):
    """Copy the command that installs jaxik"""

    bl_idname, bl_label = "jaxik.copy_command", "Copy"

    def execute(self, context):
        context.window_manager.clipboard = process.INSTALL
        return {"FINISHED"}


class Job:
    """An operator that does a job: at once when a script calls it, step by step in a window."""

    @classmethod
    def poll(cls, context) -> bool:
        """Whether all is chosen and no other job runs."""
        settings = context.scene.jaxik
        for thing, words in cls.needs(settings):
            if thing is None:
                cls.poll_message_set(words)
                return False
        return Running.step is None

    def execute(self, context):
        """Does the job, and waits for it."""
        try:
            self.steps = self.work(context, order_of(context))
            while (step := self.advance()) is not None:
                if step.waits:
                    time.sleep(TICK)
        except Refusal as refusal:
            self.report({"ERROR"}, str(refusal))
            return {"CANCELLED"}
        self.finish(context, self.result)
        return {"FINISHED"}

    def advance(self) -> job.Step | None:
        """Takes a step, None when all is done."""
        try:
            return next(self.steps)
        except StopIteration as finished:
            self.result = finished.value
            return None

    def invoke(self, context, _):
        """Begins the job in a window."""
        try:
            self.steps = self.work(context, order_of(context))
        except Refusal as refusal:
            self.report({"ERROR"}, str(refusal))
            return {"CANCELLED"}
        Running.step = job.Step("starting", 0.0)
        manager = context.window_manager
        self.timer = manager.event_timer_add(TICK, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Goes on with the job, or ends it with Esc."""
        if event.type == "ESC" and not Running.step.is_last:
            self.cancel(context)
            self.report({"INFO"}, f"{self.bl_label}: cancelled, nothing has changed")
            return {"CANCELLED"}
        if event.type != "TIMER":  # while jaxik computes, the user may go on
            return {"PASS_THROUGH"} if Running.step.waits else {"RUNNING_MODAL"}
        try:
            until = time.perf_counter() + SHARE
            while (step := self.advance()) is not None:
                Running.step = step
                if step.waits or time.perf_counter() > until:
                    show_progress(context, step)
                    return {"PASS_THROUGH"}
        except Refusal as refusal:
            self.cancel(context)
            self.report({"ERROR"}, str(refusal))
            return {"CANCELLED"}
        except BaseException:
            self.cancel(context)
            raise
        self.cancel(context)
        self.finish(context, self.result)
        return {"FINISHED"}

    def cancel(self, context) -> None:
        """Ends what a job needs; Blender calls this when it closes a window."""
        self.steps.close()
        Running.step = None
        context.window_manager.event_timer_remove(self.timer)
        show_progress(context, None)


def show_progress(context, step: job.Step | None) -> None:
    """Shows what is being done below the window and in the panel."""
    text = None if step is None else f"jaxik: {step.text}; Esc cancels"
    context.workspace.status_text_set(text)
    for area in context.screen.areas:
        if area.type == "VIEW_3D":
            area.tag_redraw()


class JAXIK_OT_bake(Job, bpy.types.Operator):
    """Bake foot IK onto the ground as a new action; the one before is kept"""

    bl_idname, bl_label, bl_options = "jaxik.bake", "Bake Foot IK", {"UNDO"}
    work = staticmethod(job.bake)

    @staticmethod
    def needs(settings):
        """What has to be chosen."""
        yield settings.armature, "Choose an armature"
        yield settings.ground, "Choose a ground"

    def finish(self, context, remarks: list[str]) -> None:
        """Says what has been done."""
        self.report({"INFO"}, remarks[0])
        for remark in remarks[1:]:
            self.report({"WARNING"}, remark)


class JAXIK_OT_find_bones(Job, bpy.types.Operator):
    """Fill in the bones of the legs as jaxik knows them by their names"""

    bl_idname, bl_label, bl_options = "jaxik.find_bones", "Find Bones", {"UNDO"}
    work = staticmethod(job.find_bones)

    @staticmethod
    def needs(settings):
        """What has to be chosen."""
        yield settings.armature, "Choose an armature"

    def finish(self, context, bones: dict[str, str]) -> None:
        """Fills in the bones."""
        settings = context.scene.jaxik
        known = settings.armature.data.bones
        for role, name in bones.items():
            setattr(settings, role, name if name in known else "")
        if missing := [role for role in exchange.required() if not bones[role]]:
            words = ", ".join(missing).replace("_", " ")
            self.report({"WARNING"}, f"choose by hand: {words}")


def order_of(context) -> job.Order:
    """What the panel says.

    Raises:
        Refusal: some bones of the legs are chosen and others are not, or jaxik is not there.
    """
    scene = context.scene
    settings, units = scene.jaxik, scene.unit_settings
    unit = 1.0 if units.system == "NONE" else units.scale_length
    chosen = {role: getattr(settings, role) for role in exchange.roles()}
    bones = {role: name for role, name in chosen.items() if name}
    if bones and (missing := [role for role in exchange.required() if role not in bones]):
        raise Refusal(f"choose all bones of both legs, or none: there is no {missing[0]}")
    preferences = context.preferences.addons[__package__].preferences
    return job.Order(
        armature=settings.armature.name,
        ground=settings.ground.name if settings.ground else "",
        system=settings.system,
        parameters=bpy.path.abspath(settings.parameters),
        root=settings.root,
        travel=settings.travel,
        sole=settings.sole,
        floor=settings.floor,
        metres=settings.metres or unit,
        bones=bones,
        start=process.command(bpy.path.abspath(preferences.python)),
    )


class Panel:
    """In the sidebar of the 3D view."""

    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "jaxik"


class JAXIK_PT_foot_ik(Panel, bpy.types.Panel):
    """What is baked onto what."""

    bl_label = "Foot IK"

    def draw(self, context) -> None:
        """Armature, ground, system, and the button."""
        layout, settings = self.layout, context.scene.jaxik
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(settings, "armature")
        layout.prop(settings, "ground")
        layout.prop(settings, "system")
        if settings.system == job.FILE:
            layout.prop(settings, "parameters")
        if (step := Running.step) is not None:
            layout.progress(factor=step.fraction, text=step.text)
            layout.label(text="Esc cancels")
        else:
            layout.operator("jaxik.bake", icon="POSE_HLT")


class JAXIK_PT_placement(Panel, bpy.types.Panel):
    """How the animation lies."""

    bl_label, bl_parent_id, bl_options = "Placement", "JAXIK_PT_foot_ik", {"DEFAULT_CLOSED"}

    def draw(self, context) -> None:
        """Root, floor, soles and scale."""
        self.layout.use_property_split = True
        for name in ("root", "travel", "floor", "sole", "metres"):
            self.layout.prop(context.scene.jaxik, name)


class JAXIK_PT_bones(Panel, bpy.types.Panel):
    """Which bone is which."""

    bl_label, bl_parent_id, bl_options = "Bones", "JAXIK_PT_foot_ik", {"DEFAULT_CLOSED"}

    def draw(self, context) -> None:
        """A field for each role."""
        layout, settings = self.layout, context.scene.jaxik
        layout.use_property_split = True
        layout.label(text="Empty: by their names")
        layout.operator("jaxik.find_bones")
        if settings.armature is not None:
            for role in exchange.roles():
                layout.prop_search(settings, role, settings.armature.data, "bones")


CLASSES = (
    JaxikSettings, JaxikPreferences, JAXIK_OT_copy_command, JAXIK_OT_bake, JAXIK_OT_find_bones,
    JAXIK_PT_foot_ik, JAXIK_PT_placement, JAXIK_PT_bones,
)  # fmt: skip


def register() -> None:
    """Blender calls this when the add-on is enabled."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.jaxik = PointerProperty(type=JaxikSettings)


def unregister() -> None:
    """Blender calls this when the add-on is disabled."""
    del bpy.types.Scene.jaxik
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
