"""The row of `jaxik bench` that varies one size at a time."""

import time
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from jaxik.world.terrain import Terrain, plane

from . import fits, rows, setup
from .measure import Row, Series
from .setup import Sizes

REPEATS = 3  # of each point
RAYS = 100_000  # against terrains of any size
TAIL = 3  # points, of the slope among the largest
Measured = Callable[[Row, Any], dict[str, float]]


def scaling(row: Row, sizes: Sizes) -> None:
    """Time against batch, frames, triangles, parameters and legs."""
    clip = setup.walk(sizes.frames)
    rig, motion = setup.single(clip.rig), setup.single(frames_from_clip(clip))
    ik, flat = setup.single(jaxik.presets.record()), setup.single(plane())

    def batch(legs: int) -> dict[str, float]:
        given = setup.batch(legs).in_lanes()
        call = row.compiled(f"{legs} legs", rows.corrections, *given)
        return {"two-bone legs": _median(row, f"{legs} legs", call)}

    def length(frames: int) -> dict[str, float]:
        call = row.compiled(f"{frames} frames", ran, ik, rig, flat, setup.tiled(motion, frames))
        return {"run, a character": _median(row, f"{frames} frames", call)}

    def triangles(count: int) -> dict[str, float]:
        mesh = setup.field(round((count / 2) ** 0.5))
        row.tell(f"scaling: grid of {count} triangles")
        began = time.perf_counter()
        ground = jax.block_until_ready(setup.ground(mesh))
        built = time.perf_counter() - began
        origins = jnp.asarray(setup.ray_origins(min(RAYS, sizes.rays)))
        call = row.compiled(f"{count} triangles", rows.met, ground, origins)
        name = f"{len(origins)} rays"
        return {name: _median(row, f"{count} triangles", call), "build the grid": built}

    def parameters(count: int) -> dict[str, float]:
        names = tuple(setup.TRUTH)[:count] + setup.others()[: max(0, count - len(setup.TRUTH))]
        with jax.enable_x64(True):
            problem = setup.problem(sizes.frames, names)
            call = row.compiled(f"{count} parameters", fits.slopes_of, problem, problem.space.u0)
            return {"rows and slopes, float64": _median(row, f"{count} parameters", call)}

    def legs(count: int) -> dict[str, float]:
        wide, moving = setup.with_legs(rig, motion, count)
        call = row.compiled(f"{count} legs each", ran, ik, wide, flat, moving)
        return {"run, a character": _median(row, f"{count} legs each", call)}

    meshes = [2 * cells**2 for cells in sizes.grids]
    _vary(row, "legs in a batch", sizes.batches, batch)
    _vary(row, "frames", sizes.lengths, length)
    _vary(row, "legs of a character", sizes.legs_each, legs)
    _vary(row, "free parameters", sizes.parameters, parameters)
    _vary(row, "triangles", meshes, triangles)


def _vary(row: Row, size: str, values: Iterable[int], of: Callable[[int], dict]) -> None:
    """One series, kept point for point, so that what was measured outlives an interrupt."""
    one = Series(size, [], {})
    row.series.append(one)
    for value in values:
        took = of(value)
        one.sizes.append(value)
        for name, seconds in took.items():
            one.seconds.setdefault(name, []).append(seconds)
    for name, seconds in one.seconds.items():
        if len(seconds) > 1:
            note = f"{one.slope(name, TAIL):.2f} over the {min(TAIL, len(seconds))} largest"
            row.add(f"{name} against {size}", one.slope(name), "slope", note=note)


def _median(row: Row, name: str, call: Callable[[], Any]) -> float:
    return row.race({name: call}, REPEATS)[name]


def ran(ik: jaxik.FootIK, rig: jaxik.Rig, ground: Terrain, motion: jaxik.Frame) -> Any:
    """What a game takes over of one character."""
    result = jaxik.run(ik, rig, ground, motion)
    return result.corrections, result.body, result.reached
