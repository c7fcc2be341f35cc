"""What an engine needs around a system: the legs of a standing pose, and the speeds of a frame."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

import jaxik
from jaxik.maths import vec

from . import stablehlo
from .graph import Graph, Node
from .program import Place, Program, exported, fields_of, flat, input_nodes, places_of
from .schedule import Target

PLATFORM = "platform"


class Argument(NamedTuple):
    """What a routine reads: a struct by the name of its variable, or the number of a platform."""

    name: str
    struct: str


@dataclasses.dataclass(frozen=True)
class Routine:
    """A function without memory."""

    name: str
    meaning: str
    """A comment, with @ for the prefix of all names."""
    reads: list[Argument]
    writes: Argument
    graph: Graph
    inputs: list[Place]
    """By the number of the input; their structs are the names of arguments."""
    places: dict[str, list[Place]]
    """All numbers of what it writes."""
    targets: list[tuple[Target, Node]]


def routines(program: Program) -> list[Routine]:
    """The routines for a program: `measure_rig` and `measure_speeds`."""
    with jax.enable_x64(False):
        return [_measure_rig(program), _measure_speeds(program)]


def _measure_rig(program: Program) -> Routine:
    frame = program.trees["frame"]
    return _routine(
        "measure_rig",
        "Measures the legs of a body that stands on y = 0 in model space, faces +z and bends its "
        "knees forward: soles flat, feet pointing from ankle to toe. Of the frame, only the pose "
        "counts.",
        lambda frame: jaxik.Rig.from_pose(frame.pose),
        {Argument("standing", "frame"): frame},
        Argument("rig", "rig"),
        program.trees["rig"],
        lambda field: True,
    )


def _measure_speeds(program: Program) -> Routine:
    frame = program.trees["frame"]
    reads = {Argument("before", "frame"): frame, Argument("frame", "frame"): frame}
    carried = ""
    if program.platforms:
        reads[Argument(PLATFORM, PLATFORM)] = jnp.zeros((), jnp.int32)
        carried = (
            " They are over the platform of this number; -1 is ground that does not move. "
            "platforms_before is filled in as well."
        )
    written = {("velocity_ws",), ("foot_speed",), ("toe_speed",)}
    return _routine(
        "measure_speeds",
        "Fills in the velocity and the speeds of a frame from the root and the pose of the frame "
        f"before, or zeros if its dt is 0 or less.{carried} Of the first frame and after a "
        "teleport, hand over the frame itself as the one before.",
        _with_speeds,
        reads,
        Argument("frame", "frame"),
        frame,
        lambda field: field.path in written or field.path[0] == "platforms_before",
    )


def _with_speeds(
    before: jaxik.Frame, frame: jaxik.Frame, platform: Int[Array, ""] | None = None
) -> jaxik.Frame:
    """A frame with the speeds over the ground of `FrameBuilder`."""

    def places(frame: jaxik.Frame) -> Array:
        feet = jnp.concatenate([frame.pose.ankle.pos, frame.pose.toe.pos])
        root = frame.world_from_model
        return jnp.concatenate([root.pos[None], root.apply(feet)])

    start = places(before)
    if platform is not None:
        now, then = (
            jax.tree.map(lambda leaf: leaf.at[platform].get(mode="clip"), each.platforms)
            for each in (frame, before)
        )
        start = jnp.where(platform < 0, start, (now @ then.inverse()).apply(start))
    moves = frame.dt > 0
    velocity = (places(frame) - start) / jnp.where(moves, frame.dt, 1.0)
    velocity = jnp.where(moves, velocity, 0.0)
    speeds, legs = vec.length(velocity), len(frame.weight)
    return dataclasses.replace(
        frame,
        velocity_ws=velocity[0],
        foot_speed=speeds[1 : legs + 1],
        toe_speed=speeds[legs + 1 :],
        platforms_before=before.platforms,
    )


def _routine(
    name: str,
    meaning: str,
    function: Callable,
    reads: dict[Argument, PyTree],
    writes: Argument,
    written: PyTree,
    is_written: Callable,
) -> Routine:
    graph, inputs = Graph(), []
    nodes: list[np.ndarray] = []
    for argument, tree in reads.items():
        nodes += [input_nodes(graph, inputs, argument.name, field) for field in fields_of(tree)]
    outputs = flat(stablehlo.read(exported(function, tuple(reads.values())), graph, nodes))
    places = list(places_of(writes.name, written))
    targets = [
        (Target(writes.name, number), node)
        for number, (place, node) in enumerate(zip(places, outputs, strict=True))
        if is_written(place.field)
    ]
    return Routine(
        name, meaning, list(reads), writes, graph, inputs, {writes.name: places}, targets
    )
