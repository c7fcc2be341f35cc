"""Benchmarks of parts of the pipeline: legs, feet, rays, one step."""

import functools
import math
import subprocess
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

import jaxik
from fitting.clips.clip_frames import frames_from_clip
from fitting.ground import meshes
from fitting.runtime.threads import cpu_block, usable_cores
from jaxik.stages.effector import Effector
from jaxik.stages.inputs import Inputs
from jaxik.stages.leg import LegGoal, SolvedLeg, TwoBone
from jaxik.world.terrain import Hit, Terrain, cast, plane

from . import workloads
from .measurement import Call, Measurement, time_in_width
from .workloads import Sizes

Vectors = Float[np.ndarray, "legs 3"]
Rotations = Float[np.ndarray, "legs 4"]

BLOCK = 256  # legs at once on a CPU: they fit a core's cache, and XLA makes their loop one kernel


class Legs(NamedTuple):
    """Animated legs and the targets of their ankles; model space, m."""

    hip: Vectors
    knee: Vectors
    ankle: Vectors
    hip_rot: Rotations
    knee_rot: Rotations
    knee_axis_ls: Vectors
    target: Vectors


def two_bone(
    legs: Legs, min_angle: float, max_angle: float, soften: float
) -> tuple[Rotations, Rotations]:
    """Corrections of hips and knees, as `jaxik.stages.leg.TwoBone` makes them, by the cosine law.

    Legs that are straight or folded, or that lie along their hinge, are not handled. The other
    arguments are those of `TwoBone`: the angles of its knee, rad, and its softening.
    """
    hinge = _rotate(legs.knee_rot, legs.knee_axis_ls)
    to_hip, to_ankle = legs.hip - legs.knee, legs.ankle - legs.knee
    to_target = legs.target - legs.hip
    thigh, shin, distance = (np.linalg.norm(v, axis=-1) for v in (to_hip, to_ankle, to_target))
    shortest, longest = (
        np.sqrt(thigh**2 + shin**2 - 2.0 * thigh * shin * np.cos(angle))
        for angle in (min_angle, max_angle)
    )
    start = soften * longest
    room = longest - start
    beyond = np.maximum(distance - start, 0.0)
    soft = np.minimum(distance, start)
    if soften < 1:
        soft += room * (1.0 - np.exp(-beyond / room))
    reach = np.clip(soft, shortest, longest)

    along_hip, along_ankle = np.sum(to_hip * hinge, -1), np.sum(to_ankle * hinge, -1)
    flat_hip = to_hip - along_hip[:, None] * hinge
    flat_ankle = to_ankle - along_ankle[:, None] * hinge
    a, b = np.linalg.norm(flat_hip, axis=-1), np.linalg.norm(flat_ankle, axis=-1)
    across2 = reach**2 - (along_hip - along_ankle) ** 2
    target_angle = np.arccos(np.clip((a**2 + b**2 - across2) / (2.0 * a * b), -1.0, 1.0))
    angle = _angle(flat_hip, flat_ankle, hinge) % (2.0 * np.pi)
    knee_rot = _about(hinge, target_angle - angle)

    bent = _rotate(knee_rot, to_ankle) - to_hip
    start_ms = bent / np.linalg.norm(bent, axis=-1, keepdims=True)
    aim = to_target / distance[:, None]
    arc = _arc(start_ms, aim)
    swing = _multiply(_about(aim, _angle(_rotate(arc, hinge), hinge, aim)), arc)
    return _local(legs.hip_rot, swing), _local(legs.knee_rot, knee_rot)


def _multiply(p: Rotations, q: Rotations) -> Rotations:
    pw, pv, qw, qv = p[:, :1], p[:, 1:], q[:, :1], q[:, 1:]
    scalar = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([scalar, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def _conjugate(q: Rotations) -> Rotations:
    return q * np.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def _local(joint_rot: Rotations, rot: Rotations) -> Rotations:
    return _multiply(_conjugate(joint_rot), _multiply(rot, joint_rot))


def _rotate(q: Rotations, v: Vectors) -> Vectors:
    twice = 2.0 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * twice + np.cross(q[:, 1:], twice)


def _about(axis: Vectors, angle: np.ndarray) -> Rotations:
    half = 0.5 * angle[:, None]
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def _angle(a: Vectors, b: Vectors, axis: Vectors) -> np.ndarray:
    """Signed angle from `a` to `b`, rad, seen along the axis."""
    a = a - np.sum(a * axis, -1, keepdims=True) * axis
    b = b - np.sum(b * axis, -1, keepdims=True) * axis
    return np.arctan2(np.sum(axis * np.cross(a, b), -1), np.sum(a * b, -1))


def _arc(a: Vectors, b: Vectors) -> Rotations:
    """Shortest rotation between unit vectors that are not opposite."""
    q = np.concatenate([1.0 + np.sum(a * b, -1, keepdims=True), np.cross(a, b)], axis=-1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


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

        return jaxik.lanes(of_one, in_axes=-1, out_axes=-1, block=cpu_block(BLOCK))(lanes)

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
    arguments = numpy_arguments(batch)
    measurement.time_in_turns({"ours": ours, "NumPy": lambda: two_bone(*arguments)})
    _add_time_per_leg(measurement, batch.count, at_most=45.0)
    measurement.add_ratio("NumPy", "ours", "NumPy's time in ours", note="NumPy on one core")
    measurement.add_timing("NumPy", "NumPy, a leg", "ns", items=batch.count)


def numpy_arguments(batch: workloads.LegBatch) -> tuple[Legs, float, float, float]:
    """A batch of legs, and the limits of its knees, as arguments of `two_bone`."""
    rule = batch.ik.leg
    assert isinstance(rule, TwoBone)
    limits = rule.min_knee_angle, rule.max_knee_angle, rule.soften
    pose = batch.frame.pose
    axis = jnp.broadcast_to(batch.rig.knee_axis_ls, pose.hip.pos.shape)
    arrays = (pose.hip.pos, pose.knee.pos, pose.ankle.pos, pose.hip.rot, pose.knee.rot, axis)
    flat = (np.asarray(x).reshape(-1, x.shape[-1]) for x in (*arrays, batch.target_ms))
    return Legs(*flat), *map(float, limits)


def feet(measurement: Measurement, sizes: Sizes) -> None:
    """Two-bone legs, ankles and all transforms of the solved legs."""
    batch = workloads.leg_batch(sizes.feet)
    ours = _split_over_cores(measurement, leg_and_foot, batch.ik, batch.lanes)
    measurement.time_in_turns({"ours": ours})
    _add_time_per_leg(measurement, batch.count, at_most=110.0)


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


def machine(measurement: Measurement, sizes: Sizes) -> None:
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
