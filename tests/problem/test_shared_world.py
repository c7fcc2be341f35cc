"""Clips in one world, run in a row: what a system makes of each is what it makes of it alone."""

import dataclasses
from collections import Counter
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import jaxik
from fitting.experiments import experiment_files, problems
from fitting.problem.digest import digest
from fitting.problem.problem import Problem
from fitting.problem.scene import Scene
from fitting.problem.shared_world import MARGIN, run_scenes, share_world
from fitting.runtime.program_cache import committed
from jaxik.maths import parameter_tree
from jaxik.pipeline import Result
from jaxik.world.terrain import plane
from support.experiments import EVERY_KIND, ROOT, write

DATA = ROOT / "data"
CLIPS = "".join(
    f"""
[[clips]]
reference = "{DATA}/clips/{name}.npz"
base = "{DATA}/clips/{base}_base.npz"
terrain = "{DATA}/terrains/uneven_walk.ply"
start = {start}
end = {start + seconds}
"""
    for name, base, start, seconds in (
        ("uneven_walk", "uneven_walk", 1.0, 0.4),
        ("uneven_walk", "uneven_walk", 3.0, 0.4),
        ("stop_and_go_ozz", "stop_and_go", 1.0, 0.2),  # at twice the rate
    )
)
RAISED = 0.05  # m, of the second clip's ground
TRACKED = "leg.soften"


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Three clips of the same length, on two grounds."""
    path = write(tmp_path_factory.mktemp("worlds"), clips=CLIPS, rest=EVERY_KIND)
    problem = problems.make_problem(experiment_files.load_experiment(path))
    first, second, third = problem.data
    (mesh,) = second.terrain.surfaces
    raised = mesh.with_vertices(mesh.vertices_ws + RAISED * second.terrain.up_ws)
    terrain = dataclasses.replace(second.terrain, surfaces=(raised,))
    scenes = placed([first, dataclasses.replace(second, terrain=terrain), third])
    return dataclasses.replace(problem, data=tuple(scenes))


def apart(scenes: Sequence[Scene]) -> tuple[Scene, ...]:
    return tuple(dataclasses.replace(scene, place=None) for scene in scenes)


def placed(scenes: Sequence[Scene]) -> list[Scene]:
    return share_world(apart(scenes), jaxik.presets.record().probe)


@pytest.fixture(scope="module")
def different(problem: Problem) -> Problem:
    """The second clip has a track, sigmas and a body of another size, the third larger strides."""
    first, second, third = problem.data
    stride = second.frames.stride
    bent = dataclasses.replace(stride, aside_ws=stride.aside_ws + jnp.asarray([0.1, 0.0, 0.05]))
    ankle, smooth = (jnp.full_like(second.sigmas.ankle, sigma) for sigma in (0.05, 3.0))
    second = dataclasses.replace(
        second,
        frames=dataclasses.replace(second.frames, stride=bent),
        tracks={TRACKED: 1.0 - jnp.linspace(0.02, 0.3, len(second.frames.dt))},
        size=jnp.asarray(1.3),
        rig=dataclasses.replace(second.rig, foot=1.2 * second.rig.foot, names=("a", "b")),
        sigmas=dataclasses.replace(second.sigmas, ankle=ankle, smooth=smooth),
    )
    scale = jnp.full_like(third.frames.dt, 1.2)
    third = dataclasses.replace(third, frames=dataclasses.replace(third.frames, stride_scale=scale))
    return dataclasses.replace(problem, data=(first, second, third))


def alone(scene: Scene, ik: jaxik.FootIK, names: tuple[str, ...]) -> Scene:
    """The scene by itself, saying also what goes without saying: all have one program."""
    ones = jnp.ones_like(scene.frames.dt)
    scale, size = scene.frames.stride_scale, scene.size
    return dataclasses.replace(
        scene,
        place=None,
        frames=dataclasses.replace(scene.frames, stride_scale=ones if scale is None else scale),
        tracks={TRACKED: scene.tracks.get(TRACKED, ones * parameter_tree.get(ik, TRACKED))},
        size=jnp.asarray(1.0) if size is None else size,
        rig=dataclasses.replace(scene.rig, names=names),
    )


Places = list[jax.Array]


def positions(result: Result) -> Places:
    """Places of a result, in its world and in model space."""
    assert result.trace is not None
    sensed, advanced = result.trace.sensed, result.trace.advanced
    places = [sensed.ankle_ws, sensed.ground.ankle.point, advanced.effector.target_ws]
    poses = [result.pose.ankle.pos, result.pose.knee.rot, result.body.pos, sensed.foothold.height]
    return [*places, *poses, *jax.tree.leaves(advanced.state)]


def places_of(ik: jaxik.FootIK, scenes: tuple[Scene, ...]) -> list[Places]:
    return [positions(result) for result in run_scenes(ik, scenes)]


@jax.jit
def evaluation(problem: Problem):
    """Residuals of the data, and places."""
    of_data = problem.residuals(problem.space.start)[: -problem.space.size]
    return of_data, places_of(problem.space.system, problem.data)


@jax.jit
def slopes(problem: Problem):
    """Derivatives of the residuals of the data, by both parameters at once."""
    u = problem.space.start
    of_all = jax.jvp(problem.residuals, (u,), (jnp.ones_like(u),))[1]
    return of_all[: -problem.space.size]


@pytest.fixture(scope="module")
def each(different: Problem) -> list[Problem]:
    """The clips by themselves."""
    ik, names = different.space.system, different.data[0].rig.names
    scenes = [alone(scene, ik, names) for scene in different.data]
    return [dataclasses.replace(different, data=(scene,)) for scene in scenes]


def test_a_clip_more_needs_no_loop_and_hardly_an_operation_more(different, each):
    """So compiling takes hardly longer."""

    def operations(problem: Problem) -> Counter[str]:
        counts: Counter[str] = Counter()
        pending = [evaluation.trace(problem).jaxpr.jaxpr]
        while pending:
            for equation in pending.pop().eqns:
                counts[equation.primitive.name] += 1
                pending += jaxprs_in_params(equation.params)
        return counts

    one, three = operations(each[0]), operations(different)
    assert one["scan"] == three["scan"] > 0 and one["while"] == three["while"] > 0
    assert three.total() < 1.5 * one.total()


def assert_joined(together: jax.Array, single: Sequence[jax.Array]) -> None:
    expected = np.concatenate(single)
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(together, expected, atol=1e-7 * np.abs(expected).max())


def test_residuals_and_places_of_clips_in_a_row_are_those_of_clips_alone(different, each):
    """Whatever the system remembers, tracks, sizes, sigmas and bodies included."""
    together, places = evaluation(committed(different))
    single, expected_places = zip(*map(evaluation, committed(each)), strict=True)
    assert_joined(together, single)
    assert_alike(places, [of_one for (of_one,) in expected_places])


@pytest.mark.slow
def test_derivatives_of_clips_in_a_row_are_those_of_clips_alone(different, each):
    assert_joined(slopes(committed(different)), [slopes(one) for one in committed(each)])


def assert_alike(joined: Sequence[Places], single: Sequence[Places]) -> None:
    for ours, theirs in zip(joined, single, strict=True):
        for x, y in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-6)  # straight legs


@pytest.mark.slow
@pytest.mark.parametrize("preset", ("ozz", "unreal", "mec", "stride"))
@pytest.mark.usefixtures("optimised")
def test_other_systems_make_the_same_of_a_clip_in_a_row_and_alone(different, preset):
    """Compiled as for users: without optimisations XLA 0.10.2 puts an ankle of `stride` in a row
    9 cm off the plane onto which it is projected, though its height over that plane is right.
    """
    ik = getattr(jaxik.presets, preset)()
    scenes = [
        scene if preset != "unreal" else dataclasses.replace(scene, tracks={})
        for scene in different.data
    ]
    run = jax.jit(places_of)
    assert_alike(run(ik, tuple(scenes)), run(ik, apart(scenes)))


def test_clips_on_the_same_ground_share_it_and_others_are_out_of_reach(problem):
    first, second, third = (scene.place for scene in problem.data)
    assert first.world == second.world == third.world
    assert not first.offset_ws.any() and not third.offset_ws.any()
    moved = second.offset_ws[0]
    edges = [np.asarray(scene.terrain.surfaces[0].vertices_ws)[:, 0] for scene in problem.data]
    assert moved % 16 == 0 and edges[1].min() + moved > edges[0].max() + 2 * MARGIN


def test_grounds_that_are_no_meshes_are_shared_only_by_clips_on_the_same(problem):
    level, raised = plane(), plane((0.0, 0.3, 0.0))
    pairs = zip(problem.data, (level, level, raised), strict=True)
    first, second, third = placed([dataclasses.replace(s, terrain=ground) for s, ground in pairs])
    assert first.place.world == second.place.world and third.place is None
    assert not second.place.offset_ws.any()


def test_a_clip_of_another_number_of_legs_runs_alone(problem):
    first, second, third = problem.data
    more = jax.tree.map(lambda x: jnp.concatenate([x, x[:1]]), second.rig)
    first, second, third = placed([first, dataclasses.replace(second, rig=more), third])
    assert second.place is None and first.place is not None is not third.place


def test_what_shares_a_world_with_what_does_not_change_what_a_fit_is_of(problem):
    assert digest(problem) == digest(dataclasses.replace(problem, data=apart(problem.data)))
