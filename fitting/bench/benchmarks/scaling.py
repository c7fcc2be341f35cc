"""The benchmark that varies one size at a time."""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import TypeAlias

import jax
import jax.numpy as jnp

import jaxik
from fitting.bench import workloads
from fitting.bench.measurement import Call, Figure, Measurement, Series
from fitting.bench.sizes import Sizes
from fitting.datasets.clip_frames import frames_from_clip
from jaxik.world.terrain import Terrain, plane

from . import inference, kernels

REPEATS = 3  # of each point
RAYS = 100_000  # against terrains of any size
TAIL = 3  # points, over which the slope at the largest sizes is taken
Point: TypeAlias = Mapping[str, float]  # seconds by name of the curve


def scaling(measurement: Measurement, sizes: Sizes) -> None:
    """Time against legs, frames, legs of a character, parameters and triangles."""
    clip = workloads.walk(sizes.frames)
    rig, motion = workloads.single(clip.rig), workloads.single(frames_from_clip(clip))
    ik, flat = workloads.single(jaxik.presets.record(faithful=True)), workloads.single(plane())

    def legs(count: int) -> Point:
        batch = workloads.leg_batch(count)
        name = f"{count} legs"
        call = measurement.compile_call(name, kernels.leg_corrections, batch.ik, batch.lanes)
        return {"two-bone legs": _median(measurement, name, call)}

    def frames(count: int) -> Point:
        name, tiled = f"{count} frames", workloads.tiled(motion, count)
        call = measurement.compile_call(name, run, ik, rig, flat, tiled)
        return {"run, a character": _median(measurement, name, call)}

    def legs_each(count: int) -> Point:
        name = f"{count} legs each"
        many_rig, many_motion = workloads.with_legs(rig, motion, count)
        call = measurement.compile_call(name, run, ik, many_rig, flat, many_motion)
        return {"run, a character": _median(measurement, name, call)}

    def parameters(count: int) -> Point:
        name, names = f"{count} parameters", workloads.parameter_names(count)
        with jax.enable_x64(True):
            problem = workloads.problem(sizes.frames, names)
            call = measurement.compile_call(
                name, inference.residuals_and_jacobian, problem, problem.space.start
            )
            return {"rows and slopes, float64": _median(measurement, name, call)}

    def triangles(count: int) -> Point:
        mesh, name = workloads.mesh_field(round((count / 2) ** 0.5)), f"{count} triangles"
        measurement.progress(f"scaling: grid of {name}")
        start = time.perf_counter()
        ground = jax.block_until_ready(workloads.ground(mesh))
        seconds = time.perf_counter() - start
        origins = jnp.asarray(workloads.ray_origins(min(RAYS, sizes.rays)))
        call = measurement.compile_call(name, kernels.cast_down, ground, origins)
        median = _median(measurement, name, call)
        return {f"{len(origins)} rays": median, "build the grid": seconds}

    triangle_counts = [2 * cells**2 for cells in sizes.grids]
    _vary(measurement, "legs in a batch", sizes.batches, legs)
    _vary(measurement, "frames", sizes.lengths, frames)
    _vary(measurement, "legs of a character", sizes.legs_each, legs_each)
    _vary(measurement, "free parameters", sizes.parameters, parameters)
    _vary(measurement, "triangles", triangle_counts, triangles)


def _vary(
    measurement: Measurement, size: str, values: Iterable[int], measure: Callable[[int], Point]
) -> None:
    """Adds a series, point by point, so that measured points survive an interrupt."""
    series = Series(size, [], {})
    measurement.series.append(series)
    for value in values:
        point = measure(value)
        series.sizes.append(value)
        for name, seconds in point.items():
            series.seconds.setdefault(name, []).append(seconds)
    for name, seconds in series.seconds.items():
        if len(seconds) > 1:
            tail = min(TAIL, len(seconds))
            note = f"{series.slope(name, TAIL):.2f} over the {tail} largest"
            what = f"{name} against {size}"
            measurement.add(Figure(what, series.slope(name), "slope", note=note))


def _median(measurement: Measurement, name: str, call: Call) -> float:
    return measurement.time_in_turns({name: call}, REPEATS)[name]


def run(ik: jaxik.FootIK, rig: jaxik.Rig, ground: Terrain, motion: jaxik.Frame) -> tuple:
    """What a game takes over of one character."""
    result = jaxik.run(ik, rig, ground, motion)
    return result.corrections, result.body, result.reached
