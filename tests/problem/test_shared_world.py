"""Clips in one world, run in a row: what a system makes of each is what it makes of it alone."""

import dataclasses
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import jaxik
from fitting.experiments import experiment_files, problems
from fitting.problem import residuals
from fitting.problem.digest import digest
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene
from fitting.problem.shared_world import MARGIN, run_scenes, share_world
from fitting.runtime.precision import in_float64
from jaxik.pipeline import Result
from jaxik.world.terrain import plane
from support.experiments import ROOT, write

DATA = ROOT / "data"
CLIPS = "".join(
    f"""
[[clips]]
reference = "{DATA}/clips/{name}.npz"
base = "{DATA}/clips/{base}_base.npz"
terrain = "{DATA}/terrains/{terrain}.ply"
start = {start}
end = {start + seconds}
"""
    for name, base, terrain, start, seconds in (
        ("uneven_walk", "uneven_walk", "uneven_walk", 1.0, 0.8),
        ("terraces", "terraces", "terraces", 0.5, 0.6),
        ("stop_and_go_ozz", "stop_and_go", "uneven_walk", 1.0, 0.5),
    )
)
EVERY_KIND = (
    "[sigmas]\nankle = 0.02\nknee = 0.03\npelvis = 0.01\nfoot = 0.1\nbody = 0.2\ncontact = 0.5\n"
)
PRESETS = ("record", "ozz", "unreal", "mec", "stride")


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Three clips on two grounds; the second has a track, and a body of another size."""
    path = write(tmp_path_factory.mktemp("worlds"), clips=CLIPS, rest=EVERY_KIND)
    return problems.make_problem(experiment_files.load_experiment(path))


@pytest.fixture(scope="module")
def scenes(problem: Problem) -> tuple[Scene, ...]:
    first, second, third = problem.data
    limits = jnp.linspace(0.02, 0.3, len(second.frames.dt))
    longer = dataclasses.replace(second.rig, foot=1.2 * second.rig.foot, names=("a", "b"))
    stride = second.frames.stride
    bent = dataclasses.replace(stride, aside_ws=stride.aside_ws + jnp.asarray([0.1, 0.0, 0.05]))
    second = dataclasses.replace(
        second,
        frames=dataclasses.replace(second.frames, stride=bent),
        tracks={"leg.soften": 1.0 - limits},
        size=jnp.asarray(1.3),
        rig=longer,
    )
    scale = jnp.full(len(third.frames.dt), 1.2)
    frames = dataclasses.replace(third.frames, stride_scale=scale)
    return first, second, dataclasses.replace(third, frames=frames)


def alone(scenes: tuple[Scene, ...]) -> tuple[Scene, ...]:
    return tuple(dataclasses.replace(scene, place=None) for scene in scenes)


def unoptimised(function, *args):
    level = {"xla_backend_optimization_level": 0}
    return jax.jit(function, compiler_options=level)(*args)


def positions(result: Result) -> list[np.ndarray]:
    """Places of a result, in its world and in model space."""
    trace = result.trace
    assert trace is not None
    sensed, advanced = trace.sensed, trace.advanced
    places = [sensed.ankle_ws, sensed.ground.ankle.point, advanced.effector.target_ws]
    poses = [result.pose.ankle.pos, result.pose.knee.rot, result.body.pos, sensed.foothold.height]
    return [np.asarray(x) for x in (*places, *poses, *jax.tree.leaves(advanced.state))]


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.usefixtures("optimised")
@in_float64
def test_a_clip_in_a_row_is_as_it_is_alone(scenes, preset):
    """Whatever the system remembers, tracks, sizes and bodies included.

    Compiled as for users: without optimisations XLA 0.10.2 puts an ankle of `stride` in a row 9 cm
    off the plane onto which it is projected, though its height over that plane is right.
    """
    ik = getattr(jaxik.presets, preset)()
    apart = tuple(
        scene if preset != "unreal" else dataclasses.replace(scene, tracks={}) for scene in scenes
    )
    run = jax.jit(run_scenes)
    in_a_row, single = run(ik, apart), run(ik, alone(apart))
    for joined, expected in zip(in_a_row, single, strict=True):
        for ours, theirs in zip(positions(joined), positions(expected), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)  # straight legs


@in_float64
def test_residuals_and_jacobians_are_those_of_clips_alone(problem):
    apart = dataclasses.replace(problem, data=alone(problem.data))
    u = problem.space.pack({})
    ours, theirs = (unoptimised(Problem.residuals_and_jacobian, p, u) for p in (problem, apart))
    for x, y in zip(ours, theirs, strict=True):
        assert np.abs(x).max() > 1
        np.testing.assert_allclose(x, y, atol=1e-8)


@in_float64
def test_a_clip_more_needs_no_loop_and_hardly_an_operation_more(problem):
    """So compiling takes hardly longer."""

    def operations(scenes: tuple[Scene, ...]) -> Counter[str]:
        traced = jax.make_jaxpr(residuals.residuals_of_scenes)(jaxik.presets.record(), scenes)
        counts: Counter[str] = Counter()
        pending = [traced.jaxpr]
        while pending:
            for equation in pending.pop().eqns:
                counts[equation.primitive.name] += 1
                pending += jaxprs_in_params(equation.params)
        return counts

    one, three = operations(problem.data[:1]), operations(problem.data)
    assert one["scan"] == three["scan"] > 0 and one["while"] == three["while"] > 0
    assert three.total() < 1.5 * one.total() < operations(alone(problem.data)).total()


def test_clips_on_the_same_ground_share_it_and_others_are_out_of_reach(problem):
    first, second, third = (scene.place for scene in problem.data)
    assert first.world == second.world == third.world
    assert not first.offset_ws.any() and not third.offset_ws.any()
    moved = second.offset_ws[0]
    edges = [np.asarray(scene.terrain.surfaces[0].vertices_ws)[:, 0] for scene in problem.data]
    assert moved % 16 == 0 and edges[1].min() + moved > edges[0].max() + 2 * MARGIN


def test_grounds_that_are_no_meshes_are_shared_only_by_clips_on_the_same(problem):
    level, raised = plane(), plane((0.0, 0.3, 0.0))
    grounds = (level, level, raised)
    scenes = [
        dataclasses.replace(scene, terrain=ground, place=None)
        for scene, ground in zip(problem.data, grounds, strict=True)
    ]
    first, second, third = share_world(scenes, jaxik.presets.record().probe)
    assert first.place.world == second.place.world and third.place is None
    assert not second.place.offset_ws.any()


def test_a_clip_of_another_number_of_legs_runs_alone(problem):
    first, second, third = alone(problem.data)
    more = jax.tree.map(lambda x: jnp.concatenate([x, x[:1]]), second.rig)
    placed = share_world(
        [first, dataclasses.replace(second, rig=more), third], problem.space.system.probe
    )
    assert placed[1].place is None and placed[0].place is not None is not placed[2].place


def test_what_shares_a_world_with_what_does_not_change_what_a_fit_is_of(problem):
    assert digest(problem) == digest(dataclasses.replace(problem, data=alone(problem.data)))
