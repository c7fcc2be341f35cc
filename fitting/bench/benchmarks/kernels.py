"""Benchmarks of parts of the pipeline: legs, feet, rays, one step."""

import functools
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

import jaxik
from fitting.bench import workloads
from fitting.bench.host import time_in_width
from fitting.bench.measurement import Call, Figure, FigureSpec, Measurement
from fitting.bench.sizes import Sizes
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.terrain import mesh_files
from fitting.runtime.threads import cpu_block, on_all_cores, usable_cores
from jaxik.stages.effector import Effector
from jaxik.stages.inputs import Inputs
from jaxik.stages.leg import LegGoal, SolvedLeg, TwoBone
from jaxik.world.terrain import Hit, Terrain, cast, plane

from . import baselines

BLOCK = 256  # legs at once on a CPU: they fit a core's cache, and XLA makes their loop one kernel


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


class SplitWork(NamedTuple):
    """Work on many items that the cores of the machine share.

    `sparse` are arrays of which a run reads little.
    """

    function: Callable
    """Of `shared` and of some of the items."""
    shared: PyTree
    items: PyTree
    """Arrays."""
    axis: int = -1
    """Along which the items are counted."""
    sparse: PyTree = ()


def _split_over_cores(measurement: Measurement, split: SplitWork) -> Call:
    """A call, named "ours", in which each core computes its part with the same program."""
    count = jax.tree.leaves(split.items)[0].shape[split.axis]
    size = -(-count // usable_cores())

    def part_from(first: int) -> list[jax.Array]:
        first = min(first, count - size)  # the last part overlaps, to be of the same size
        cut = functools.partial(jax.lax.slice_in_dim, axis=split.axis)
        part = jax.tree.map(lambda leaf: cut(leaf, first, first + size), split.items)
        return jax.tree.leaves((split.shared, part))

    def of_part(leaves: list) -> PyTree:
        structure = jax.tree.structure((split.shared, split.items))
        return split.function(*jax.tree.unflatten(structure, leaves))

    # Flattened beforehand: while Python flattens arguments, no other thread can start.
    parts = [part_from(first) for first in range(0, count, size)]
    program = measurement.compile("ours", of_part, parts[0], sparse=split.sparse)
    measurement.work["ours"] = measurement.work["ours"] * len(parts)
    calls = [functools.partial(program, part) for part in parts]
    return functools.partial(on_all_cores, calls)


def _add_time_per_leg(measurement: Measurement, count: int, at_most: float) -> None:
    """Adds the figure of a kernel; `at_most`, ns, is its target with vectors of 256 bits."""
    work, cores = measurement.work["ours"], usable_cores()
    measurement.add_timing(
        "ours",
        FigureSpec(
            what="a leg and core", unit="ns", scale=1e9 * cores / count, threads=cores,
            at_most=at_most * time_in_width(),
            note=f"{work.moved / count:.0f} bytes and {work.operations / count:.0f} operations a "
            "leg",
        ),
    )  # fmt: skip


def legs(measurement: Measurement, sizes: Sizes) -> None:
    """Two-bone legs against plain NumPy."""
    batch = workloads.leg_batch(sizes.legs)
    ours = _split_over_cores(measurement, SplitWork(leg_corrections, batch.ik, batch.lanes))
    arguments = numpy_arguments(batch)
    measurement.time_in_turns({"ours": ours, "NumPy": lambda: baselines.two_bone(*arguments)})
    _add_time_per_leg(measurement, batch.count, at_most=45.0)
    measurement.add_ratio(
        "NumPy", "ours", FigureSpec(what="NumPy's time in ours", note="NumPy on one core")
    )
    measurement.add_timing(
        "NumPy", FigureSpec(what="NumPy, a leg", unit="ns", scale=1e9 / batch.count)
    )


def numpy_arguments(batch: workloads.LegBatch) -> tuple[baselines.Legs, baselines.KneeLimits]:
    """A batch of legs, and the limits of its knees, as arguments of `baselines.two_bone`."""
    rule = batch.ik.leg
    assert isinstance(rule, TwoBone)
    limits = baselines.KneeLimits(
        float(rule.min_knee_angle), float(rule.max_knee_angle), float(rule.soften)
    )
    pose = batch.frame.pose
    axis = jnp.broadcast_to(batch.rig.knee_axis_ls, pose.hip.pos.shape)
    arrays = (pose.hip.pos, pose.knee.pos, pose.ankle.pos, pose.hip.rot, pose.knee.rot, axis)
    flat = (np.asarray(x).reshape(-1, x.shape[-1]) for x in (*arrays, batch.target_ms))
    return baselines.Legs(*flat), limits


def feet(measurement: Measurement, sizes: Sizes) -> None:
    """Two-bone legs, ankles and all transforms of the solved legs."""
    batch = workloads.leg_batch(sizes.feet)
    split = SplitWork(leg_and_foot, batch.ik, batch.lanes)
    measurement.time_in_turns({"ours": _split_over_cores(measurement, split)})
    _add_time_per_leg(measurement, batch.count, at_most=110.0)


def rays(measurement: Measurement, sizes: Sizes) -> None:
    """Rays against Embree through trimesh."""
    mesh = workloads.mesh_field(sizes.cells)
    start = time.perf_counter()
    ground = jax.block_until_ready(workloads.ground(mesh))
    seconds = time.perf_counter() - start
    note = "with the small programs that its shape needs"
    measurement.add(Figure("build the grid", seconds, "s", note=note))
    origins = workloads.ray_origins(sizes.rays)
    split = SplitWork(cast_down, ground, jnp.asarray(origins), axis=0, sparse=ground)
    calls: dict[str, Call] = {"ours": _split_over_cores(measurement, split)}
    tracer = mesh_files.embree_tracer(mesh.vertices, mesh.faces)
    down = np.tile([0.0, -1.0, 0.0], (len(origins), 1))
    doubles = origins.astype(np.float64)
    if tracer is not None:
        calls["Embree, which triangle"] = lambda: tracer.intersects_first(doubles, down)
        calls["Embree, where"] = lambda: tracer.intersects_location(
            doubles, down, multiple_hits=False
        )
    measurement.time_in_turns(calls, sizes.crowd_repeats)
    measurement.add_timing(
        "ours",
        FigureSpec(
            what="rays a second", unit="M", scale=1e-6 * len(origins), rate=True,
            threads=usable_cores(), note="the limit reads each ray once, and of the ground nothing",
        ),
    )  # fmt: skip
    if tracer is None:
        measurement.notes.append("no ratio to Embree, which is not installed (pip install embreex)")
        return
    for name in ("Embree, which triangle", "Embree, where"):
        what, note = f"{name}: its time in ours", "Embree on one core"
        measurement.add_ratio(name, "ours", FigureSpec(what=what, note=note, at_least=3.0))
        measurement.add_timing(
            name,
            FigureSpec(
                what=f"{name}: rays a second", unit="M", scale=1e-6 * len(origins), rate=True
            ),
        )
    hits = jax.jit(cast_down)(ground, jnp.asarray(origins))
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
        packed = FigureSpec(what=f"Character on a {name}", unit="µs", scale=1e6, at_most=target)
        measurement.add_timing(f"{name}, Character", packed)
        measurement.add_timing(name, FigureSpec(what=f"step on a {name}", unit="µs", scale=1e6))
    for name in grounds:
        what, note = f"the compiled program, {name}", "called with the leaves of its arguments"
        spec = FigureSpec(what=what, unit="µs", scale=1e6, note=note)
        measurement.add_timing(f"{name}, program", spec)
