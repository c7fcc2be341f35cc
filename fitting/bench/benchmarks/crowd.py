"""Benchmarks of a crowd: the whole pipeline in chunks of characters, and its gradient."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

import jaxik
from fitting.bench import workloads
from fitting.bench.host import peak_memory_mb, reset_peak_memory, time_in_width
from fitting.bench.measurement import Figure, FigureSpec, Measurement
from fitting.bench.roofline import Work
from fitting.bench.sizes import Sizes
from fitting.bench.workloads import Crowd, Member
from fitting.runtime.threads import cpu_block, on_all_cores, usable_cores
from jaxik.world.terrain import Terrain, plane

BLOCK = 3  # frames at once, whose arrays fit the cache nearest to a core


class CrowdScene(NamedTuple):
    """A crowd on its ground, computed `chunk` characters at a time."""

    crowd: Crowd
    ground: Terrain
    chunk: int


def forward(crowd: Crowd, ground: Terrain, member: Member) -> tuple:
    """What a game takes over of one character: corrections, the body's motion, what was reached."""
    ik, frames = crowd.character(member)
    return _outputs(ik, crowd, ground, frames)


def _outputs(ik: jaxik.FootIK, crowd: Crowd, ground: Terrain, frames: jaxik.Frame) -> tuple:
    result = jaxik.run(ik, crowd.rig, ground, frames, block=cpu_block(BLOCK))
    return result.corrections, result.body, result.reached


def _loss(ik: jaxik.FootIK, crowd: Crowd, ground: Terrain, frames: jaxik.Frame) -> jax.Array:
    """A number that depends on all of a character's outputs."""
    squares = [jnp.sum(leaf**2) for leaf in jax.tree.leaves(_outputs(ik, crowd, ground, frames))]
    return functools.reduce(jnp.add, squares)


def reverse(crowd: Crowd, ground: Terrain, member: Member) -> tuple:
    """One character's loss and its gradient with respect to all parameters of its system."""
    ik, frames = crowd.character(member)
    return eqx.filter_value_and_grad(_loss)(ik, crowd, ground, frames)


def in_chunks(
    measurement: Measurement, name: str, function: Callable, scene: CrowdScene
) -> Callable[[], list[PyTree]]:
    """A call that computes a crowd in chunks, as many at a time as there are cores.

    All chunks use one program: its workspace, times the cores, is what a crowd of any size needs.

    Args:
        measurement: keeps the program's compile time and work.
        name: under which it keeps them.
        function: of a crowd, a ground and one member.
        scene: the crowd and its ground.
    """
    crowd, ground, chunk = scene
    count = crowd.first.size
    chunk = min(chunk, count)
    # The last chunk overlaps the one before, so that all have one shape.
    starts = [min(first, count - chunk) for first in range(0, count, chunk)]
    members = [
        jax.tree.map(lambda leaf: leaf[first : first + chunk], crowd.members)  # noqa: B023
        for first in starts
    ]
    shared = dataclasses.replace(
        crowd, drawn={}, place_ws=crowd.place_ws[:0], first=crowd.first[:0]
    )

    def of_chunk(shared: Crowd, ground: Terrain, members: Member) -> PyTree:
        return jaxik.lanes(lambda member: function(shared, ground, member), out_axes=-1)(members)

    program = measurement.compile(name, of_chunk, shared, ground, members[0], sparse=ground)
    measurement.work[name] = measurement.work[name] * len(members)
    calls = [functools.partial(program, shared, ground, part) for part in members]
    return functools.partial(on_all_cores, calls)


def crowd(measurement: Measurement, sizes: Sizes) -> None:
    """The whole pipeline for a crowd, on a plane and on a mesh."""
    people = workloads.crowd(sizes.characters, sizes.frames)
    count = sizes.characters * sizes.frames * people.rig.side.size
    mesh = workloads.ground(workloads.mesh_field(sizes.cells))
    grounds = {"plane": (workloads.single(plane()), 9.0), "mesh": (mesh, 5.0)}
    calls = {
        name: in_chunks(measurement, name, forward, CrowdScene(people, ground, sizes.chunk))
        for name, (ground, _) in grounds.items()
    }
    reset_peak_memory()
    measurement.time_in_turns(calls, sizes.crowd_repeats)
    peak = peak_memory_mb()
    work = measurement.work
    for name, (_, target) in grounds.items():
        what = f"{name}, leg-frames a second"
        measurement.add_timing(name, _leg_frames(what, count, work[name], target / time_in_width()))
    note = "all results of the crowd are kept"
    measurement.add(Figure("peak of memory", peak, "MB", note=note))


def gradient(measurement: Measurement, sizes: Sizes) -> None:
    """The gradient for each member's parameters, against the forward run."""
    people = workloads.crowd(sizes.derived, sizes.frames)
    count = sizes.derived * sizes.frames * people.rig.side.size
    scene = CrowdScene(people, workloads.single(plane()), sizes.chunk)
    calls = {
        name: in_chunks(measurement, name, function, scene)
        for name, function in (("forward", forward), ("reverse", reverse))
    }
    reset_peak_memory()
    measurement.time_in_turns(calls, sizes.crowd_repeats)
    peak, work = peak_memory_mb(), measurement.work
    operations = work["reverse"].operations / work["forward"].operations
    note = f"{sizes.derived} characters; by operations {operations:.1f} times"
    ratio = FigureSpec(what="reverse in forward runs", at_most=4.0, note=note)
    measurement.add_ratio("reverse", "forward", ratio)
    rate = _leg_frames("leg-frames a second", count, work["reverse"])
    measurement.add_timing("reverse", rate)
    measurement.add(Figure("peak of memory", peak, "MB"))


def _leg_frames(what: str, count: int, work: Work, at_least: float | None = None) -> FigureSpec:
    """The figure of leg-frames per second, where `count` leg-frames are this work."""
    return FigureSpec(
        what=what, unit="M", scale=1e-6 * count, rate=True, threads=usable_cores(),
        at_least=at_least,
        note=f"{work.operations / count:.0f} operations and {work.moved / count:.0f} bytes a "
        f"leg-frame; workspace of a chunk {work.workspace / 1e6:.0f} MB",
    )  # fmt: skip
