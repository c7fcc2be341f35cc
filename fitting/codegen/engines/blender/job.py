"""What takes long, in steps that are short enough for a window to stay alive.

A job is a generator of steps. What it holds while jaxik runs are names and numbers, as data of
Blender does not outlive an undo. Closed before its last steps, a job leaves all as it was.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np

from . import exchange, process, rig
from .exchange import Refusal

AUTO, FILE = "AUTO", "FILE"
"""Instead of a preset: what jaxik chooses, and a file of parameters."""
CHECKED = 16  # frames that are compared afterwards
NEAR = 1e-4  # m, between a bone and where jaxik has it
NAMED = 3  # in a remark
CLIP, GROUND, MAP, SOLVED = "clip.glb", "ground.ply", "bones.toml", "solved.npz"


class Order(NamedTuple):
    """What the user wants."""

    armature: str
    ground: str
    system: str
    """A preset, `AUTO` or `FILE`."""
    parameters: str
    """Path of a file of parameters."""
    root: str
    """As `jaxik run --root` takes it."""
    travel: str
    """As `jaxik run --travel` takes it."""
    floor: float
    """Height of the floor of the animation, in units of the scene."""
    sole: float
    """Height of the balls of the feet over their soles, in units of the scene; 0 is measured."""
    metres: float
    """Of one unit of the scene."""
    bones: dict[str, str]
    """By role; empty if jaxik is to know them by their names."""
    start: list[str]
    """The words that start jaxik."""


class Step(NamedTuple):
    """What is being done, and how far."""

    text: str
    fraction: float
    waits: bool = False
    """Whether there is nothing to do for a while."""
    is_last: bool = False
    """Whether all has changed that will."""


def bake(context: bpy.types.Context, order: Order) -> Iterator[Step]:
    """Bakes foot IK as a new action; returns remarks.

    Raises:
        Refusal: something cannot be used, or jaxik has failed.
    """
    with tempfile.TemporaryDirectory(prefix="jaxik-") as name:
        folder = Path(name)
        sampled = yield from _sample(context, order, folder / CLIP)
        _write_ground(context, order, folder / GROUND)
        for text in process.run(order.start, _words(order, folder), folder):
            yield Step(text, 0.4, waits=True)
        solution = exchange.read_solution(folder / SOLVED, sampled.motion)
        remarks = process.remarks(folder)
    yield Step("reading what jaxik has done", 0.6)
    solved = solution._replace(motion=exchange.z_up(solution.motion, order.metres))
    armature = _object(order.armature)
    if not sampled.is_of(armature):
        raise Refusal(f"{order.armature} has changed while jaxik was running")
    planned = yield from _steps("working out bones", 0.6, 0.9, rig.plan(armature, sampled, solved))
    action = rig.apply(armature, planned, sampled.frames)
    if planned.muted:
        names = [f"{constraint} of {bone}" for bone, constraint in planned.muted]
        remarks.append(f"muted, as {action.name} replaces what they do: {_few(names)}")
    off = yield from _difference(context, armature, sampled, planned.heads)
    off *= order.metres
    if off.max() > NEAR:
        names = [sampled.names[bone] for bone in np.argsort(-off) if off[bone] > NEAR]
        remarks.append(
            f"held by constraints or drivers up to {off.max() * 100:.2g} cm from where jaxik has "
            f"them: {_few(names)}"
        )
    return [f"{action.name} is the new action of {armature.name}", *remarks]


def find_bones(context: bpy.types.Context, order: Order) -> Iterator[Step]:
    """Asks jaxik which bones are pelvis and legs; returns them by role."""
    with tempfile.TemporaryDirectory(prefix="jaxik-") as name:
        folder = Path(name)
        yield from _sample(context, order, folder / CLIP, most=2)
        for text in process.run(order.start, ["inspect", CLIP, "--joints"], folder):
            yield Step(text, 0.5, waits=True)
        return exchange.read_map((folder / "stdout").read_text(encoding="utf-8"))


def _object(name: str) -> bpy.types.Object:
    if name not in bpy.data.objects:
        raise Refusal(f"{name} is no longer there")
    return bpy.data.objects[name]


def _few(names: list[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _words(order: Order, folder: Path) -> list[str]:
    """The arguments of jaxik; writes the bones, where they are known."""
    words = ["run", CLIP, "--terrain", GROUND, "-o", SOLVED, "--root", order.root]
    words += ["--travel", order.travel, "--floor", repr(order.floor * order.metres)]
    if order.sole:
        words += ["--sole", repr(order.sole * order.metres)]
    if order.system == FILE:
        words += ["--parameters", order.parameters]
    elif order.system != AUTO:
        words += ["--preset", order.system]
    if order.bones:
        exchange.write_map(folder / MAP, order.bones)
        words += ["--joints", MAP]
    return words


def _steps(text: str, start: float, end: float, work: Iterator[float]) -> Iterator[Step]:
    """Work as steps between two fractions; returns what it returns."""
    while True:
        try:
            done = next(work)
        except StopIteration as finished:
            return finished.value
        yield Step(text, start + (end - start) * done)


def _sample(
    context: bpy.types.Context, order: Order, path: Path, most: int | None = None
) -> Iterator[Step]:
    """Writes how an armature moves, at most in the first so many frames; returns the sample."""
    scene, armature = context.scene, _object(order.armature)
    source = rig.source_of(armature)
    first, last = map(round, source.frame_range)
    frames = list(range(first, last + 1))[:most]
    current = scene.frame_current
    with rig.playing(armature, source):
        try:
            work = rig.sample(context, armature, frames)
            sampled = yield from _steps("reading the animation", 0.0, 0.4, work)
        finally:
            scene.frame_set(current)
    motion, rest = (exchange.y_up(part, order.metres) for part in (sampled.motion, sampled.rest))
    rate = scene.render.fps / scene.render.fps_base
    exchange.write_clip(path, motion, rest, rate)
    return sampled


def _write_ground(context: bpy.types.Context, order: Order, path: Path) -> None:
    ground = _object(order.ground).evaluated_get(context.evaluated_depsgraph_get())
    try:
        mesh = ground.to_mesh()
    except RuntimeError:  # of a kind that has none
        mesh = None
    if mesh is None or not len(mesh.polygons):
        raise Refusal(f"{order.ground} has no faces; choose a mesh, with instances made real")
    mesh.calc_loop_triangles()
    vertices = np.empty((len(mesh.vertices), 3), np.float32)
    triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.vertices.foreach_get("co", vertices.ravel())
    mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
    ground.to_mesh_clear()
    world = np.array(ground.matrix_world)
    if np.linalg.det(world[:3, :3]) < 0:  # then the other side is the outer one
        triangles = triangles[:, ::-1]
    placed = vertices @ world[:3, :3].T + world[:3, 3]
    exchange.write_ground(path, placed @ exchange.TO_Y_UP.T * order.metres, triangles)


def _difference(
    context: bpy.types.Context, armature: bpy.types.Object, sampled: rig.Sample, heads: np.ndarray
) -> Iterator[Step]:
    """Checks a bake in some frames; returns how far each bone is off at most, in the scene."""
    scene = context.scene
    current = scene.frame_current
    chosen = np.unique(np.linspace(0, len(sampled.frames) - 1, CHECKED).astype(int))
    off = np.zeros(len(sampled.names))
    for number in chosen:
        scene.frame_set(sampled.frames[number])
        seen = rig.heads(context, armature, sampled.names)
        off = np.maximum(off, np.linalg.norm(seen - heads[number], axis=-1))
        yield Step("checking", 0.95, is_last=True)
    scene.frame_set(current)
    return off
