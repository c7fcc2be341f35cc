"""Rows of `jaxik bench` of the machine and of the parts of the pipeline."""

import functools
import math
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.terrain import mesh_files
from fitting.runtime.threads import cpu_block, on_all_cores, usable_cores
from jaxik.stages.effector import Effector
from jaxik.stages.inputs import Inputs
from jaxik.stages.leg import LegGoal, SolvedLeg
from jaxik.world.terrain import Terrain, cast, plane

from . import peers, setup
from .measure import Row
from .setup import Sizes

BLOCK = 256  # legs at once on a CPU: under a core's cache, and a loop that `flags` makes one kernel


def machine(row: Row, sizes: Sizes) -> None:
    """What memory, arithmetic and dispatch allow at most: the ceilings of the other rows."""
    long = jnp.ones(sizes.read, jnp.float32)
    calls = {
        # Read, not written: a result is a new page of memory, which costs more than filling it.
        "memory": row.compiled("memory", _rows_summed, long),
        "dispatch": row.compiled("dispatch", lambda x: x + 1.0, jnp.ones((), jnp.float32)),
    }
    for floats in ("float32", "float64"):
        with jax.enable_x64(True):
            square = jnp.ones((sizes.side, sizes.side), floats)
            calls[floats] = row.compiled(floats, _product, square)
    row.race(calls)
    moved, done = float(long.nbytes), 2.0 * sizes.side**3
    all_cores = {"rate": True, "threads": usable_cores()}
    row.timed("memory, read", "memory", "GB/s", 1e-9 * moved, **all_cores)
    for floats in ("float32", "float64"):
        row.timed(f"{floats}, matrix product", floats, "GFLOP/s", 1e-9 * done, **all_cores)
    row.timed("a program that does nothing", "dispatch", "µs", 1e6)
    # Where the CPU computes, the time that it gave: another process does not lower a ceiling.
    shared = {
        "memory": usable_cores(),
        "float32": usable_cores(),
        "float64": usable_cores(),
        "dispatch": 1,
    }
    best = {
        name: min(row.busy[name]) / threads
        if jax.default_backend() == "cpu"
        else min(row.samples[name])
        for name, threads in shared.items()
    }
    row.ceilings.update(
        memory=moved / best["memory"], float32=done / best["float32"],
        float64=done / best["float64"], dispatch=best["dispatch"],
    )  # fmt: skip


def _rows_summed(long: jax.Array) -> jax.Array:
    # By a product, whose library reads as fast as memory goes; XLA's own sums do not.
    rows = long.reshape(-1, math.gcd(long.size, 4096))
    return jnp.matmul(rows, jnp.ones(rows.shape[1], long.dtype))


def _product(square: jax.Array) -> jax.Array:
    # In full: a GPU would round to fewer bits.
    return jnp.matmul(square, square, precision=jax.lax.Precision.HIGHEST)


def start(row: Row, sizes: Sizes) -> None:
    """What importing costs, in processes of their own."""

    def runs(code: str) -> Callable[[], Any]:
        return lambda: subprocess.run([sys.executable, "-c", code], check=True)

    codes = {
        "jax": "import jax",
        "jaxik": "import jax, jaxik",
        "equinox": "import jax, equinox",
        "used": "import jax, jaxik; jaxik.run",  # what it names is imported when it is asked for
    }
    row.race({name: runs(code) for name, code in codes.items()})
    row.timed("import jax", "jax", "s")
    for what, name, reach in (
        ("import jaxik, beyond jax's", "jaxik", {"at_most": 0.3}),
        ("and the first use of it", "used", {}),
        ("of which equinox", "equinox", {}),
    ):
        beyond, busy = (
            [late - early for late, early in zip(of[name], of["jax"], strict=True)]
            for of in (row.samples, row.busy)
        )
        spread, busy = (min(beyond), max(beyond)), float(np.median(busy))
        row.add(what, np.median(beyond), "s", spread=spread, busy=busy, **reach)


def _inputs(batch: setup.Batch) -> Inputs:
    """What `pose` reads; the terrain counts only before."""
    return Inputs(batch.rig, plane(), batch.frame, jaxik.HARD)


def _bend(batch: setup.Batch) -> SolvedLeg:
    """Solved legs."""
    goal = LegGoal(batch.frame.pose, batch.target_ms, jnp.ones_like(batch.frame.weight))
    return batch.ik.leg.pose(_inputs(batch), batch.sensed, goal)


def side_by_side(of_one: Callable[[setup.Batch], Any]) -> Callable[[jaxik.FootIK, tuple], Any]:
    """What is computed of one leg, for a batch's `in_lanes`."""

    def of_many(ik: jaxik.FootIK, parts: tuple) -> Any:
        one = lambda parts: of_one(setup.Batch(ik, *parts))  # noqa: E731
        return jaxik.lanes(one, in_axes=-1, out_axes=-1, block=cpu_block(BLOCK))(parts)

    return of_many


@side_by_side
def corrections(batch: setup.Batch) -> tuple[jax.Array, jax.Array]:
    """Local rotations of hips and knees."""
    bend = _bend(batch)
    return bend.hip, bend.knee


@side_by_side
def planted(batch: setup.Batch) -> tuple:
    """Legs and feet: the solved pose and all corrections."""
    bend, frame, sensed = _bend(batch), batch.frame, batch.sensed
    target_ws = frame.world_from_model.apply(bend.pose.ankle.pos)
    effector = Effector(target_ws, sensed.rot_ws, jnp.ones_like(frame.weight))
    feet = batch.ik.foot.pose(_inputs(batch), sensed, effector, bend)
    return feet.pose, bend.hip, bend.knee, feet.ankle


def _shared_out(
    row: Row, of_many: Callable, shared: Any, many: Any, axis: int = -1, sparse: Any = ()
) -> Callable[[], Any]:
    """A call in which each core computes its share of the many: one program, of a share."""
    count = jax.tree.leaves(many)[0].shape[axis]
    share = -(-count // usable_cores())

    def from_number(first: int) -> list[jax.Array]:
        first = min(first, count - share)  # the last reaches back, to be as long
        cut = functools.partial(jax.lax.slice_in_dim, axis=axis)
        part = jax.tree.map(lambda leaf: cut(leaf, first, first + share), many)
        return jax.tree.leaves((shared, part))

    def of_share(leaves: list) -> Any:
        return of_many(*jax.tree.unflatten(jax.tree.structure((shared, many)), leaves))

    # Leaves, taken apart beforehand: while Python does that, no other thread can begin.
    shares = [from_number(first) for first in range(0, count, share)]
    program = row.program("ours", of_share, shares[0], sparse=sparse)
    row.work["ours"] = row.work["ours"] * len(shares)
    calls = [functools.partial(program, one) for one in shares]
    return functools.partial(on_all_cores, calls)


def _per_leg(row: Row, count: int, **reach: Any) -> None:
    """The figure of a kernel."""
    work = row.work["ours"]
    note = f"{work.moved / count:.0f} bytes and {work.operations / count:.0f} operations a leg"
    scale = 1e9 * usable_cores() / count
    row.timed("a leg and core", "ours", "ns", scale, threads=usable_cores(), note=note, **reach)


def legs(row: Row, sizes: Sizes) -> None:
    """Two-bone legs against plain NumPy."""
    batch = setup.batch(sizes.legs)
    ours = _shared_out(row, corrections, *batch.in_lanes())
    plain = plain_legs(batch)
    row.race({"ours": ours, "NumPy": lambda: peers.two_bone(*plain)})
    _per_leg(row, batch.legs, at_most=30.0)
    row.ratio("NumPy's time in ours", "NumPy", "ours", note="NumPy on one core")
    row.timed("NumPy, a leg", "NumPy", "ns", 1e9 / batch.legs)


def plain_legs(batch: setup.Batch) -> tuple[peers.Legs, float, float, float]:
    """What the NumPy leg takes: the batch, both limits of the knee, rad, and the softening."""
    leg: Any = batch.ik.leg
    limits = (float(leg.min_knee_angle), float(leg.max_knee_angle), float(leg.soften))
    pose = batch.frame.pose
    axis = jnp.broadcast_to(batch.rig.knee_axis_ls, pose.hip.pos.shape)
    parts = (pose.hip.pos, pose.knee.pos, pose.ankle.pos, pose.hip.rot, pose.knee.rot, axis)
    flat = (np.asarray(x).reshape(-1, x.shape[-1]) for x in (*parts, batch.target_ms))
    return peers.Legs(*flat), *limits


def feet(row: Row, sizes: Sizes) -> None:
    """Two-bone legs, ankles and all transforms of the solved legs."""
    batch = setup.batch(sizes.feet)
    row.race({"ours": _shared_out(row, planted, *batch.in_lanes())})
    _per_leg(row, batch.legs, at_most=80.0)


def rays(row: Row, sizes: Sizes) -> None:
    """Rays against Embree through trimesh."""
    mesh = setup.field(sizes.cells)
    began = time.perf_counter()
    ground = jax.block_until_ready(setup.ground(mesh))
    note = "with the small programs that its shape needs"
    row.add("build the grid", time.perf_counter() - began, "s", note=note)
    origins = setup.ray_origins(sizes.rays)
    given = jnp.asarray(origins)
    calls: dict[str, Callable[[], Any]] = {
        "ours": _shared_out(row, met, ground, given, axis=0, sparse=ground)
    }
    tracer = mesh_files.embree_tracer(mesh.vertices, mesh.faces)
    down = np.tile([0.0, -1.0, 0.0], (len(origins), 1))
    wide = origins.astype(np.float64)
    if tracer is not None:
        calls["Embree, which triangle"] = lambda: tracer.intersects_first(wide, down)
        calls["Embree, where"] = lambda: tracer.intersects_location(wide, down, multiple_hits=False)
    row.race(calls, sizes.crowd_repeats)
    all_cores = {"rate": True, "threads": usable_cores()}
    note = "the limit reads each ray once, and of the ground nothing"
    row.timed("rays a second", "ours", "M", 1e-6 * len(origins), note=note, **all_cores)
    if tracer is None:
        row.notes.append("no ratio to Embree, which is not installed (pip install embreex)")
        return
    for name in ("Embree, which triangle", "Embree, where"):
        row.ratio(
            f"{name}: its time in ours", name, "ours", note="Embree on one core", at_least=3.0
        )
        row.timed(f"{name}: rays a second", name, "M", 1e-6 * len(origins), rate=True)
    hits = jax.jit(met)(ground, given)
    row.notes.append(_agreement(hits, tracer.intersects_location(wide, down, False)))


def met(ground: Terrain, origins: jax.Array) -> Any:
    """What endless rays along -up meet."""
    return cast(ground, origins, jnp.inf)


def _agreement(hit: Any, theirs: tuple) -> str:
    """How our hits differ from Embree's places and numbers of rays."""
    places, index, _ = theirs
    found = np.asarray(hit.found) > 0
    same = np.zeros(len(found), bool)
    same[index] = True
    apart = np.abs(np.asarray(hit.point)[index] - places)[found[index]]
    return (
        f"{100 * np.mean(same == found):.3f} % of the rays hit or miss as Embree's do, the hits "
        f"{1e3 * np.max(apart, initial=0.0):.3f} mm apart at most"
    )


def step(row: Row, sizes: Sizes) -> None:
    """One frame of one character, as a game calls it."""
    clip = setup.walk(60)
    rig, motion = (setup.single(one) for one in (clip.rig, frames_from_clip(clip)))
    frame = jax.tree.map(lambda leaf: leaf[30], motion)
    ik = setup.single(jaxik.presets.record())
    state = jaxik.init(ik, rig)
    grounds = {"plane": setup.single(plane()), "mesh": setup.ground(setup.field(sizes.cells))}
    calls = {}
    for name, ground in grounds.items():
        given = (ik, rig, ground, state, frame)
        leaves, tree = jax.tree.flatten(given)

        def flat(leaves: list, tree: Any = tree) -> Any:
            return jax.tree.leaves(jaxik.step(*jax.tree.unflatten(tree, leaves)))

        alone = f"{name}, program"
        calls[alone] = row.compiled(alone, flat, leaves, sparse=ground)
        calls[name] = lambda given=given: jax.block_until_ready(jaxik.step(*given))
        row.work[name] = row.work[alone]
    row.race(calls)
    row.timed("on a plane", "plane", "µs", 1e6, at_most=150.0)
    row.timed("on a mesh", "mesh", "µs", 1e6)
    for name in grounds:
        note = "called with the leaves of its arguments"
        row.timed(f"the compiled program, {name}", f"{name}, program", "µs", 1e6, note=note)
