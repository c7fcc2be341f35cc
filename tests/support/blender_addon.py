"""Runs in a Python that has Blender as a module: installs the add-on, and bakes with it.

    python blender_addon.py jaxik-blender.zip walk.bvh ground.npz PYTHON FOLDER

PYTHON has jaxik. Writes into the folder `<case>.npz` with the heads of bones before and after,
(frames, bones, 3), metres y up, and `answers.json`: what was seen, and what the add-on said.
"""

import importlib
import itertools
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np
from blender_scenes import armature, begin, y_up
from mathutils import Euler, Vector  # pyright: ignore[reportMissingImports]

ADDON = "bl_ext.user_default.jaxik"


def settings():
    """What the panel shows."""
    return bpy.context.scene.jaxik


def preferences():
    return bpy.context.preferences.addons[ADDON].preferences


def install(archive: str) -> None:
    """Installs the add-on as a user does, from disk."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    )


def make_ground(path: str):
    """A mesh of the scene, turned to z up."""
    with np.load(path) as content:
        vertices, faces = content["vertices"], content["faces"]
    mesh = bpy.data.meshes.new("Ground")
    mesh.from_pydata((vertices @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]]).tolist(), [], faces.tolist())
    ground = bpy.data.objects.new("Ground", mesh)
    bpy.context.scene.collection.objects.link(ground)
    return ground


def heads(rig) -> np.ndarray:
    """Where the bones are in each frame, m."""
    scene, frames = bpy.context.scene, rig.animation_data.action.frame_range
    places = []
    for frame in range(round(frames[0]), round(frames[1]) + 1):
        scene.frame_set(frame)
        places.append([rig.matrix_world @ bone.head for bone in rig.pose.bones])
    return y_up(places)


def save(path: Path, rig, before: np.ndarray, after: np.ndarray) -> None:
    names = np.array([bone.name for bone in rig.pose.bones])
    np.savez(path, names=names, before=before, after=after)


def said(call, *words) -> str:
    """What an operator reports, when it refuses."""
    try:
        call(*words)
    except RuntimeError as error:
        return str(error).strip().removeprefix("Error: ")
    return ""


def scene_of(bvh: str, ground: str):
    """A new scene with a character on a ground, both chosen in the panel."""
    python = preferences().python
    begin()
    bpy.ops.preferences.addon_enable(module=ADDON)
    preferences().python = python
    bpy.ops.import_anim.bvh(filepath=bvh, frame_start=1, global_scale=0.01)
    rig = armature()
    settings().armature, settings().ground = rig, make_ground(ground)
    settings().system = "ozz"
    return rig


def modules() -> SimpleNamespace:
    """Of the add-on that is installed."""
    names = ("exchange", "job", "process", "rig")
    return SimpleNamespace(**{name: importlib.import_module(f"{ADDON}.{name}") for name in names})


def keep_solutions(folder: Path) -> None:
    """Has the add-on leave each file of jaxik as `solved.npz`."""
    run = modules().process.run

    def kept(start, words, where):
        yield from run(start, words, where)
        if words[0] == "run":
            shutil.copy(where / "solved.npz", folder)

    modules().process.run = kept


def replay_solutions(folder: Path) -> None:
    """Has the add-on take the last of these files instead of calling jaxik."""

    def replay(start, words, where):
        for stream in ("stdout", "stderr"):
            (where / stream).touch()
        yield "replaying"
        shutil.copy(folder / "solved.npz", where)

    modules().process.run = replay


def plain(bvh: str, ground: str, folder: Path) -> dict:
    """A character as it is imported; baked, baked again, and taken back."""
    rig = scene_of(bvh, ground)
    action, before = rig.animation_data.action, heads(rig)
    bpy.context.scene.frame_set(7)
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.jaxik.bake("EXEC_DEFAULT", True)
    baked = rig.animation_data.action
    answers = {"frame": bpy.context.scene.frame_current, "kept": action.use_fake_user}
    answers["names"] = [action.name, baked.name]
    after = heads(rig)
    bpy.context.scene.frame_set(20)
    answers["properties"] = {key: np.array(rig[key]).tolist() for key in rig.keys()}
    replay_solutions(folder)
    bpy.ops.jaxik.bake()
    answers["again"] = float(np.abs(heads(rig) - after).max())
    save(folder / "plain.npz", rig, before=before, after=after)
    bpy.ops.ed.undo()
    rig = armature()
    answers["undone"] = [rig.animation_data.action.name, *rig.keys()]
    return answers


def edited(rig):
    """The bones of an armature, to be edited."""
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing == rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    return rig.data.edit_bones


def done() -> None:
    bpy.ops.object.mode_set(mode="OBJECT")


def dress(rig):
    """The same character in centimetres, turned, below another object, with more bones."""
    scene, copy = bpy.context.scene, rig.copy()
    copy.data = rig.data.copy()
    copy.animation_data_clear()
    scene.collection.objects.link(copy)
    bones = edited(copy)
    for number, bone in enumerate(bones):
        bone.head, bone.tail, bone.roll = bone.head * 100, bone.tail * 100, 0.3 * number
    for name in ("left_hip", "right_ankle"):
        extra = bones.new(f"control.{name}")
        extra.head, extra.tail = bones[name].head, bones[name].head + bones[name].x_axis * 10
        extra.parent = bones[name]
    done()
    above = bpy.data.objects.new("above", None)
    scene.collection.objects.link(above)
    above.rotation_euler, above.location, copy.parent = (0.0, 0.0, 1.0), (0.3, -0.4, 0.0), above
    copy.scale, copy.rotation_euler = (0.01,) * 3, (0.0, 0.0, -0.6)
    modes = ("QUATERNION", "AXIS_ANGLE", "YXZ", "ZYX") * 3
    for mode, name in zip(modes, rig.pose.bones.keys(), strict=False):
        bone = copy.pose.bones[name]
        bone.rotation_mode = mode
        for kind in ("COPY_LOCATION", "COPY_ROTATION"):
            constraint = bone.constraints.new(kind)
            constraint.target, constraint.subtarget = rig, name
    first, last = map(round, rig.animation_data.action.frame_range)
    bpy.ops.object.mode_set(mode="POSE")
    bpy.ops.nla.bake(
        frame_start=first, frame_end=last, visual_keying=True, clear_constraints=True,
        only_selected=False, bake_types={"POSE"},
    )  # fmt: skip
    done()
    bpy.data.objects.remove(rig)
    copy.pose.bones["left_knee"].constraints.new("LIMIT_ROTATION")
    return copy


def dressed(bvh: str, ground: str, folder: Path) -> dict:
    """A character as games have them, its bones chosen by jaxik and then by hand."""
    settings().armature = rig = dress(scene_of(bvh, ground))
    for bone in list(rig.data.bones):
        bone.name = bone.name.replace("left_", "L my ").replace("right_", "R my ")
    answers: dict[str, object] = {"unknown": said(bpy.ops.jaxik.bake)}
    for bone in rig.data.bones:
        side, _, name = bone.name.partition(" my ")
        if side in ("L", "R") and name != "toe":
            setattr(settings(), f"{name}_{'left' if side == 'L' else 'right'}", bone.name)
    answers["incomplete"] = said(bpy.ops.jaxik.bake)
    settings().pelvis = "pelvis"
    before = heads(rig)
    bpy.ops.jaxik.bake()
    save(folder / "dressed.npz", rig, before=before, after=heads(rig))
    answers["muted"] = rig.pose.bones["L my knee"].constraints[0].mute
    answers["size"] = [round(number, 6) for number in rig.scale]
    bpy.ops.jaxik.find_bones()
    return answers | {"found": settings().hip_left}


def tangle(rng: np.random.Generator):
    """An armature with everything that bones may have, moving at random."""
    data = bpy.data.armatures.new("tangle")
    rig = bpy.data.objects.new("tangle", data)
    bpy.context.scene.collection.objects.link(rig)
    bones = edited(rig)
    for number in range(14):
        bone = bones.new(f"bone {number}")
        bone.parent = bones[f"bone {rng.integers(number)}"] if number > 2 else None
        bone.use_connect = bool(number % 3 == 0 and bone.parent)
        bone.head = bone.parent.tail if bone.use_connect else rng.normal(size=3)
        bone.tail, bone.roll = bone.head + Vector(rng.normal(size=3)), rng.normal()
    done()
    rig.data.bones["bone 7"].use_inherit_rotation = False
    rig.data.bones["bone 8"].use_local_location = False
    rig.data.bones["bone 10"].inherit_scale = "NONE"
    for number, bone in enumerate(rig.pose.bones):
        bone.rotation_mode = ("QUATERNION", "XYZ", "AXIS_ANGLE", "ZXY")[number % 4]
    target = bpy.data.objects.new("target", None)
    bpy.context.scene.collection.objects.link(target)
    for frame in range(1, 9):
        target.location = rng.normal(size=3)
        target.keyframe_insert("location", frame=frame)
        rig.scale, rig.location = (float(rng.uniform(0.5, 2.0)),) * 3, rng.normal(size=3)
        rig.rotation_euler = rng.normal(size=3)
        for path in ("location", "rotation_euler", "scale"):
            rig.keyframe_insert(path, frame=frame)
        for bone in rig.pose.bones:
            bone.location, bone.scale = rng.normal(size=3), (float(rng.uniform(0.5, 2.0)),) * 3
            bone.matrix_basis = bone.matrix_basis @ Euler(rng.normal(size=3)).to_matrix().to_4x4()
            turns = {"QUATERNION": "quaternion", "AXIS_ANGLE": "axis_angle"}
            turn = f"rotation_{turns.get(bone.rotation_mode, 'euler')}"
            for path in ("location", "scale", turn):
                bone.keyframe_insert(path, frame=frame)
    chain = rig.pose.bones["bone 13"].constraints.new("IK")
    chain.target, chain.chain_count = target, 3
    return rig


def tangled(folder: Path) -> dict:
    """Any motion is baked onto any armature, whatever its bones inherit."""
    begin()
    parts, rng, rig = modules(), np.random.default_rng(3), tangle(np.random.default_rng(2))
    sampled = finish(parts.rig.sample(bpy.context, rig, list(range(1, 9))))
    locations, turns = parts.exchange.relative(sampled.motion)
    for bone in (0, 2, 5, 7, 9, 12, 13):
        turns[:, bone] = turns[:, bone] @ parts.exchange.matrices(unit(rng.normal(size=(8, 4))))
    locations[:, 0] += rng.normal(size=(8, 3))
    motion = sampled.motion._replace(positions=locations.copy(), rotations=turns.copy())
    for bone, parent in enumerate(motion.parents):
        if parent >= 0:
            above = motion.rotations[:, parent]
            offset = (above @ locations[:, bone, :, None])[..., 0]
            motion.positions[:, bone] = motion.positions[:, parent] + offset
            motion.rotations[:, bone] = above @ turns[:, bone]
    solved = parts.exchange.Solution(motion, {"left": rng.uniform(size=8)}, 0)
    planned = finish(parts.rig.plan(rig, sampled, solved))
    parts.rig.apply(rig, planned, sampled.frames)
    seen = finish(parts.rig.sample(bpy.context, rig, sampled.frames)).motion
    return {
        "off": float(np.abs(seen.positions - motion.positions).max()),
        "turned": float(np.abs(seen.rotations - motion.rotations).max()),
        "moved": float(np.abs(motion.positions - sampled.motion.positions).max()),
        "muted": planned.muted,
        "keyed": sorted({channel.group for channel in planned.channels}),
    }


def unit(quats: np.ndarray) -> np.ndarray:
    return quats / np.linalg.norm(quats, axis=-1, keepdims=True)


def finish(work):
    """What a job returns."""
    while True:
        try:
            next(work)
        except StopIteration as finished:
            return finished.value


def refusals(bvh: str, ground: str) -> dict:
    """What is said of what cannot be used."""
    rig, answers = scene_of(bvh, ground), {}
    python, action = preferences().python, rig.animation_data.action
    preferences().python = str(Path(sys.executable))
    answers["a Python without jaxik"] = said(bpy.ops.jaxik.bake)
    preferences().python = "/nowhere/python"
    answers["no Python"] = said(bpy.ops.jaxik.bake)
    preferences().python = python
    rig.data.pose_position = "REST"
    answers["at rest"] = said(bpy.ops.jaxik.bake)
    rig.animation_data.action = None
    answers["no action"] = said(bpy.ops.jaxik.bake)
    settings().ground.data.clear_geometry()
    rig.data.pose_position, rig.animation_data.action = "POSE", action
    answers["no faces"] = said(bpy.ops.jaxik.bake)
    settings().ground = None
    answers["no ground"] = said(bpy.ops.jaxik.bake)
    answers["actions"] = len(bpy.data.actions)
    return answers


class Context:
    """That of Blender, without what needs a window."""

    window_manager = MagicMock()

    def __getattr__(self, name: str):
        return getattr(bpy.context, name)


def windowed(bvh: str, ground: str, folder: Path) -> dict:
    """Baked step by step as in a window, at first cancelled."""
    rig = scene_of(bvh, ground)
    addon: Any = importlib.import_module(ADDON)
    replay_solutions(folder)
    first, last = rig.animation_data.action.frame_range
    readings = itertools.count(0.0, addon.SHARE)  # a clock by which every step takes its share
    addon.time = SimpleNamespace(perf_counter=readings.__next__)
    events, cancelled_at = itertools.count(), [1]

    def execute(self, _):
        """What Blender does with an operator in a window, of which there is none here."""
        context = Context()
        result = self.invoke(context, None)
        while result <= {"RUNNING_MODAL", "PASS_THROUGH"}:
            kind = "ESC" if next(events) in cancelled_at else "TIMER"
            result = self.modal(context, SimpleNamespace(type=kind))
        return result

    addon.Job.execute = execute
    cancelled = [sorted(bpy.ops.jaxik.bake()), rig.animation_data.action.name, *rig.keys()]
    cancelled_at.clear()
    ended = [sorted(bpy.ops.jaxik.bake()), rig.animation_data.action.name]
    frames = round(last) - round(first) + 1
    return {"cancelled": cancelled, "ended": ended, "events": next(events), "frames": frames}


def main(archive: str, bvh: str, ground: str, python: str, place: str) -> None:
    """All cases, one after another."""
    folder = Path(place)
    install(archive)
    preferences().python = python
    keep_solutions(folder)
    answers = {"dressed": dressed(bvh, ground, folder)}
    (folder / "solved.npz").rename(folder / "dressed_solved.npz")
    answers["refusals"] = refusals(bvh, ground)
    answers["plain"] = plain(bvh, ground, folder)
    answers["windowed"] = windowed(bvh, ground, folder)
    answers["tangled"] = tangled(folder)
    (folder / "answers.json").write_text(json.dumps(answers))


if __name__ == "__main__":
    main(*sys.argv[1:])
