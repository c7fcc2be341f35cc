"""Clips in one world, stacked, and on several devices or in several processes: as each alone."""

import dataclasses
import os
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import jaxik
from fitting.experiment import experiment_files, problems
from fitting.inference.sharding import over_devices
from fitting.problem import shared_world
from fitting.problem.problem import Problem, digest
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene
from fitting.problem.shared_world import MARGIN, run_row, run_scenes, share_world
from fitting.runtime.program_cache import committed
from jaxik.maths import parameter_tree
from jaxik.pipeline import Result
from jaxik.world.terrain import plane
from support import on_devices
from support.experiments import EVERY_KIND, ROOT, write

CLIPS = "".join(
    f"""
[[clips]]
reference = "{ROOT}/data/clips/{name}.npz"
base = "{ROOT}/data/clips/{base}_base.npz"
terrain = "{ROOT}/data/terrains/uneven_walk.ply"
start = {start}
end = {start + seconds}
"""
    for name, base, start, seconds in (
        ("uneven_walk", "uneven_walk", 1.0, 0.4),
        ("uneven_walk", "uneven_walk", 3.0, 0.4),
        ("stop_and_go_ozz", "stop_and_go", 1.0, 0.4),
    )
)
TRACKED = "leg.soften"


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    """Three clips of the same length, on two grounds."""
    parts = {"top": "faithful = true", "clips": CLIPS, "rest": EVERY_KIND}  # compiles sooner
    path = write(tmp_path_factory.mktemp("worlds"), **parts)
    problem = problems.make_problem(experiment_files.load_experiment(path))
    first, second, third = problem.data
    (mesh,) = second.terrain.surfaces
    raised = mesh.with_vertices(mesh.vertices_ws + 0.05 * second.terrain.up_ws)
    terrain = dataclasses.replace(second.terrain, surfaces=(raised,))
    scenes = placed([first, dataclasses.replace(second, terrain=terrain), third])
    return dataclasses.replace(problem, data=tuple(scenes))


def apart(scenes: Sequence[Scene]) -> tuple[Scene, ...]:
    return tuple(dataclasses.replace(scene, place=None) for scene in scenes)


def placed(scenes: Sequence[Scene]) -> list[Scene]:
    return share_world(apart(scenes))


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


def positions(result: Result) -> list[jax.Array]:
    """Places of a result, in its world and in model space."""
    assert result.trace is not None
    sensed, advanced = result.trace.sensed, result.trace.advanced
    places = [sensed.ankle_ws, sensed.ground.ankle.point, advanced.effector.target_ws]
    poses = [result.pose.ankle.pos, result.pose.knee.rot, result.body.pos]
    return [*places, *poses, *jax.tree.leaves(advanced.state)]


@jax.jit
def evaluation(problem: Problem):
    """Residuals of the data, and places, of one run: it takes long to compile."""
    ik, scenes = problem.space.system, problem.data
    result = run_row(ik, scenes)
    with mock.patch.object(jaxik, "run", return_value=result):
        places = [positions(result) for result in run_scenes(ik, scenes)]
        return residuals_of_scenes(ik, scenes), places


@pytest.fixture(scope="module")
def each(different: Problem) -> list[Problem]:
    """The clips by themselves."""
    ik, names = different.space.system, different.data[0].rig.names
    scenes = [alone(scene, ik, names) for scene in different.data]
    return [dataclasses.replace(different, data=(scene,)) for scene in scenes]


@pytest.mark.slow
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


@pytest.mark.slow
def test_residuals_and_places_of_clips_in_a_row_are_those_of_clips_alone(different, each):
    """Whatever the system remembers, tracks, sizes, sigmas and bodies included."""
    together, places = evaluation(committed(different))
    single, places_alone = zip(*map(evaluation, committed(each)), strict=True)
    expected = np.concatenate(single)
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(together, expected, atol=1e-7 * np.abs(expected).max())
    for ours, (theirs,) in zip(places, places_alone, strict=True):
        for x, y in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-6)  # straight legs


def test_clips_on_the_same_ground_share_it_and_others_are_out_of_reach(problem):
    first, second, third = (scene.place for scene in problem.data)
    assert first.world == second.world == third.world
    assert not first.offset_ws.any() and not third.offset_ws.any()
    moved = second.offset_ws[0]
    edges = [np.asarray(scene.terrain.surfaces[0].vertices_ws)[:, 0] for scene in problem.data]
    assert moved % 16 == 0 and edges[1].min() + moved > edges[0].max() + 2 * MARGIN
    elsewhere = dataclasses.replace(problem, data=apart(problem.data))
    assert digest(problem) == digest(elsewhere), "no part of what a fit is of"


def test_clips_share_grounds_that_are_no_meshes_only_if_equal_and_legs_of_the_same_number(problem):
    level, raised = plane(), plane((0.0, 0.3, 0.0))
    pairs = zip(problem.data, (level, level, raised), strict=True)
    first, second, third = placed([dataclasses.replace(s, terrain=ground) for s, ground in pairs])
    assert first.place.world == second.place.world and third.place is None
    assert not second.place.offset_ws.any()
    first, second, third = problem.data
    more = jax.tree.map(lambda x: jnp.concatenate([x, x[:1]]), second.rig)
    first, second, third = placed([first, dataclasses.replace(second, rig=more), third])
    assert second.place is None and first.place is not None is not third.place


# On several devices


@pytest.fixture(scope="module")
def evaluations() -> dict[str, np.ndarray]:
    """On one device."""
    return on_devices.evaluations()


def start(path: Path, devices: int, *process: str) -> subprocess.Popen:
    """A process with simulated devices that writes its numbers to a file."""
    paths = os.pathsep.join(map(str, [ROOT, ROOT / "tests"]))
    return subprocess.Popen(
        [sys.executable, "-m", "support.on_devices", str(path), str(devices), *process],
        env=os.environ | {"PYTHONPATH": paths}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def assert_alike(path: Path, expected: dict[str, np.ndarray]) -> None:
    with np.load(path) as archive:
        assert set(archive) == set(expected)
        for name, values in expected.items():
            assert np.isfinite(values).all() and np.ptp(values) > 0
            np.testing.assert_allclose(archive[name], values, rtol=1e-12, err_msg=name)


@pytest.mark.slow
def test_eight_devices_find_what_one_finds(evaluations, tmp_path):
    process = start(tmp_path / "eight.npz", 8)
    _, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors[-2000:]
    assert_alike(tmp_path / "eight.npz", evaluations | on_devices.log_probabilities())


@pytest.mark.slow
def test_two_processes_find_what_one_finds(evaluations, tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{listener.getsockname()[1]}"
    paths = [tmp_path / f"{number}.npz" for number in range(2)]
    processes = [start(path, 2, address, "2", str(number)) for number, path in enumerate(paths)]
    errors = [process.communicate(timeout=500)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], errors
    of_systems = {name: values for name, values in evaluations.items() if "systems" in name}
    for path in paths:
        assert_alike(path, of_systems)


def test_clips_on_one_ground_are_one_stack_and_keep_their_order_and_none_is_made_shorter():
    problem = on_devices.make_problem()
    assert over_devices(problem) is problem, "on one device"
    scenes = problem.data
    (stack,) = shared_world.stack(scenes)
    assert stack.members == (0, 1, 2) and stack.shares_terrain
    for number, scene in enumerate(scenes):
        observed = np.asarray(stack.one(number).reference.observed)
        assert observed.sum() == np.asarray(scene.reference.observed).sum()
    frames = shared_world.frame_count(scenes[0])
    with pytest.raises(ValueError, match=f"has {frames} frames; wanted at most 3"):
        shared_world.padded(scenes[0], 3)


def test_lengths_are_rounded_up_to_a_few_by_a_quarter_at_most():
    lengths = np.arange(1, 5000)
    rounded = np.array([shared_world.rounded_up(length) for length in lengths.tolist()])
    assert (lengths <= rounded).all() and (np.diff(rounded) >= 0).all()
    assert (rounded / np.maximum(lengths, 32)).max() <= 1.26
    assert len(set(rounded.tolist())) < 30
