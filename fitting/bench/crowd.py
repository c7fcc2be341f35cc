"""Rows of `jaxik bench` of a crowd: the whole pipeline a chunk at a time, and its gradient."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxik
from fitting.runtime.threads import cpu_block, on_all_cores, usable_cores
from jaxik.world.terrain import Terrain, plane

from . import setup
from .measure import Row, peak_mb, reset_peak
from .setup import Sizes

BLOCK = 3  # frames at once, whose arrays a core's nearest cache holds


def outcome(crowd: setup.Crowd, ground: Terrain, given: tuple) -> tuple:
    """What a game takes over of one character: corrections, the body's move, what was reached."""
    ik, frames = crowd.member(given)
    return _taken(ik, crowd, ground, frames)


def _taken(ik: jaxik.FootIK, crowd: setup.Crowd, ground: Terrain, frames: jaxik.Frame) -> tuple:
    result = jaxik.run(ik, crowd.rig, ground, frames, block=cpu_block(BLOCK))
    return result.corrections, result.body, result.reached


def _loss(ik: jaxik.FootIK, crowd: setup.Crowd, ground: Terrain, frames: jaxik.Frame) -> jax.Array:
    """A number that depends on all of a character's outcome."""
    parts = jax.tree.leaves(_taken(ik, crowd, ground, frames))
    return sum(jnp.sum(leaf**2) for leaf in parts)  # type: ignore[return-value]


def slopes(crowd: setup.Crowd, ground: Terrain, given: tuple) -> tuple:
    """One character's number and its slopes for all the parameters of its system."""
    ik, frames = crowd.member(given)
    return eqx.filter_value_and_grad(_loss)(ik, crowd, ground, frames)


def chunked(
    row: Row, name: str, of_one: Callable, crowd: setup.Crowd, ground: Terrain, chunk: int
) -> Callable[[], Any]:
    """A call that takes a crowd a chunk at a time, as many chunks at once as there are cores.

    One program, of one chunk: its workspace, times the cores, is what a crowd of any size takes.
    """
    count = crowd.first.size
    chunk = min(chunk, count)
    # The last chunk reaches back, so that all have one shape.
    starts = [min(first, count - chunk) for first in range(0, count, chunk)]
    parts = [jax.tree.map(lambda leaf: leaf[first : first + chunk], crowd.rows) for first in starts]  # noqa: B023
    shared = dataclasses.replace(
        crowd, drawn={}, place_ws=crowd.place_ws[:0], first=crowd.first[:0]
    )

    def of_chunk(shared: setup.Crowd, ground: Terrain, part: tuple) -> Any:
        return jaxik.lanes(lambda given: of_one(shared, ground, given), out_axes=-1)(part)

    program = row.program(name, of_chunk, shared, ground, parts[0], sparse=ground)
    row.work[name] = row.work[name] * len(parts)
    calls = [functools.partial(program, shared, ground, part) for part in parts]
    return functools.partial(on_all_cores, calls)


def crowd(row: Row, sizes: Sizes) -> None:
    """The whole pipeline for a crowd, on a plane and on a mesh."""
    people = setup.crowd(sizes.characters, sizes.frames)
    count = sizes.characters * sizes.frames * people.rig.side.size
    grounds = {
        "plane": (setup.single(plane()), 12.0),
        "mesh": (setup.ground(setup.field(sizes.cells)), 5.0),
    }
    calls = {
        name: chunked(row, name, outcome, people, ground, sizes.chunk)
        for name, (ground, _) in grounds.items()
    }
    reset_peak()
    row.race(calls, sizes.crowd_repeats)
    peak = peak_mb()
    for name, (_, reach) in grounds.items():
        _leg_frames(row, f"{name}, leg-frames a second", name, count, at_least=reach)
    row.add("peak of memory", peak, "MB", note="all results of the crowd are kept")


def gradient(row: Row, sizes: Sizes) -> None:
    """The slopes of a number for each member's parameters, against the forward run."""
    people = setup.crowd(sizes.derived, sizes.frames)
    count = sizes.derived * sizes.frames * people.rig.side.size
    ground = setup.single(plane())
    calls = {
        name: chunked(row, name, of_one, people, ground, sizes.chunk)
        for name, of_one in (("forward", outcome), ("reverse", slopes))
    }
    reset_peak()
    row.race(calls, sizes.crowd_repeats)
    peak = peak_mb()
    operations = row.work["reverse"].operations / row.work["forward"].operations
    note = f"{sizes.derived} characters; by operations {operations:.1f} times"
    row.ratio("reverse in forward runs", "reverse", "forward", at_most=4.0, note=note)
    _leg_frames(row, "leg-frames a second", "reverse", count)
    row.add("peak of memory", peak, "MB")


def _leg_frames(row: Row, what: str, name: str, count: int, **reach: Any) -> None:
    """How many legs' frames a second a crowd gets."""
    work = row.work[name]
    note = (
        f"{work.operations / count:.0f} operations and {work.moved / count:.0f} bytes a leg-frame; "
        f"workspace of a chunk {work.workspace / 1e6:.0f} MB"
    )
    scale = 1e-6 * count
    row.timed(what, name, "M", scale, rate=True, threads=usable_cores(), note=note, **reach)
