"""All benchmarks of `jaxik bench`: each is a function that fills a `Measurement`."""

import base64
import dataclasses
import functools
import itertools
import math
import os
import statistics
import subprocess
import sys
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
from scipy.optimize import OptimizeResult

import jaxik
from fitting.clips import edit
from fitting.clips.clip_frames import frames_from_clip
from fitting.codegen import toolchain
from fitting.codegen.crowd import NoKernelError
from fitting.codegen.export import export_c
from fitting.codegen.toolchain import Compiled, Playback
from fitting.experiment.problems import ClipData
from fitting.experiment.systems import Preset
from fitting.ground import meshes
from fitting.inference.optimise.search import find_best_fit
from fitting.inference.optimise.solution import Solution
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.sample.posterior import WalkerStart, sample_posterior
from fitting.problem.problem import Problem
from fitting.runtime import machine, xla
from fitting.runtime.program_cache import committed
from fitting.runtime.threads import cpu_block, usable_cores
from fitting.studies import exports
from fitting.studies.animations import Animation
from fitting.viewer import Session, SessionClip, session
from fitting.viewer.server import Viewer
from jaxik.stages.effector import Effector
from jaxik.stages.inputs import Inputs
from jaxik.stages.leg import LegGoal, SolvedLeg
from jaxik.world import terrain
from jaxik.world.terrain import Hit, Terrain, cast, plane

from . import baselines, processes, workloads
from .measurement import (
    Benchmark,
    Call,
    Measurement,
    Series,
    call_in_process,
    peak_memory_mb,
    time_calls,
    time_in_width,
)
from .workloads import Crowd, Member, Sizes

Point: TypeAlias = Mapping[str, float]  # seconds by name of the curve

LEG_BLOCK = 256  # legs at once on a CPU: they fit a core's cache, and their loop is one kernel
FRAME_BLOCK = 3  # frames at once, whose arrays fit the cache nearest to a core

SCIPY = {"SciPy with our slopes": True, "SciPy with differences": False}  # our Jacobian or not
FULL_POSTERIOR = 64 * 1000  # log-probabilities for which there is a target; fewer have none
ENDS = {"empty": 50.0, "full": 15.0}  # s, aims of the whole job by what the cache holds
WAITS = {
    "notebook": "a notebook's first heights of feet",
    "fit": "`jaxik fit`, its first cost",
    "sample": "`jaxik sample`, its first state of the chain",
}

FRAMES = {"record": 4.0, "stride": 12.0}  # µs, aims of a frame in C
LARGEST_CODE = 300.0  # kB, aim

RATE = 30.0  # Hz, of the clip whose parameters are dragged
DRAG, PAGE = 50.0, 8.0  # ms and MB
LONG_PAGE = 6  # times as long as the clip that is dragged
DRAGS = 50  # different ones, of any number

LONGEST = 300.0  # s of a point, with compiling, after which larger ones are left out
SIMULATED = "--xla_force_host_platform_device_count={}"
REPEATS = 3  # of each point
RAYS = 100_000  # against terrains of any size
TAIL = 3  # points, over which the slope at the largest sizes is taken


def ceilings(measurement: Measurement, sizes: Sizes) -> None:
    """The most that memory, arithmetic and dispatch allow: the ceilings of the other benchmarks."""
    cores = usable_cores()
    floats = jnp.ones(sizes.read, jnp.float32)
    calls = {
        # Only reading: a result is new pages of memory, which cost more than filling them.
        "memory": measurement.compile_call("memory", _sum_of_rows, floats),
        "dispatch": measurement.compile_call(
            "dispatch", lambda x: x + 1.0, jnp.ones((), jnp.float32)
        ),
    }
    for dtype in ("float32", "float64"):
        with jax.enable_x64(True):
            square = jnp.ones((sizes.side, sizes.side), dtype)
            calls[dtype] = measurement.compile_call(dtype, _product, square)
    measurement.time_in_turns(calls)
    moved, operations = float(floats.nbytes), 2.0 * sizes.side**3
    measurement.add_timing("memory", "memory, read", "GB/s", items=moved, threads=cores)
    for dtype in ("float32", "float64"):
        measurement.add_timing(
            dtype, f"{dtype}, matrix product", "GFLOP/s",
            items=operations, threads=cores, floats=dtype,
        )  # fmt: skip
    measurement.add_timing("dispatch", "a program that does nothing", "µs")
    # On a CPU by CPU time, so that another process does not lower a ceiling.
    threads = {"memory": cores, "float32": cores, "float64": cores, "dispatch": 1}
    best = {
        name: min(measurement.busy[name]) / count
        if jax.default_backend() == "cpu"
        else min(measurement.samples[name])
        for name, count in threads.items()
    }
    measurement.ceilings.update(
        memory=moved / best["memory"], float32=operations / best["float32"],
        float64=operations / best["float64"], dispatch=best["dispatch"],
    )  # fmt: skip


def _sum_of_rows(floats: jax.Array) -> jax.Array:
    # By a matrix product, whose library reads as fast as memory allows; XLA's own sums do not.
    rows = floats.reshape(-1, math.gcd(floats.size, 4096))
    return jnp.matmul(rows, jnp.ones(rows.shape[1], floats.dtype))


def _product(square: jax.Array) -> jax.Array:
    # In full precision: a GPU would round to fewer bits.
    return jnp.matmul(square, square, precision=jax.lax.Precision.HIGHEST)


def start(measurement: Measurement, sizes: Sizes) -> None:
    """Import times, in processes of their own."""

    def run(code: str) -> Call:
        return lambda: subprocess.run([sys.executable, "-c", code], check=True)

    codes = {
        "jax": "import jax",
        "jaxik": "import jax, jaxik",
        "equinox": "import jax, equinox",
        "used": "import jax, jaxik; jaxik.run",  # its names are imported when first used
    }
    measurement.time_in_turns({name: run(code) for name, code in codes.items()})
    measurement.add_timing("jax", "import jax")
    for what, name, target in (
        ("import jaxik, beyond jax's", "jaxik", 0.3),
        ("and the first use of it", "used", None),
        ("of which equinox", "equinox", None),
    ):
        seconds, cpu_seconds = (
            [total - jax_only for total, jax_only in zip(times[name], times["jax"], strict=True)]
            for times in (measurement.samples, measurement.busy)
        )
        measurement.add(
            what, float(np.median(seconds)), "s", at_most=target,
            spread=(min(seconds), max(seconds)), busy=float(np.median(cpu_seconds)),
        )  # fmt: skip


def _inputs(batch: workloads.LegBatch) -> Inputs:
    """What `pose` reads. It needs no terrain, so that any will do."""
    return Inputs(batch.rig, plane(), batch.frame, jaxik.HARD)


def _solve(batch: workloads.LegBatch) -> SolvedLeg:
    """The solved legs of a batch."""
    goal = LegGoal(batch.frame.pose, batch.target_ms, jnp.ones_like(batch.frame.weight))
    return batch.ik.leg.pose(_inputs(batch), batch.sensed, goal)


def in_lanes(
    kernel: Callable[[workloads.LegBatch], PyTree],
) -> Callable[[jaxik.FootIK, tuple], PyTree]:
    """A kernel of one leg as a function of a batch's `lanes`."""

    def of_lanes(ik: jaxik.FootIK, lanes: tuple) -> PyTree:
        def of_one(lane: tuple) -> PyTree:
            return kernel(workloads.LegBatch(ik, *lane))

        return jaxik.lanes(of_one, in_axes=-1, out_axes=-1, block=cpu_block(LEG_BLOCK))(lanes)

    return of_lanes


@in_lanes
def leg_corrections(batch: workloads.LegBatch) -> tuple[jax.Array, jax.Array]:
    """Local corrections of hips and knees."""
    leg = _solve(batch)
    return leg.hip, leg.knee


@in_lanes
def leg_and_foot(batch: workloads.LegBatch) -> tuple:
    """Legs and feet: the solved pose and all corrections."""
    leg, frame, sensed = _solve(batch), batch.frame, batch.sensed
    target_ws = frame.world_from_model.apply(leg.pose.ankle.pos)
    effector = Effector(target_ws, sensed.rot_ws, jnp.ones_like(frame.weight))
    foot = batch.ik.foot.pose(_inputs(batch), sensed, effector, leg)
    return foot.pose, leg.hip, leg.knee, foot.ankle


def _split_over_cores(
    measurement: Measurement,
    function: Callable,
    shared: PyTree,
    items: PyTree,
    axis: int = -1,
    sparse: PyTree = (),
) -> Call:
    """A call, named "ours", in which each core computes its part of the items."""
    size = -(-jax.tree.leaves(items)[0].shape[axis] // usable_cores())
    return measurement.compile_parts(
        "ours", function, shared, items, size, axis=axis, sparse=sparse
    )


def _add_time_per_leg(measurement: Measurement, count: int, at_most: float) -> None:
    """Adds the figure of a kernel; `at_most`, ns, is its target with vectors of 256 bits."""
    work, cores = measurement.work["ours"], usable_cores()
    note = f"{work.moved / count:.0f} bytes and {work.operations / count:.0f} operations a leg"
    measurement.add_timing(
        "ours", "a leg and core", "ns", items=count / cores, threads=cores,
        at_most=at_most * time_in_width(), note=note,
    )  # fmt: skip


def legs(measurement: Measurement, sizes: Sizes) -> None:
    """Two-bone legs against plain NumPy."""
    batch = workloads.leg_batch(sizes.legs)
    ours = _split_over_cores(measurement, leg_corrections, batch.ik, batch.lanes)
    arguments = baselines.numpy_arguments(batch)
    measurement.time_in_turns({"ours": ours, "NumPy": lambda: baselines.two_bone(*arguments)})
    _add_time_per_leg(measurement, batch.count, at_most=45.0)
    measurement.add_ratio("NumPy", "ours", "NumPy's time in ours", note="NumPy on one core")
    measurement.add_timing("NumPy", "NumPy, a leg", "ns", items=batch.count)


def feet(measurement: Measurement, sizes: Sizes) -> None:
    """Two-bone legs, ankles and all transforms of the solved legs."""
    batch = workloads.leg_batch(sizes.feet)
    ours = _split_over_cores(measurement, leg_and_foot, batch.ik, batch.lanes)
    measurement.time_in_turns({"ours": ours})
    _add_time_per_leg(measurement, batch.count, at_most=110.0)


def step(measurement: Measurement, sizes: Sizes) -> None:
    """One frame of one character, as a game calls it."""
    clip = workloads.walk(60)
    rig, frames = workloads.single((clip.rig, frames_from_clip(clip)))
    frame = jax.tree.map(lambda leaf: leaf[30], frames)
    ik = workloads.single(jaxik.presets.record(faithful=True))
    state, numpy_frame = jaxik.init(ik, rig), jax.tree.map(np.asarray, frame)
    mesh = workloads.ground(workloads.mesh_field(sizes.cells))
    grounds = {"plane": workloads.single(plane()), "mesh": mesh}
    calls = {}
    for name, ground in grounds.items():
        arguments = (ik, rig, ground, state, frame)
        leaves, structure = jax.tree.flatten(arguments)

        def of_leaves(leaves: list, structure: PyTree = structure) -> list[jax.Array]:
            return jax.tree.leaves(jaxik.step(*jax.tree.unflatten(structure, leaves)))

        program = f"{name}, program"
        calls[program] = measurement.compile_call(program, of_leaves, leaves, sparse=ground)
        calls[name] = lambda arguments=arguments: jax.block_until_ready(jaxik.step(*arguments))
        calls[f"{name}, Character"] = functools.partial(
            jaxik.Character(ik, rig, ground).step, numpy_frame
        )
        for call in (name, f"{name}, Character"):
            measurement.work[call] = measurement.work[program]
    measurement.time_in_turns(calls)
    for name, target in (("plane", 150.0), ("mesh", None)):
        what = f"Character on a {name}"
        measurement.add_timing(f"{name}, Character", what, "µs", at_most=target)
        measurement.add_timing(name, f"step on a {name}", "µs")
    for name in grounds:
        what, note = f"the compiled program, {name}", "called with the leaves of its arguments"
        measurement.add_timing(f"{name}, program", what, "µs", note=note)


def export(measurement: Measurement, sizes: Sizes) -> None:
    """Presets as C code: a frame on one core, without its rays, the code's size, and its making."""
    compiler = toolchain.compiler()
    if compiler is None:
        measurement.notes.append("no C compiler: $CC is not set, and there is no cc")
        return
    rig, frames = workloads.exported_walk()
    frame, calls = jax.tree.map(lambda leaf: leaf[0], frames), {}
    with tempfile.TemporaryDirectory() as folder:
        for name in sizes.exported:
            ik, place = workloads.single(getattr(jaxik.presets, name)(rig)), Path(folder, name)
            start = time.perf_counter()
            program = export_c(ik, rig, place, name=name, frame=frame)
            generated = time.perf_counter()
            compiled = Compiled(program, place, name, [compiler, *toolchain.FLAGS])
            seconds = {"generate": generated - start, "compile": time.perf_counter() - generated}
            hits = workloads.hits_at_random(len(frames.dt), program.ray_count)
            calls[name] = Playback(compiled, (ik, rig), frames, hits)
            for word, value in seconds.items():
                measurement.add(f"{name}: {word}", value, "s")
            size = toolchain.code_size(compiler, place, name) / 1e3
            measurement.add(f"{name}: machine code", size, "kB", at_most=LARGEST_CODE)
        measurement.time_in_turns(calls)
    for name, call in calls.items():
        program = call.program
        counts = [len(rays) for rays in program.rounds]
        note = f"{program.legs} legs; rays of each round: {', '.join(map(str, counts))}"
        measurement.add_timing(
            name, f"{name}: a frame", "µs",
            items=len(frames.dt), at_most=FRAMES.get(name), note=note,
        )  # fmt: skip


def rays(measurement: Measurement, sizes: Sizes) -> None:
    """Rays against Embree through trimesh."""
    mesh = workloads.mesh_field(sizes.cells)
    start = time.perf_counter()
    ground = jax.block_until_ready(workloads.ground(mesh))
    seconds = time.perf_counter() - start
    note = "with the small programs that its shape needs"
    measurement.add("build the grid", seconds, "s", note=note)
    origins = workloads.ray_origins(sizes.rays)
    starts = jnp.asarray(origins)
    ours = _split_over_cores(measurement, cast_down, ground, starts, axis=0, sparse=ground)
    calls: dict[str, Call] = {"ours": ours}
    tracer = meshes.embree_tracer(mesh.vertices, mesh.faces)
    down = np.tile([0.0, -1.0, 0.0], (len(origins), 1))
    doubles = origins.astype(np.float64)
    if tracer is not None:
        calls["Embree, which triangle"] = lambda: tracer.intersects_first(doubles, down)
        calls["Embree, where"] = lambda: tracer.intersects_location(
            doubles, down, multiple_hits=False
        )
    measurement.time_in_turns(calls, sizes.crowd_repeats)
    measurement.add_timing(
        "ours", "rays a second", "M", items=len(origins), threads=usable_cores(),
        note="the limit reads each ray once, and of the ground nothing",
    )  # fmt: skip
    if tracer is None:
        measurement.notes.append("no ratio to Embree, which is not installed (pip install embreex)")
        return
    for name in ("Embree, which triangle", "Embree, where"):
        note = "Embree on one core"
        measurement.add_ratio(name, "ours", f"{name}: its time in ours", note=note, at_least=3.0)
        measurement.add_timing(name, f"{name}: rays a second", "M", items=len(origins))
    hits = jax.jit(cast_down)(ground, starts)
    embree_hits = tracer.intersects_location(doubles, down, False)
    measurement.notes.append(_compare_hits(hits, embree_hits[0], embree_hits[1]))


def cast_down(ground: Terrain, origins: jax.Array) -> Hit:
    """What endless rays along -up hit."""
    return cast(ground, origins, jnp.inf)


def _compare_hits(hits: Hit, points: np.ndarray, ray_index: np.ndarray) -> str:
    """How our hits differ from Embree's points, which are those of the rays `ray_index`."""
    ours = np.asarray(hits.found) > 0
    theirs = np.zeros(len(ours), bool)
    theirs[ray_index] = True
    distances = np.abs(np.asarray(hits.point)[ray_index] - points)[ours[ray_index]]
    return (
        f"{100 * np.mean(theirs == ours):.3f} % of the rays hit or miss as Embree's do, the hits "
        f"{1e3 * np.max(distances, initial=0.0):.3f} mm apart at most"
    )


def forward(crowd: Crowd, ground: Terrain, member: Member) -> tuple:
    """What a game takes over of one character: corrections, the body's motion, what was reached."""
    ik, frames = crowd.character(member)
    return _outputs(ik, crowd, ground, frames)


def _outputs(ik: jaxik.FootIK, crowd: Crowd, ground: Terrain, frames: jaxik.Frame) -> tuple:
    result = jaxik.run(ik, crowd.rig, ground, frames, block=cpu_block(FRAME_BLOCK))
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

    A GPU computes all members at once: 64 at a time are 30 times slower there. All chunks use one
    program, of a crowd, a ground and one member: its workspace, times the cores, is what a crowd of
    any size needs.
    """

    def of_chunk(shared: tuple[Crowd, Terrain], members: Member) -> PyTree:
        return jaxik.lanes(lambda member: function(*shared, member), out_axes=-1)(members)

    members = crowd.members
    shared = dataclasses.replace(crowd, members=jax.tree.map(lambda leaf: leaf[:0], members))
    size = min(cpu_block(chunk) or members.first.size, members.first.size)
    return measurement.compile_parts(name, of_chunk, (shared, ground), members, size, sparse=ground)


def crowd(measurement: Measurement, sizes: Sizes) -> None:
    """The whole pipeline for a crowd, on a plane, heights and a mesh: by JAX, and by C lanes."""
    people = workloads.crowd(sizes.characters, sizes.frames)
    count = sizes.characters * sizes.frames * people.rig.side.size
    mesh = workloads.ground(workloads.mesh_field(sizes.cells))
    flat, heights = workloads.single(plane()), workloads.height_field(sizes.cells)
    grounds = {"plane": (flat, 9.0), "heights": (heights, None), "mesh": (mesh, 5.0)}
    calls: dict[str, Call] = {
        name: in_chunks(measurement, name, forward, people, ground, sizes.chunk)
        for name, (ground, _) in grounds.items()
    }
    kernels: dict[str, str] = {}
    for name, (ground, _) in grounds.items():
        start, size = time.perf_counter(), min(usable_cores() * sizes.chunk, sizes.characters)
        measurement.progress(f"crowd: compiling {name} in C")
        try:
            calls[f"{name}, C"], kernels[name] = baselines.by_kernel(people, ground, size)
        except NoKernelError as error:
            measurement.notes.append(f"{name} by JAX only: {error}")
        else:
            measurement.compile_s[f"{name}, C"] = time.perf_counter() - start
    machine.reset_peak()
    measurement.time_in_turns(calls, sizes.crowd_repeats)
    peak = peak_memory_mb()
    for name, (_, target) in grounds.items():
        what, at_least = f"{name}, leg-frames a second", target and target / time_in_width()
        _add_leg_frames(measurement, name, what, count, at_least=at_least)
    for name, kernel in kernels.items():
        what, cores = f"{name} by {kernel}: leg-frames a second", usable_cores()
        measurement.add_timing(f"{name}, C", what, "M", items=count, threads=cores)
        by_jax, by_c = (statistics.median(measurement.busy[key]) for key in (name, f"{name}, C"))
        what = f"{name}: JAX's CPU time in that of C"
        measurement.add(what, by_jax / max(by_c, 1e-9), "times", at_least=3.0)
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


def _residuals(problem: Problem, u: jax.Array) -> jax.Array:
    return problem.residuals(u)


def residuals_and_jacobian(problem: Problem, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The residuals of a problem and their Jacobian."""
    return problem.residuals_and_jacobian(u)


def jacobian(measurement: Measurement, sizes: Sizes) -> None:
    """Residuals and their Jacobian for twenty parameters, against the residuals alone."""
    problem64 = workloads.problem(sizes.frames)
    calls = {}
    for floats in sizes.floats:
        problem = problem64 if floats == "float64" else workloads.single(problem64)
        u = problem.space.start
        rows, slopes = f"rows, {floats}", f"slopes, {floats}"
        calls[rows] = measurement.compile_call(rows, _residuals, problem, u)
        calls[slopes] = measurement.compile_call(slopes, residuals_and_jacobian, problem, u)
    measurement.time_in_turns(calls)
    for floats in sizes.floats:
        rows, slopes = f"rows, {floats}", f"slopes, {floats}"
        measurement.add_timing(rows, rows, "ms", floats=floats)
        what = f"rows and slopes, {floats}"
        measurement.add_timing(slopes, what, "ms", floats=floats, at_most=25.0)
        operations = measurement.work[slopes].operations / measurement.work[rows].operations
        what, note = f"in evaluations, {floats}", f"by operations {operations:.1f} times"
        measurement.add_ratio(slopes, rows, what, at_most=8.0, note=note)


def clips(measurement: Measurement, sizes: Sizes) -> None:
    """Residuals and their Jacobian of several clips, and what they take to compile, in one's."""
    calls = {}
    counts = 1, len(workloads.GROUNDS)
    frames = sizes.frames // len(workloads.GROUNDS)
    for count in counts:
        problem = workloads.problem(frames, clips=count)
        arguments = problem, problem.space.start
        calls[_clips(count)] = measurement.compile_call(
            _clips(count), residuals_and_jacobian, *arguments
        )
        measurement.samples[_compiling(count)] = [measurement.compile_s[_clips(count)]]
    measurement.time_in_turns(calls)
    for count in counts:
        measurement.add_timing(_clips(count), _clips(count), "ms")
        measurement.add_timing(_compiling(count), _compiling(count))
    one, several = map(_compiling, counts)
    measurement.add_ratio(several, one, f"compiling {counts[1]} clips in one's", at_most=1.5)


def _clips(count: int) -> str:
    return f"{count} {'clip' if count == 1 else 'clips'}"


def _compiling(count: int) -> str:
    return f"compiling {_clips(count)}"


def fit(measurement: Measurement, sizes: Sizes) -> None:
    """The whole search for twenty parameters: warm, cold, and SciPy's."""
    problem = workloads.problem(sizes.frames)
    solutions: list[Solution] = []
    descents: dict[str, OptimizeResult] = {}

    def ours() -> None:
        solution = find_best_fit(problem)
        if solution.interrupted:  # the search keeps Ctrl-C to itself; half a run is not a figure
            raise KeyboardInterrupt
        solutions.append(solution)

    def scipy(name: str) -> Call:
        descend = baselines.least_squares_with_scipy(problem, our_jacobian=SCIPY[name])
        return lambda: descents.update({name: descend()})

    start = problem.space.start
    measurement.compile("rows and slopes", residuals_and_jacobian, problem, start)
    calls: dict[str, Call] = {"ours": ours}
    calls |= {name: scipy(name) for name in list(SCIPY)[: 2 if sizes.cold else 1]}
    measurement.time_in_turns(calls, sizes.fits)
    solution = solutions[-1]
    measurement.work["ours"] = measurement.work["rows and slopes"] * solution.steps
    note = f"{solution.steps} steps, of which the limit is; cost reached {solution.cost:.1f}"
    measurement.add_timing("ours", "warm", at_most=2.0, note=note)
    measurement.notes.append(f"seconds by stage: {_stages(solution)}; {solution.message}")
    for name, descent in descents.items():
        measurement.add_ratio(name, "ours", f"{name}: its time in ours")
        counts = f"{descent.nfev} evaluations and {descent.njev} Jacobians"
        measurement.add_timing(name, name, note=f"cost {descent.cost:.1f}; {counts}")
    if not sizes.cold:
        measurement.notes.append("cold fits, and SciPy with differences, are left out")
        return
    _time_cold_fits(measurement, sizes)
    for cache, target in (("empty", 20.0), ("persistent", 5.0)):
        search = statistics.median(measurement.samples[f"its search, {cache} cache"])
        note = f"a process of its own, imports and clip included; the search in it {search:.1f} s"
        name = f"cold, {cache} cache"
        measurement.add_timing(name, name, at_most=target, note=note)


def _stages(solution: Solution) -> str:
    """Seconds that a fit spent in each stage, from its progress reports."""
    seconds: dict[str, float] = {}
    for before, after in itertools.pairwise(solution.history):
        seconds[after.stage] = seconds.get(after.stage, 0.0) + after.seconds - before.seconds
    return ", ".join(f"{stage} {spent:.2f}" for stage, spent in seconds.items())


def _time_cold_fits(measurement: Measurement, sizes: Sizes) -> None:
    """Adds samples of processes that fit, each with an empty cache first and then with a full one.

    The samples are named "cold, empty cache" and "cold, persistent cache"; the time of the search
    within the process "its search, ...".
    """
    searches: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        workloads.save_recording(folder, sizes.frames)
        for number in range(sizes.fits):
            with tempfile.TemporaryDirectory() as cache:
                environment = os.environ | {
                    "JAX_ENABLE_X64": "1",
                    "JAX_ENABLE_COMPILATION_CACHE": "1",
                    "JAX_COMPILATION_CACHE_DIR": cache,
                    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",  # as in the commands
                }
                for state in ("empty", "persistent"):
                    name = f"cold, {state} cache"
                    measurement.progress(f"fit: {name}, run {number + 1} of {sizes.fits}")
                    cold_fit = functools.partial(
                        call_in_process, processes.fit_once, folder, environment=environment
                    )
                    times = time_calls(lambda: searches.append(cold_fit()))  # noqa: B023
                    measurement.add_sample(name, *times)
                    measurement.add_sample(f"its search, {state} cache", searches[-1])


def first(measurement: Measurement, sizes: Sizes) -> None:
    """Processes that begin with an empty cache and with a full one, imports included."""
    of_user = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    variables = of_user | {k: os.environ[k] for k in xla.PLATFORMS if k in os.environ}
    for number in range(sizes.fits):
        with tempfile.TemporaryDirectory() as parent:
            exports.copy(processes.EXAMPLE, folder := Path(parent, processes.EXAMPLE), "{}")
            for state, kind in itertools.product(ENDS, WAITS):
                name = f"{kind}, {state} cache"
                measurement.progress(f"first: {name}, run {number + 1} of {sizes.fits}")
                environment = variables | {"XDG_CACHE_HOME": f"{parent}/{kind}"}
                start = time.time()
                first = call_in_process(processes.wait, kind, str(folder), environment=environment)
                measurement.add_sample(name, first - start)
                if kind == "fit":
                    measurement.add_sample(f"whole {name}", time.time() - start)
    for state, at_most in ENDS.items():
        for kind, what in WAITS.items():
            measurement.add_timing(f"{kind}, {state} cache", f"{what}, {state} cache")
        what = f"… the whole fit, {state} cache"
        measurement.add_timing(f"whole fit, {state} cache", what, at_most=at_most)


def posterior(measurement: Measurement, sizes: Sizes) -> None:
    """The sampler around the best fit, for a fixed number of steps."""
    problem = workloads.problem(sizes.frames)
    centre = np.asarray(problem.space.pack(workloads.TRUTH))
    slopes = np.asarray(jax.jit(residuals_and_jacobian)(problem, jnp.asarray(centre))[1])
    sd = np.clip(np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))), 1e-3, 0.5)

    def sample(steps: int) -> None:
        sampled = sample_posterior(
            problem, WalkerStart(centre, sd),
            SamplerSettings(walkers=sizes.walkers, max_steps=steps, stop_at=1e9),
        )  # fmt: skip
        if sampled.interrupted:
            raise KeyboardInterrupt

    start = time.perf_counter()
    sample(1)
    measurement.compile_s["log-probability, and one step"] = time.perf_counter() - start
    measurement.compile("rows", _residuals, problem, problem.space.start)
    calls = {"chain": lambda: sample(sizes.steps)}
    measurement.time_in_turns(calls, sizes.chains, warm_up=False)
    evaluations = sizes.steps * sizes.walkers
    work = measurement.work["rows"]  # all walkers of a step read the clip once
    measurement.work["chain"] = dataclasses.replace(
        work * evaluations, moved=work.moved * sizes.steps
    )
    milliseconds, cores = 1e3 * measurement.samples["chain"][0] / evaluations, usable_cores()
    measurement.add_timing(
        "chain", f"{sizes.walkers} walkers, {sizes.steps} steps", threads=cores,
        at_most=60.0 if evaluations >= FULL_POSTERIOR else None,
        note=f"{milliseconds:.2f} ms a log-probability; {cores} cores",
    )  # fmt: skip


def viewed_walk(frame_count: int) -> Session:
    """A recording at 30 Hz of so many frames at 60 Hz, with the cost of twenty parameters."""
    reference, base, mesh = workloads.recording(frame_count)
    reference, base = (edit.resample(clip, RATE) for clip in (reference, base))
    data = ClipData(reference, base, terrain.mesh(mesh.vertices, mesh.faces))
    problem = workloads.problem_from_clips([data])
    frames = problem.data[0].frames
    animation = Animation(base, data.terrain, given_frames=frames, captured=reference)
    cost = functools.partial(session.cost_of_problem, committed(problem))
    starts = {session.DEFAULT: problem.space.system}
    clips, preset = (SessionClip("walk", animation),), Preset("record", faithful=True)
    return Session("walk", clips, starts, preset, cost=cost)


def view(measurement: Measurement, sizes: Sizes) -> None:
    """Answers a page that asks for a clip of 10 s with other values, with its cost; sizes of pages.

    What a browser takes to draw the answer is not in it.
    """
    walk = viewed_walk(sizes.frames)
    shown = Viewer(walk, Path())
    measurement.progress("view: compiling solve")
    start = time.perf_counter()
    shown.clip(0)
    measurement.compile_s["solve"] = time.perf_counter() - start
    random, own = np.random.default_rng(0), shown.tuning.numbers(shown.tuning.first)
    numbers = [i for i, slider in enumerate(shown.tuning.sliders) if not slider.is_switch]
    drags = itertools.cycle(random.choice(numbers, DRAGS))

    def solve() -> None:
        moved, number = own.copy(), next(drags)
        slider = shown.tuning.sliders[number]
        moved[number] = random.uniform(slider.low, slider.high)
        values = base64.b64encode(moved.tobytes()).decode()
        shown.solve({"clip": 0, "layers": [], "values": values})

    measurement.time_in_turns({"drag": solve})
    seconds = walk.clips[0].animation.clip.seconds
    what = f"a drag, {seconds:.0f} s at {RATE:g} Hz"
    measurement.add_timing("drag", what, "ms", at_most=DRAG)
    measurement.progress("view: making pages")
    for count in (sizes.frames, LONG_PAGE * sizes.frames):
        page = Viewer(viewed_walk(count), Path()).page(wait=True)
        seconds = count / workloads.FPS
        what = f"page of {seconds:.0f} s, three whole bodies"
        measurement.add(what, 1e-6 * len(page), "MB", at_most=PAGE)


def many(measurement: Measurement, sizes: Sizes) -> None:
    """Time and peak of memory against devices, clips and workers."""
    sharing = 2 * usable_cores()
    _vary(measurement, "devices", sizes.devices, f"{processes.SYSTEMS} systems", sharing)
    _vary(measurement, "clips", sizes.clips, "a system")
    _vary(measurement, "workers", sizes.workers, f"{processes.FITS} fits", sharing)
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
    return call_in_process(processes.measure_point, what, count, environment=os.environ | variables)


def scaling(measurement: Measurement, sizes: Sizes) -> None:
    """Time against legs, frames, legs of a character, parameters and triangles."""
    clip = workloads.walk(sizes.frames)
    rig, motion = workloads.single(clip.rig), workloads.single(frames_from_clip(clip))
    ik, flat = workloads.single(jaxik.presets.record(faithful=True)), workloads.single(plane())

    def batches(count: int) -> Point:
        batch = workloads.leg_batch(count)
        name = f"{count} legs"
        call = measurement.compile_call(name, leg_corrections, batch.ik, batch.lanes)
        return {"two-bone legs": _median(measurement, name, call)}

    def frames(count: int) -> Point:
        name, tiled = f"{count} frames", workloads.tiled(motion, count)
        call = measurement.compile_call(name, run_character, ik, rig, flat, tiled)
        return {"run, a character": _median(measurement, name, call)}

    def legs_each(count: int) -> Point:
        name = f"{count} legs each"
        many_rig, many_motion = workloads.with_legs(rig, motion, count)
        call = measurement.compile_call(name, run_character, ik, many_rig, flat, many_motion)
        return {"run, a character": _median(measurement, name, call)}

    def parameters(count: int) -> Point:
        name, names = f"{count} parameters", workloads.parameter_names(count)
        with jax.enable_x64(True):
            problem = workloads.problem(sizes.frames, names)
            call = measurement.compile_call(
                name, residuals_and_jacobian, problem, problem.space.start
            )
            return {"rows and slopes, float64": _median(measurement, name, call)}

    def triangles(count: int) -> Point:
        mesh, name = workloads.mesh_field(round((count / 2) ** 0.5)), f"{count} triangles"
        measurement.progress(f"scaling: grid of {name}")
        start = time.perf_counter()
        ground = jax.block_until_ready(workloads.ground(mesh))
        seconds = time.perf_counter() - start
        origins = jnp.asarray(workloads.ray_origins(min(RAYS, sizes.rays)))
        call = measurement.compile_call(name, cast_down, ground, origins)
        median = _median(measurement, name, call)
        return {f"{len(origins)} rays": median, "build the grid": seconds}

    triangle_counts = [2 * cells**2 for cells in sizes.grids]
    _varied_by_core(measurement, "legs in a batch", sizes.batches, batches)
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


def run_character(ik: jaxik.FootIK, rig: jaxik.Rig, ground: Terrain, motion: jaxik.Frame) -> tuple:
    """What a game takes over of one character."""
    result = jaxik.run(ik, rig, ground, motion)
    return result.corrections, result.body, result.reached


CEILINGS = "machine"  # the benchmark of the machine's limits, with which the others are compared
BENCHMARKS = {
    CEILINGS: Benchmark("memory, arithmetic and dispatch at their best", "", ceilings),
    "start": Benchmark("import of jaxik", "", start),
    "legs": Benchmark("two-bone legs, corrections out", "float32", legs),
    "feet": Benchmark("feet: two-bone, ankle, updated transforms", "float32", feet),
    "step": Benchmark("one frame of one character, dispatch included", "float32", step),
    "export": Benchmark("systems as C code, one core, rays aside", "float32", export),
    "rays": Benchmark("rays against Embree", "float32", rays),
    "crowd": Benchmark("the record pipeline for a crowd", "float32", crowd),
    "gradient": Benchmark("its gradient, in reverse", "float32", gradient),
    "jacobian": Benchmark(
        "residuals of twenty parameters and their slopes", "", jacobian, x64=True
    ),
    "clips": Benchmark(
        "slopes of one clip and of six", "float64", clips, x64=True, long=True
    ),
    "fit": Benchmark(
        "a fit of twenty parameters to a clip of 10 s", "float64", fit,
        x64=True, long=True,
    ),
    "first": Benchmark(
        "seconds that a newcomer waits", "float64", first, long=True
    ),
    "posterior": Benchmark("the posterior of that fit", "float64", posterior, x64=True),
    "view": Benchmark("a slider of `jaxik view`", "float64", view, x64=True),
    "many": Benchmark(
        "time and memory against devices, clips and workers", "float64", many, long=True
    ),
    "scaling": Benchmark("time against sizes", "float32", scaling, long=True),
}  # fmt: skip


def choose(
    benchmarks: Mapping[str, Benchmark], only: str | None, quick: bool = False
) -> dict[str, Benchmark]:
    """The benchmarks of these names, and always that of the ceilings, in the order of the table.

    Without names (`only`, with commas between them) all; of a quick run without the long ones.

    Raises:
        ValueError: for an unknown name, or no name.
    """
    if only is None:
        return {
            name: benchmarks[name] for name in benchmarks if not (quick and benchmarks[name].long)
        }
    names = [name.strip() for name in only.split(",") if name.strip()]
    if unknown := [name for name in names if name not in benchmarks]:
        raise ValueError(f"--only: no rows named {unknown}; there are {list(benchmarks)}")
    if not names:
        raise ValueError(f"--only: wanted names of rows; there are {list(benchmarks)}")
    return {name: benchmarks[name] for name in benchmarks if name in names or name == CEILINGS}
