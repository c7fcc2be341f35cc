"""Many systems, clips and fits: time and memory against devices, clips and workers.

Each point is a process of its own, so that its peak of memory is its own, too. Devices are those of
this machine, or simulated ones, which share its cores: they show what sharing costs.
"""

import dataclasses
import functools
import itertools
import math
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import fitting
import jaxik
from fitting.clips import edit
from fitting.clips.clip_frames import frames_from_clip
from fitting.experiment.problems import ClipData
from fitting.experiment.systems import Preset
from fitting.runtime import cache_folder, machine, xla
from fitting.runtime.cluster import Stopwatch
from fitting.runtime.threads import cpu_block, usable_cores
from fitting.studies.animations import Animation
from fitting.viewer import Session, SessionClip, Solver, sliders
from fitting.viewer.session import DEFAULT, cost_of_problem
from jaxik.world import terrain
from jaxik.world.terrain import Terrain, plane

from . import fits, kernels, workloads
from .measurement import (
    Call,
    Measurement,
    Series,
    call_in_process,
    peak_memory_mb,
    time_in_width,
)
from .workloads import Crowd, Member, Sizes

FRAMES = 60
LENGTHS = 33, 50  # frames of the shortest and of the longest of many clips
SYSTEMS = 4096  # shared out among devices
FITS = 8  # shared out among workers
LONGEST = 300.0  # s of a point, with compiling, after which larger ones are left out
SIMULATED = "--xla_force_host_platform_device_count={}"
EXPERIMENT = """
preset = "record"
faithful = true
[[clips]]
reference = "reference.npz"
base = "base.npz"
terrain = "ground.ply"
[free]
pelvis.on_gain = {}
foot.max_pitch = { low = 0.1 }
[fit]
starts = 1
"""

BLOCK = 3  # frames at once, whose arrays fit the cache nearest to a core

REPEATS = 3  # of each point
RAYS = 100_000  # against terrains of any size
TAIL = 3  # points, over which the slope at the largest sizes is taken
Point: TypeAlias = Mapping[str, float]  # seconds by name of the curve

RATE = 30.0  # Hz, of the clip
TARGET = 100.0  # ms, from which a drag feels slow
DRAGS = 50  # different ones, of any number


def many(measurement: Measurement, sizes: Sizes) -> None:
    """Time and peak of memory against devices, clips and workers."""
    sharing = 2 * usable_cores()
    _vary(measurement, "devices", sizes.devices, f"{SYSTEMS} systems", sharing)
    _vary(measurement, "clips", sizes.clips, "a system")
    _vary(measurement, "workers", sizes.workers, f"{FITS} fits", sharing)
    measurement.notes.append(
        "devices are simulated where there is one: they share its cores, so that time should stay; "
        "seconds are those after compiling, of workers those of all, starting them included; the "
        "peak of workers is the largest of one process, and every peak includes compiling"
    )


def _vary(
    measurement: Measurement, what: str, counts: Sequence[int], curve: str, most: float = math.inf
) -> None:
    """Adds a series with the memory peak of each point.

    What is left out, and why, is a note: more than `most`, which would share the same cores, and
    whatever is larger than a point that took long or failed.
    """
    measurement.series.append(series := Series(what))
    result = ""
    for index, count in enumerate(counts):
        if count > most:
            _leave_out(measurement, what, counts[index:], "two share each core already")
            return
        measurement.progress(f"many: {count} {what}, {index + 1} of {len(counts)}{result}")
        began = time.monotonic()
        try:
            point = _measured(what, count)
        except subprocess.CalledProcessError as error:
            last = (error.stderr or "").strip().rpartition("\n")[2]
            measurement.failures.append(f"{count} {what}: {last or error}")
            _leave_out(measurement, what, counts[index + 1 :], f"{count} failed")
            return
        seconds = {"": point["seconds"], ": CPU time": point["cpu_seconds"]}
        series.add(count, {f"{curve}{name}": value for name, value in seconds.items()})
        label = f"{curve}, {count} {what}"
        for name, value in seconds.items():
            measurement.add(f"{label}{name}", value, "s")
        measurement.add(f"{label}: peak of memory", point["peak_mb"], "MB")
        result = f"; {count}: {point['seconds']:.2g} s"
        if (took := time.monotonic() - began) > LONGEST:
            _leave_out(measurement, what, counts[index + 1 :], f"{count} took {took:.0f} s")
            return


def _leave_out(measurement: Measurement, what: str, counts: Sequence[int], why: str) -> None:
    if counts:
        measurement.notes.append(f"left out: {', '.join(map(str, counts))} {what}, as {why}")


def _measured(what: str, count: int) -> Mapping[str, float]:
    """The numbers of a point, of a process of its own.

    Raises:
        subprocess.CalledProcessError: it has failed.
    """
    variables = {"JAX_ENABLE_X64": "1"}
    if what == "devices":
        flags = f"{os.environ.get('XLA_FLAGS', '')} {SIMULATED.format(count)}"
        variables["XLA_FLAGS"] = flags.strip()
    return call_in_process(measure_point, what, count, environment=os.environ | variables)


def of_devices(count: int) -> dict[str, float]:
    """Many systems on a clip, on so many devices."""
    problem = workloads.problem(FRAMES)
    ik = problem.space.unpack(problem.space.start)
    batch = fitting.vary(ik, {"pelvis.on_gain": np.linspace(0.05, 0.9, SYSTEMS)})
    devices = jax.local_devices()[:count]
    return _second_time(lambda: fitting.evaluate_many(batch, problem.data, devices=devices))


def of_clips(count: int) -> dict[str, float]:
    """A system on so many clips of different length on one ground."""
    problem = workloads.problem(max(LENGTHS))
    ik = problem.space.unpack(problem.space.start)
    lengths = np.linspace(*LENGTHS, count).astype(int)
    clips = [workloads.first_frames(problem.data[0], length) for length in lengths]
    single = fitting.vary(ik, {"pelvis.on_gain": [0.2]})
    return _second_time(lambda: fitting.evaluate_many(single, clips))


def of_workers(count: int) -> dict[str, float]:
    """Fits of a clip with several seeds, on so many workers of this machine."""
    cache_folder.use_default()
    with tempfile.TemporaryDirectory() as folder:
        workloads.save_recording(folder, FRAMES)
        path = Path(folder, "walk.toml")
        path.write_text(EXPERIMENT, encoding="utf-8")
        fitting.fit_many(path, Path(folder, "first"), workers=1, report=False)  # compiles
        began = time.monotonic()
        many_fits = fitting.fit_many(
            path, Path(folder, "fits"), seeds=FITS, workers=count, report=False
        )
        efforts = many_fits.efforts
        return {
            "seconds": time.monotonic() - began,
            "cpu_seconds": sum(effort["cpu_seconds"] for effort in efforts),
            "peak_mb": max(effort["peak_mb"] or float("nan") for effort in efforts),
        }


def _second_time(call: Callable[[], object]) -> dict[str, float]:
    """What a call takes after one that compiles; the peak is that of both."""
    call()
    watch = Stopwatch()
    call()
    effort = watch.read()
    peak = effort["peak_mb"] or float("nan")
    return {**{key: effort[key] for key in ("seconds", "cpu_seconds")}, "peak_mb": peak}


POINTS = {"devices": of_devices, "clips": of_clips, "workers": of_workers}


def measure_point(what: str, count: int) -> dict[str, float]:
    """The numbers of a point, in its process."""
    xla.configure_xla()
    return POINTS[what](count)


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
    measurement: Measurement,
    name: str,
    function: Callable,
    crowd: Crowd,
    ground: Terrain,
    chunk: int,
) -> Callable[[], list[PyTree]]:
    """A call that computes a crowd on its ground in chunks, as many at a time as there are cores.

    All chunks use one program, of a crowd, a ground and one member: its workspace, times the cores,
    is what a crowd of any size needs.
    """

    def of_chunk(shared: tuple[Crowd, Terrain], members: Member) -> PyTree:
        return jaxik.lanes(lambda member: function(*shared, member), out_axes=-1)(members)

    members = crowd.members
    shared = dataclasses.replace(crowd, members=jax.tree.map(lambda leaf: leaf[:0], members))
    size = min(chunk, crowd.members.first.size)
    return measurement.compile_parts(name, of_chunk, (shared, ground), members, size, sparse=ground)


def crowd(measurement: Measurement, sizes: Sizes) -> None:
    """The whole pipeline for a crowd, on a plane and on a mesh."""
    people = workloads.crowd(sizes.characters, sizes.frames)
    count = sizes.characters * sizes.frames * people.rig.side.size
    mesh = workloads.ground(workloads.mesh_field(sizes.cells))
    grounds = {"plane": (workloads.single(plane()), 9.0), "mesh": (mesh, 5.0)}
    calls = {
        name: in_chunks(measurement, name, forward, people, ground, sizes.chunk)
        for name, (ground, _) in grounds.items()
    }
    machine.reset_peak()
    measurement.time_in_turns(calls, sizes.crowd_repeats)
    peak = peak_memory_mb()
    for name, (_, target) in grounds.items():
        what, at_least = f"{name}, leg-frames a second", target / time_in_width()
        _add_leg_frames(measurement, name, what, count, at_least=at_least)
    note = "all results of the crowd are kept"
    measurement.add("peak of memory", peak, "MB", note=note)


def gradient(measurement: Measurement, sizes: Sizes) -> None:
    """The gradient for each member's parameters, against the forward run."""
    people = workloads.crowd(sizes.derived, sizes.frames)
    count = sizes.derived * sizes.frames * people.rig.side.size
    flat = workloads.single(plane())
    calls = {
        name: in_chunks(measurement, name, function, people, flat, sizes.chunk)
        for name, function in (("forward", forward), ("reverse", reverse))
    }
    machine.reset_peak()
    measurement.time_in_turns(calls, sizes.crowd_repeats)
    peak, work = peak_memory_mb(), measurement.work
    operations = work["reverse"].operations / work["forward"].operations
    note = f"{sizes.derived} characters; by operations {operations:.1f} times"
    measurement.add_ratio("reverse", "forward", "reverse in forward runs", at_most=4.0, note=note)
    _add_leg_frames(measurement, "reverse", "leg-frames a second", count)
    measurement.add("peak of memory", peak, "MB")


def _add_leg_frames(
    measurement: Measurement, name: str, what: str, count: int, at_least: float | None = None
) -> None:
    """Adds the figure of leg-frames per second, where a call computes `count` of them."""
    work = measurement.work[name]
    measurement.add_timing(
        name, what, "M", items=count, threads=usable_cores(), at_least=at_least,
        note=f"{work.operations / count:.0f} operations and {work.moved / count:.0f} bytes a "
        f"leg-frame; workspace of a chunk {work.workspace / 1e6:.0f} MB",
    )  # fmt: skip


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
                name, fits.residuals_and_jacobian, problem, problem.space.start
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
    _varied_by_core(measurement, "legs in a batch", sizes.batches, legs)
    _varied_by_core(measurement, "frames", sizes.lengths, frames)
    _varied_by_core(measurement, "legs of a character", sizes.legs_each, legs_each)
    _varied_by_core(measurement, "free parameters", sizes.parameters, parameters)
    _varied_by_core(measurement, "triangles", triangle_counts, triangles)


def _varied_by_core(
    measurement: Measurement, size: str, values: Iterable[int], measure: Callable[[int], Point]
) -> None:
    """Adds a series, point by point, so that measured points survive an interrupt."""
    measurement.series.append(series := Series(size))
    for value in values:
        series.add(value, measure(value))
    for name, seconds in series.seconds.items():
        if len(seconds) > 1:
            tail = min(TAIL, len(seconds))
            note = f"{series.slope(name, TAIL):.2f} over the {tail} largest"
            what = f"{name} against {size}"
            measurement.add(what, series.slope(name), "slope", note=note)


def _median(measurement: Measurement, name: str, call: Call) -> float:
    return measurement.time_in_turns({name: call}, REPEATS)[name]


def run(ik: jaxik.FootIK, rig: jaxik.Rig, ground: Terrain, motion: jaxik.Frame) -> tuple:
    """What a game takes over of one character."""
    result = jaxik.run(ik, rig, ground, motion)
    return result.corrections, result.body, result.reached


def session(frame_count: int) -> Session:
    """A recording at 30 Hz of so many frames at 60 Hz, with the cost of twenty parameters."""
    reference, base, mesh = workloads.recording(frame_count)
    reference, base = (edit.resample(clip, RATE) for clip in (reference, base))
    data = ClipData(reference, base, terrain.mesh(mesh.vertices, mesh.faces))
    problem = workloads.problem_from_clips([data])
    frames = problem.data[0].frames
    animation = Animation(base, data.terrain, given_frames=frames, captured=reference)
    cost = functools.partial(cost_of_problem, problem)
    starts = {DEFAULT: problem.space.system}
    clips, preset = (SessionClip("walk", animation),), Preset("record", faithful=True)
    return Session("walk", clips, starts, preset, cost=cost)


def drag(measurement: Measurement, sizes: Sizes) -> None:
    """Solves a clip of 10 s again for other values: motion, feet, overlays and cost."""
    walk = session(sizes.frames)
    solver, ik = Solver(walk), walk.starts[DEFAULT]
    measurement.progress("view: compiling solve")
    start = time.perf_counter()
    solver.solve(ik)
    measurement.compile_s["solve"] = time.perf_counter() - start
    random = np.random.default_rng(0)
    numbers = [slider for slider in sliders(ik, walk.rig) if not slider.is_switch]
    chosen = [numbers[i] for i in random.integers(len(numbers), size=DRAGS)]
    values = [float(random.uniform(slider.low, slider.high)) for slider in chosen]
    drags = itertools.cycle(zip(chosen, values, strict=True))

    def solve() -> None:
        slider, value = next(drags)
        solver.solve(slider.write(ik, value))

    measurement.time_in_turns({"drag": solve})
    seconds = solver.animation.clip.seconds
    what = f"a drag, {seconds:.0f} s at {RATE:g} Hz"
    measurement.add_timing("drag", what, "ms", at_most=TARGET)
