"""Exported systems over thousands of frames of all kinds, by several compilers."""

# pyright: reportArgumentType=false

import dataclasses
import functools
import shutil
import subprocess
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.bench import workloads
from fitting.codegen import crowd, export
from fitting.codegen.toolchain import Compiled, Outputs, Playback
from fitting.runtime.precision import with_floats
from jaxik.maths import parameter_tree
from jaxik.pipeline import step_and_rays
from jaxik.world import terrain
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import Hit
from support import node
from support.clips import make_rig, to_frames, to_rig, wandering
from support.mono import DOUBLES, Mono

CLOSE = 1e-5  # m, and of a quaternion
STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic")
BUILDS = {
    "gcc": ("gcc", "-std=c99", "-O2", *STRICT),
    "gcc, native": ("gcc", "-std=gnu99", "-O3", "-march=native", *STRICT),
    "g++": ("g++", "-x", "c++", "-std=c++11", "-O2", *STRICT),
    "clang": ("clang", "-std=c99", "-O2", *STRICT),
    "clang, native": ("clang", "-std=c99", "-O3", "-march=native", *STRICT),
    "C#": ("mono",),
    "C#, in doubles": ("mono", DOUBLES),
}
NODE = ("node",)
BUGS = (np.nan, np.inf, -np.inf, 3e38)
DENORMAL = 1e-42  # which JAX takes for 0
ROUNDINGS = 8
PARTED = 0.02, 30  # of frames, and frames in all, while a decision of another frame fades
pytestmark = pytest.mark.slow


class Case(NamedTuple):
    """Frames of a system, and what JAX makes of them in 32 bits."""

    ik: jaxik.FootIK
    rig: jaxik.Rig
    ground: terrain.Terrain | terrain.LegTerrains
    frames: jaxik.Frame
    starts: jaxik.State
    states: jaxik.State
    results: jaxik.Result
    hits: Hit


def frames_of(legs: int, count: int, bugs: int, *more: float) -> jaxik.Frame:
    """A wandering with restarts, partial weights, flight, and numbers that are none."""
    rng = np.random.default_rng(legs)
    frames = to_frames(wandering(make_rig(legs=min(legs, 2)), rng, count))
    if legs > 2:
        frames = workloads.with_legs(to_rig(make_rig()), frames, legs)[1]
        away = rng.normal(0.0, 0.05, (legs, 3))
        frames = dataclasses.replace(frames, pose=moved(frames.pose, away))
    frames = jax.tree.map(np.array, frames)
    leaves = [leaf for leaf in jax.tree.leaves(frames) if leaf.dtype.kind == "f" and leaf.size]
    for bug in (*BUGS, *more):
        for _ in range(bugs):
            leaf = leaves[rng.integers(len(leaves))].reshape(count, -1)
            leaf[rng.integers(count), rng.integers(leaf.shape[1])] = bug
    return dataclasses.replace(frames, restart=rng.uniform(size=count) < 0.01)


def moved(pose: jaxik.LegPose, away: np.ndarray) -> jaxik.LegPose:
    """Each leg somewhere else, m, so that no two are alike."""
    joints = (pose.hip, pose.knee, pose.ankle, pose.toe)
    return jaxik.LegPose(*(Transform(joint.pos + away, joint.rot) for joint in joints))


def hills() -> terrain.Terrain:
    mesh = workloads.mesh_field(100)
    return terrain.mesh((mesh.vertices - [32.0, 0.0, 32.0]).astype(np.float32), mesh.faces)


@jax.jit
def recorded(ik: jaxik.FootIK, rig: jaxik.Rig, ground: Any, frames: jaxik.Frame) -> tuple:
    def advance(state: jaxik.State, frame: jaxik.Frame) -> tuple:
        state, result, _, hits = step_and_rays(ik, rig, ground, state, frame)
        return state, (state, result, hits)

    return jax.lax.scan(advance, jaxik.init(ik, rig), frames)[1]


def make_case(
    name: str, legs: int, count: int, bugs: int = 0, ground: Any = None, dtype: Any = jnp.float32
) -> Case:
    """A preset on hills, or on another ground."""
    frames, rig = frames_of(legs, count, bugs), to_rig(make_rig(legs=min(legs, 2)))
    if legs > 2:
        rig = workloads.with_legs(rig, frames, legs)[0]
    with jax.enable_x64(dtype == jnp.float64):
        ground = single(hills() if ground is None else ground)
        frames, rig = single(frames), single(rig)
        ik = single(getattr(jaxik.presets, name)(rig))
        ik, rig, ground, frames = with_floats((ik, rig, ground, frames), dtype)
        states, results, hits = jax.device_get(recorded(ik, rig, ground, frames))
        fresh = jax.device_get(jaxik.init(ik, rig))
    starts = jax.tree.map(lambda a, b: np.concatenate([a[None], b[:-1]]), fresh, states)
    return Case(ik, rig, ground, frames, starts, states, results, hits)


def single(tree: Any) -> Any:
    return with_floats(jax.tree.map(jnp.asarray, tree), jnp.float32)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, None, 0, 0, 0))
def replayed(ik: Any, rig: Any, ground: Any, state: Any, frame: Any, hits: Hit) -> jaxik.Result:
    ups = [leg.up_ws for leg in getattr(ground, "legs", ())] or None
    replay = terrain.from_hits(hits, ground.up_ws, ups, ground.platform_count)
    return jaxik.step(ik, rig, replay, state, frame)[1]


def doubt(case: Case) -> np.ndarray:
    """By how much JAX itself differs in each frame: in 64 bits, or where inputs are rounded."""
    trees = (case.ik, case.rig, case.ground, case.starts, case.frames, case.hits)
    with jax.enable_x64(True):
        wide = with_floats(jax.tree.map(jnp.asarray, trees), jnp.float64)
        others = [jax.device_get(replayed(*wide))]
    rng = np.random.default_rng(0)
    with jax.enable_x64(False):
        for _ in range(ROUNDINGS):
            ik, rig, ground, *moving = single(trees)
            rounded = jax.tree.map(lambda leaf: last_place(leaf, rng), moving)
            others.append(jax.device_get(replayed(ik, rig, ground, *rounded)))
    return np.max([differences(other, case.results) for other in others], axis=0)


def last_place(leaf: Any, rng: np.random.Generator) -> np.ndarray:
    """Floats with their last place changed, or not."""
    numbers = np.asarray(leaf)
    if numbers.dtype != np.float32:
        return numbers
    return numbers * (1 + np.float32(2.0**-23) * rng.integers(-1, 2, numbers.shape)).astype("f4")


def differences(ours: Any, theirs: Any) -> np.ndarray:
    """The largest of each frame; equal infinities and NaN do not differ."""
    largest = []
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        a, b = (np.asarray(x, np.float64).reshape(len(x), -1) for x in (a, b))
        with np.errstate(invalid="ignore"):
            same = (a == b) | (np.isnan(a) & np.isnan(b))
            gap = np.where(same, 0.0, np.abs(a - b))
        largest.append(np.max(np.nan_to_num(gap, nan=np.inf), axis=1, initial=0.0))
    return np.max(largest, axis=0)


def assert_few(parted: np.ndarray) -> None:
    """Of frames that are other than JAX's."""
    assert np.sum(parted) < max(PARTED[0] * len(parted), PARTED[1])


def first_of(frames: jaxik.Frame) -> jaxik.Frame:
    return jax.tree.map(lambda leaf: leaf[0], frames)


def played(case: Case, folder: Any, command: tuple[str, ...], *, chained: bool) -> Outputs:
    languages = {"mono": "cs", "node": "js"}
    system = export.export_system(
        case.ik, case.rig, folder, language=languages.get(command[0], "c"),
        terrain=case.ground, frame=first_of(case.frames),
    )  # fmt: skip
    setup, starts = (case.ik, case.rig), None if chained else case.starts
    if command == NODE:
        return node.played(system, folder, "footik", setup, case.frames, case.hits, starts)
    if command[0] == "mono":
        compiled = Mono(system, folder, "footik", *command[1:])
    else:
        compiled = Compiled(system, folder, "footik", command)
    play = Playback(compiled, setup, case.frames, case.hits, starts)
    play()
    return play.outputs()


def assert_agreement_in_64_bits(case: Case, folder: Any) -> None:
    """As `assert_agreement`, for JavaScript: its floats have 64 bits, as those of the case."""
    if node.NODE is None:
        pytest.skip("needs node, which is not installed")
    alone, chain = (played(case, folder, NODE, chained=chained) for chained in (False, True))
    np.testing.assert_array_equal(alone.results.faulty, case.results.faulty)
    # A target at the very end of a leg may be reached or not: nothing depends on it.
    turned = np.any(alone.results.reached != case.results.reached, axis=1)
    assert_few(turned)
    same = dataclasses.replace(alone.results, reached=case.results.reached)
    assert differences(same, case.results).max() <= CLOSE
    same = dataclasses.replace(chain.results, reached=case.results.reached)
    assert_few(differences(same, case.results) > CLOSE)


def assert_agreement(case: Case, folder: Any, command: tuple[str, ...]) -> None:
    """Each frame, and all in a row, but where JAX in 32 and in 64 bits differ as well."""
    if shutil.which(command[0]) is None:
        pytest.skip(f"needs {command[0]}, which is not installed")
    alone, chain = (played(case, folder, command, chained=chained) for chained in (False, True))
    np.testing.assert_array_equal(alone.results.faulty, case.results.faulty)
    off = np.flatnonzero(differences(alone.results, case.results) > CLOSE)
    if len(off):
        doubtful = doubt(case) > 0.5 * CLOSE
        assert doubtful[off].all(), off[~doubtful[off]]
        assert len(off) <= 1 + 0.001 * len(case.frames.dt)
    # In a row, a decision may fall a frame earlier or later, and its traces fade.
    parted = differences(chain.results, case.results) > CLOSE
    assert_few(parted)


@pytest.mark.parametrize("name", ["record", "stride", "ozz", "mec", "unreal"])
def test_ten_thousand_frames_of_a_preset_are_those_of_jax(name, tmp_path):
    case = make_case(name, 2, 10_000, bugs=20)
    assert 0.001 < np.mean(case.results.faulty) < 0.1
    for command in BUILDS.values():
        if shutil.which(command[0]):
            assert_agreement(case, tmp_path, command)


@pytest.mark.parametrize("name", ["record", "stride", "ozz", "mec", "unreal"])
def test_frames_of_a_preset_in_javascript_are_those_of_jax(name, tmp_path):
    case = make_case(name, 2, 1_000, 4, dtype=jnp.float64)
    assert_agreement_in_64_bits(case, tmp_path)


@pytest.mark.parametrize("build", ["gcc", "C#"])
@pytest.mark.parametrize("legs", [1, 4, 8])
@pytest.mark.parametrize("name", ["record", "stride", "mec"])
def test_rigs_of_other_legs_are_those_of_jax(name, legs, build, tmp_path):
    assert_agreement(make_case(name, legs, 500, bugs=2), tmp_path, BUILDS[build])


@pytest.mark.parametrize("legs", [1, 4, 8])
def test_rigs_of_other_legs_in_javascript_are_those_of_jax(legs, tmp_path):
    case = make_case("mec", legs, 500, 2, dtype=jnp.float64)
    assert_agreement_in_64_bits(case, tmp_path)


@pytest.mark.parametrize("build", ["gcc", "C#"])
@pytest.mark.parametrize("name", ["record", "mec"])
def test_platforms_and_ups_of_legs_are_those_of_jax(name, build, tmp_path):
    case = make_case_on_platform(name, platforms_and_side())
    assert {-1, 0} <= set(case.hits.platform.ravel().tolist())
    assert_agreement(case, tmp_path, BUILDS[build])


def test_platforms_and_ups_of_legs_in_javascript_are_those_of_jax(tmp_path):
    case = make_case_on_platform("mec", platforms_and_side(), jnp.float64)
    assert_agreement_in_64_bits(case, tmp_path)


def platforms_and_side() -> terrain.LegTerrains:
    still, moving = hills(), terrain.moving(terrain.plane((0.0, 0.05, 0.0), (0.1, 1.0, 0.0)), 0)
    side = terrain.plane((0.6, 0.0, 0.0), up=(0.3, 1.0, -0.1))
    return terrain.LegTerrains(still, (terrain.combine(still, moving), side))


def make_case_on_platform(name: str, ground: Any, dtype: Any = jnp.float32) -> Case:
    """As `make_case`, with a platform that rises and turns."""
    count, time = 500, np.arange(500) / 30.0
    pos = np.stack([0.1 * time, 0.04 * np.sin(3.0 * time), 0.0 * time], -1)
    rot = np.stack([np.cos(0.05 * time), 0.0 * time, np.sin(0.05 * time), 0.0 * time], -1)
    tracks = Transform(jnp.asarray(pos)[:, None], jnp.asarray(rot)[:, None])
    frames = frames_of(2, count, 1).with_platforms(tracks)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{__name__}.frames_of", lambda *_: jax.tree.map(np.asarray, frames))
        return make_case(name, 2, count, 0, ground, dtype)


@pytest.mark.parametrize("name", ["record", "stride", "mec"])
def test_parameters_that_change_along_a_clip_are_those_of_jax(name, tmp_path):
    case, rng = make_case(name, 2, 300), np.random.default_rng(7)
    names = {"record": "limit", "stride": "highest_share", "mec": "max_length"}
    track = f"pelvis.{names[name]}"
    values = jnp.asarray(rng.uniform(0.1, 0.9, 300), jnp.float32)
    tracked = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (300, *leaf.shape)), case.ik)
    tracked = parameter_tree.replace(tracked, {track: values})

    @jax.jit
    def recorded_along(rig: jaxik.Rig, ground: Any) -> tuple:
        def advance(state: jaxik.State, now: tuple) -> tuple:
            state, result, _, hits = step_and_rays(now[0], rig, ground, state, now[1])
            return state, (result, hits)

        return jax.lax.scan(advance, jaxik.init(case.ik, rig), (tracked, case.frames))[1]

    with jax.enable_x64(False):
        results, hits = jax.device_get(recorded_along(case.rig, case.ground))
        run = jaxik.run(case.ik, case.rig, case.ground, case.frames, tracks={track: values})
    assert differences(results, case.results).max() > 0.005
    run = dataclasses.replace(jax.device_get(run), trace=None)
    assert np.median(differences(run, results)) < CLOSE
    program = export.export_c(
        case.ik, case.rig, tmp_path, terrain=case.ground, frame=first_of(case.frames)
    )
    compiled = Compiled(program, tmp_path, "footik", BUILDS["gcc"])
    play = Playback(compiled, (tracked, case.rig), case.frames, hits, tracked=True)
    play()
    parted = differences(play.outputs().results, results) > CLOSE
    assert_few(parted)


@pytest.mark.parametrize("name", ["record", "stride", "mec"])
def test_sanitizers_report_nothing_on_bad_frames(name, tmp_path):
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc, which is not installed")
    frames, rig = single(frames_of(2, 300, 60, DENORMAL)), single(to_rig(make_rig()))
    ik, golden = getattr(jaxik.presets, name)(rig), export.GoldenTrace(hills(), frames)
    export.export_c(ik, rig, tmp_path, golden=golden)
    sanitizers = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    build = ["gcc", "-O1", *sanitizers, "footik.c", "check.c", "-lm", "-o", "check"]
    subprocess.run(build, cwd=tmp_path, check=True)
    done = subprocess.run(["./check"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stdout + done.stderr


@pytest.mark.parametrize("name", ["record", "stride", "ozz", "mec", "unreal"])
@pytest.mark.parametrize("ground", ["plane", "heights"])
def test_a_crowd_in_lanes_is_that_of_jax(name, ground, monkeypatch):
    """Characters of their own paces and places, of which some have faults."""
    count, members, legs = 100, 37, 2
    rig = single(to_rig(make_rig(legs=legs)))
    terrains = {"plane": terrain.plane(normal=(0.1, 1.0, 0.05)), "heights": heights()}
    rng = np.random.default_rng(0)
    clips = [
        moved_clip(frames_of(legs, 10 * members + count, 2), 10 * number, count, rng)
        for number in range(members)
    ]
    frames = jax.tree.map(lambda *leaves: np.stack(leaves), *clips)
    with jax.enable_x64(False):
        frames, ik = single(frames), single(getattr(jaxik.presets, name)(rig))
        arguments = (ik, rig, single(terrains[ground]), frames)
        crowd.kernel_of(*arguments)  # it is there
        ours = crowd.run_crowd(*arguments)
        monkeypatch.setenv(crowd.SWITCH, "0")
        theirs = jax.device_get(crowd.run_crowd(*arguments))
    np.testing.assert_array_equal(ours.faulty, theirs.faulty)
    assert 0 < np.mean(ours.faulty) < 0.1
    flat = (jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree) for tree in (ours, theirs))
    off = differences(*flat) > CLOSE
    # A decision may fall a frame earlier or later, and its traces fade.
    assert_few(off)
    assert np.median(differences(ours, theirs)) < CLOSE


def heights() -> terrain.Terrain:
    x, z = np.meshgrid(np.arange(-40.0, 40.0, 0.25), np.arange(-40.0, 40.0, 0.25))
    rough = 0.05 * np.sin(2.0 * x) + 0.04 * np.cos(3.0 * z)
    return terrain.heightfield(rough.astype(np.float32), 0.25, origin=(-40.0, 0.0, -40.0))


def moved_clip(
    frames: jaxik.Frame, first: int, count: int, rng: np.random.Generator
) -> jaxik.Frame:
    """A part of a clip somewhere else, at another pace."""
    part = jax.tree.map(lambda leaf: np.asarray(leaf)[first : first + count], frames)
    world = part.world_from_model
    pos = world.pos + rng.uniform(-20.0, 20.0, 3) * [1.0, 0.0, 1.0]
    return dataclasses.replace(
        part, world_from_model=Transform(pos, world.rot), dt=part.dt * rng.uniform(0.5, 2.0)
    )
