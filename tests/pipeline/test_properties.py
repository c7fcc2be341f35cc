"""Properties of any pipeline: symmetries, memory, batches, dtypes, and numbers of programs."""

import dataclasses
import functools
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.synthetic import walker
from jaxik import Smooth, Transform
from jaxik.maths import parameter_tree, quat
from jaxik.maths.gate import AbstractGate
from jaxik.world.skeleton import bone_lengths
from reference import maths, sample_poses
from reference.systems import record as reference
from reference.terrain import Terrain as PlainTerrain
from support.clips import (
    BROKEN,
    FLAT,
    FRAMES,
    HZ,
    ODD,
    assert_close,
    at,
    make_rig,
    padded,
    planes,
    stepping,
    to_frames,
    to_ik,
    to_rig,
    to_terrain,
    to_transform,
    wandering,
)
from support.padding import three_legged

EXACT = 1e-9  # m, and length of the difference of unit quaternions
JOINTS = ("hip", "knee", "ankle", "toe")
DRIFTING = dataclasses.replace(BROKEN, platform=0)
PARAMETERS = {"adult": {}, "odd": ODD}


@functools.cache
def wander(legs: int = 2, seed: int = 1, joints: int = 0) -> jaxik.Frame:
    """A clip with a bit of everything, for ground on a platform that drifts and turns."""
    frames = to_frames(wandering(make_rig(joints, legs), np.random.default_rng(seed)))
    time = np.cumsum(np.asarray(frames.dt))
    angle = 0.1 * np.sin(2.0 * time)
    pos = np.stack([0.05 * time, 0.0 * time, 0.03 * np.sin(time)], axis=-1)
    rot = np.stack([np.cos(angle / 2), 0 * angle, np.sin(angle / 2), 0 * angle], axis=-1)
    return frames.with_platforms(Transform(jnp.asarray(pos)[:, None], jnp.asarray(rot)[:, None]))


def run_on(
    ground: PlainTerrain,
    frames: jaxik.Frame,
    values: dict[str, Any],
    rig: jaxik.Rig | None = None,
    gate: AbstractGate = jaxik.HARD,
) -> jaxik.Result:
    """The result of a clip of two legs on ground that rides on a platform: all share a program."""
    if not frames.platforms.pos.size:
        still = Transform(jnp.zeros((FRAMES, 1, 3)), jnp.tile(quat.identity(), (FRAMES, 1, 1)))
        frames = frames.with_platforms(still)
    ground = dataclasses.replace(ground, platform=0)
    rig = to_rig(make_rig()) if rig is None else rig
    return jaxik.run(to_ik(values), rig, to_terrain(ground), frames, gate)


@functools.cache
def wandered(name: str) -> jaxik.Result:
    return run_on(DRIFTING, wander(), PARAMETERS[name])


def offset_of(result: jaxik.Result) -> np.ndarray:
    """The lock's offset, (frames, legs, 3), m, world space."""
    advanced, sensed = result.trace.advanced, result.trace.sensed
    lift = sensed.contact.lift[..., None] * sensed.up_ws[:, None]
    return np.asarray(advanced.effector.target_ws - advanced.foothold_ws - lift)


def assert_same_rot(actual, expected, tolerance: float) -> None:
    actual, expected = np.asarray(actual), np.asarray(expected)
    apart = np.minimum(
        np.linalg.norm(actual - expected, axis=-1), np.linalg.norm(actual + expected, axis=-1)
    )
    assert apart.max() <= tolerance


def assert_same_transform(actual, expected, tolerance: float = EXACT) -> None:
    np.testing.assert_allclose(actual.pos, expected.pos, rtol=0, atol=tolerance)
    assert_same_rot(actual.rot, expected.rot, tolerance)


def assert_same_pose(actual, expected, tolerance: float = EXACT) -> None:
    for joint in JOINTS:
        assert_same_transform(getattr(actual, joint), getattr(expected, joint), tolerance)


# Flat ground.


def limits_kept(values: dict, frames: jaxik.Frame, result: jaxik.Result) -> np.ndarray:
    """Frames where no lock holds a foot and no leg is beyond `soften` times its reach."""
    held = np.linalg.norm(offset_of(result), axis=-1).max(axis=-1) > 1e-6
    a, b = (np.asarray(bone) for bone in bone_lengths(frames.pose))
    leg: Any = to_ik(values).leg
    free = leg.soften * np.sqrt(a * a + b * b - 2 * a * b * np.cos(leg.max_knee_angle))
    reach = np.linalg.norm(frames.pose.ankle.pos - frames.pose.hip.pos, axis=-1)
    return ~held & (reach <= np.asarray(free)).all(axis=-1)


def test_flat_ground_changes_a_walk_by_less_than_a_tenth_of_a_millimetre():
    for seed in range(3):
        rig = make_rig(seed)
        frames = to_frames(stepping(rig, heading=0.3 * seed, foot=0.05 * seed))
        root = frames.world_from_model  # so that it walks in the direction it faces
        root = Transform(quat.rotate(root.rot, root.pos), root.rot)
        frames = dataclasses.replace(frames, world_from_model=root)
        result = run_on(FLAT, frames, {}, to_rig(rig))
        # Standing feet do not slip and no leg is too straight, so that all frames count.
        assert limits_kept({}, frames, result).all()
        locks = np.diff(result.trace.advanced.state.lock.locked, axis=0)
        assert (locks == 1).any() and (locks == -1).any()
        assert_same_pose(result.pose, frames.pose, 1e-4)
        assert np.abs(result.body.pos).max() < 1e-4
        assert_same_rot(result.body.rot, quat.identity(), 1e-4)


def test_flat_ground_changes_a_walk_with_rolling_feet_only_by_its_locks():
    """Except for legs beyond `soften` times their reach.

    Ankles that roll over heel and ball move while they stand, and a lock holds them: these ankles
    move by the lock's offset and no more.
    """
    clip = walker.walk(FRAMES / HZ, HZ, seed=3)
    frames = frames_from_clip(clip)
    # Names and joints are static: keeping ours avoids compiling another program.
    names = {name: getattr(to_rig(make_rig()), name) for name in ("names", "joints", "pelvis")}
    rig = dataclasses.replace(clip.rig, **names)

    unlocked = {"lock.enabled": False}
    result = run_on(FLAT, frames, unlocked, rig)
    kept = limits_kept(unlocked, frames, result)
    assert kept.mean() > 0.5
    assert_same_pose(at(result.pose, kept), at(frames.pose, kept), 1e-4)

    result = run_on(FLAT, frames, {}, rig)
    offset, reached = offset_of(result), np.asarray(result.reached) > 0
    assert reached.mean() > 0.5 and np.abs(offset[reached]).max() > 0.01
    moved = jax.vmap(lambda root, a, b: quat.rotate(root.rot, a - b))(
        frames.world_from_model, result.pose.ankle.pos, frames.pose.ankle.pos
    )
    np.testing.assert_allclose(moved[reached], offset[reached], rtol=0, atol=1e-4)


# Symmetries.


def moved_ground(ground: PlainTerrain, by: reference.Transform) -> PlainTerrain:
    if ground.platform >= 0:  # in the space of its platform nothing changes, only in the world
        return dataclasses.replace(ground, up=maths.rotate(by.rot, ground.up))
    return PlainTerrain(
        maths.rotate(by.rot, ground.up),
        planes=[
            (maths.apply(by, point), maths.rotate(by.rot, normal))
            for point, normal in ground.planes
        ],
    )


def moved_frames(frames: jaxik.Frame, by: Transform) -> jaxik.Frame:
    return dataclasses.replace(
        frames,
        world_from_model=by @ frames.world_from_model,
        platforms=by @ frames.platforms,
        platforms_before=by @ frames.platforms_before,
        velocity_ws=quat.rotate(by.rot, frames.velocity_ws),
        stride=dataclasses.replace(
            frames.stride,
            last_ws=by.apply(frames.stride.last_ws),
            next_ws=by.apply(frames.stride.next_ws),
        ),
    )


def some_move(kind: str) -> reference.Transform:
    rng = np.random.default_rng(len(kind))
    pos = rng.uniform(-3.0, 3.0, 3)
    if kind == "turned about up":
        return reference.Transform(np.zeros(3), maths.from_axis_angle(maths.Y, 2.1))
    return reference.Transform(pos, sample_poses.random_rot(rng))


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("kind", ["turned about up", "turned, up too"])
def test_moving_the_world_moves_the_result(kind, name):
    by, before = some_move(kind), wandered(name)
    frames = moved_frames(wander(), to_transform(by))
    after = run_on(moved_ground(DRIFTING, by), frames, PARAMETERS[name])
    assert_same_pose(after.pose, before.pose)
    assert_same_transform(after.body, before.body)
    np.testing.assert_array_equal(after.reached, before.reached)
    target_ws = to_transform(by).apply(before.trace.advanced.effector.target_ws)
    np.testing.assert_allclose(after.trace.advanced.effector.target_ws, target_ws, atol=EXACT)
    for joint in ("hip", "knee", "ankle"):
        actual, expected = (getattr(r.corrections, joint) for r in (after, before))
        assert_same_rot(actual, expected, EXACT)


def mirrored(tree):
    """Swaps left and right in all positions and rotation axes."""

    def flip(t):
        if not isinstance(t, Transform):
            return t
        return Transform(t.pos * jnp.array([-1.0, 1, 1]), t.rot * jnp.array([1.0, 1, -1, -1]))

    return jax.tree.map(flip, tree, is_leaf=lambda t: isinstance(t, Transform))


@pytest.mark.parametrize("name", PARAMETERS)
def test_mirroring_the_world_mirrors_the_result(name):
    rig, flip = to_rig(make_rig()), np.array([-1.0, 1.0, 1.0])
    other = dataclasses.replace(
        rig,
        side=-rig.side,
        knee_axis_ls=rig.knee_axis_ls * jnp.array([1.0, -1, -1]),  # a rotation axis
        ankle_from_foot=rig.ankle_from_foot * jnp.array([1.0, 1, -1, -1]),
    )
    planes = [(point * flip, normal * flip) for point, normal in DRIFTING.planes]
    ground, values = dataclasses.replace(DRIFTING, planes=planes), PARAMETERS[name]
    values = values | {"leg.twist": -parameter_tree.get(to_ik(values), "leg.twist")}
    after, before = run_on(ground, mirrored(wander()), values, other), wandered(name)
    assert_same_pose(after.pose, mirrored(before.pose))
    assert_same_transform(after.body, mirrored(before.body))
    np.testing.assert_allclose(offset_of(after), offset_of(before) * flip, atol=EXACT)


def test_swapping_the_legs_swaps_their_results():
    swap = lambda tree: at(tree, jnp.array([1, 0]))  # noqa: E731
    rows = lambda tree: at(tree, (slice(None), jnp.array([1, 0])))  # noqa: E731
    frames, rig = wander(), swap(to_rig(make_rig()))
    swapped = dataclasses.replace(frames, pose=rows(frames.pose), weight=rows(frames.weight))
    after = run_on(DRIFTING, swapped, ODD, rig)
    assert_same_pose(after.pose, rows(wandered("odd").pose))
    assert_same_transform(after.body, wandered("odd").body)


# Bones.


@pytest.mark.parametrize("name", PARAMETERS)
def test_bones_keep_their_lengths(name):
    def lengths(pose):
        chain = [np.asarray(getattr(pose, joint).pos) for joint in JOINTS]
        return np.linalg.norm(np.diff(chain, axis=0), axis=-1)

    solved = wandered(name).pose
    np.testing.assert_allclose(lengths(solved), lengths(wander().pose), rtol=0, atol=1e-6)
    for joint in JOINTS:
        size = np.linalg.norm(getattr(solved, joint).rot, axis=-1)
        np.testing.assert_allclose(size, 1.0, atol=1e-12)


@pytest.mark.parametrize("name", PARAMETERS)
def test_corrections_are_the_solved_pose_and_ankles_arrive_where_reached(name):
    result, frames = wandered(name), wander()
    carried = jax.vmap(lambda pose, body: pose.transformed(body))(frames.pose, result.body)
    hip_turn = quat.multiply(result.pose.hip.rot, quat.conjugate(carried.hip.rot))
    for joint, parent_turn in (("hip", quat.identity()), ("knee", hip_turn)):
        turned = quat.multiply(
            quat.multiply(parent_turn, getattr(carried, joint).rot),
            getattr(result.corrections, joint),
        )
        assert_same_rot(turned, getattr(result.pose, joint).rot, EXACT)
    target = jax.vmap(lambda w, t: w.inverse().apply(t))(
        frames.world_from_model, result.trace.advanced.effector.target_ws
    )
    gap = np.linalg.norm(result.pose.ankle.pos - target, axis=-1)
    reached = np.asarray(result.reached) > 0.5
    # A leg of weight 0.9 never reaches its target exactly.
    assert reached.any() == (name == "adult") and not reached.all()
    assert gap[reached].max(initial=0.0) < EXACT < gap[~reached].min()


# Frame rates.


def walk_at(hz: float) -> jaxik.Frame:
    """Two seconds up a slope with slipping feet, at any frame rate."""
    return to_frames(padded(stepping(make_rig(), drift=0.05, hz=hz, count=int(2 * hz))))


def test_rates_of_30_and_60_hz_stay_within_three_and_one_millimetres_of_120_hz():
    ground = planes((0.1, 0.05, 0.0), (-0.1, 0.0, 0.1))
    runs = {hz: run_on(ground, walk_at(hz), {}) for hz in (30, 60, 120)}
    fine = at(runs[120], slice(0, FRAMES, 4))
    for hz, most, mean in ((30, 3e-3, 1e-3), (60, 1.2e-3, 5e-4)):  # m; measured: 2.3 and 0.8 mm
        coarse = at(runs[hz], slice(0, 2 * hz, hz // 30))
        places = [(getattr(coarse.pose, j).pos, getattr(fine.pose, j).pos) for j in JOINTS]
        apart = np.stack([np.linalg.norm(a - b, axis=-1) for a, b in places])
        assert apart.max() < most and apart.mean() < mean


# Batches.


CROWD_GROUNDS = [BROKEN, planes((0.1, 0.2, 0.05)), planes((-0.2, 0.0, -0.1), (0.2, 0.1, -0.2))]
crowd_run = jax.jit(jax.vmap(jaxik.run))


@functools.cache
def crowd() -> tuple[jaxik.FootIK, jaxik.Rig, object, jaxik.Frame]:
    """Two padded two-legged characters and a three-legged one, all different."""
    iks = [to_ik({}), to_ik(ODD), to_ik({"leg.soften": 0.9, "lock.enabled": False})]
    pairs = [three_legged(to_rig(make_rig(seed)), wander_of(seed)) for seed in range(2)]
    pairs.append((to_rig(make_rig(legs=3)), wander(3)))
    rigs, frames = zip(*pairs, strict=True)
    stack = lambda *leaves: jnp.stack(leaves)  # noqa: E731
    grounds = [to_terrain(dataclasses.replace(ground, platform=0)) for ground in CROWD_GROUNDS]
    return tuple(jax.tree.map(stack, *each) for each in (iks, rigs, grounds, frames))  # type: ignore[return-value]


def wander_of(seed: int) -> jaxik.Frame:
    return wander(seed=seed, joints=seed)


@functools.cache
def crowd_result() -> jaxik.Result:
    return crowd_run(*crowd())


@pytest.mark.parametrize("member", range(2))
def test_a_batch_equals_the_loop_and_padded_legs_change_nothing(member):
    values = list(PARAMETERS.values())[member]
    alone = run_on(CROWD_GROUNDS[member], wander_of(member), values, to_rig(make_rig(member)))
    together = at(crowd_result(), member)
    legs = at(together.pose, (slice(None), slice(2)))
    assert_same_pose(legs, alone.pose)
    assert_same_transform(together.body, alone.body)
    np.testing.assert_array_equal(together.reached[:, :2], alone.reached)
    np.testing.assert_allclose(offset_of(together)[:, :2], offset_of(alone), atol=EXACT)


def test_a_bad_member_does_not_affect_the_others_of_a_batch():
    for leaf in jax.tree.leaves(crowd_result()):
        assert np.isfinite(leaf).all()
    ik, rig, ground, frames = crowd()
    bad = frames.pose.ankle.pos.at[1, 40:50, 0].set(jnp.nan)
    spoiled = eqx.tree_at(lambda f: f.pose.ankle.pos, frames, bad)
    result = crowd_run(ik, rig, ground, spoiled)
    assert result.faulty[1].sum() == 10 and np.isfinite(result.pose.ankle.pos).all()
    for member in (0, 2):
        assert_close(at(result, member), at(crowd_result(), member), 0.0)


# Precision.


def single(tree):
    return jax.tree.map(
        lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


def single_inputs():
    return single((to_ik(ODD), to_rig(make_rig()), to_terrain(DRIFTING), wander()))


@functools.cache
def traced(smooth: bool):
    """The program of a clip in single precision."""
    gate = single(Smooth(1.0)) if smooth else jaxik.HARD
    with jax.numpy_dtype_promotion("strict"):
        return jax.make_jaxpr(jaxik.run)(*single_inputs(), gate)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_single_precision_program_contains_no_doubles(smooth):
    assert not list(doubles(traced(smooth).jaxpr))
    times = single_inputs()[-1].dt
    leak = jax.make_jaxpr(lambda x: jax.lax.map(lambda y: y * jnp.ones(2), x))(times)
    assert list(doubles(leak.jaxpr)), "the check notices doubles"


def doubles(program):
    """Double-precision values of a program; weak ones come from Python numbers and give way."""
    for equation in program.eqns:
        for variable in equation.outvars:
            if variable.aval.dtype == jnp.float64 and not variable.aval.weak_type:
                yield equation
        params = list(equation.params.values())
        for inner in jax.tree.leaves(params, is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(inner, "eqns"):
                yield from doubles(getattr(inner, "jaxpr", inner))


def test_single_precision_stays_within_a_hundredth_of_a_millimetre_of_double():
    result, double = jaxik.run(*single_inputs()), wandered("odd")
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        floating = jnp.issubdtype(leaf.dtype, jnp.floating)
        assert not floating or leaf.dtype == jnp.float32, jax.tree_util.keystr(path)
    locked, expected = (r.trace.advanced.state.lock.locked for r in (result, double))
    np.testing.assert_array_equal(locked, expected)
    for joint in JOINTS:
        actual, expected = getattr(result.pose, joint), getattr(double.pose, joint)
        np.testing.assert_allclose(actual.pos, expected.pos, rtol=0, atol=1e-5)
        assert_same_rot(actual.rot, expected.rot, 1e-4)
    thigh = np.linalg.norm(result.pose.knee.pos - result.pose.hip.pos, axis=-1)
    np.testing.assert_allclose(thigh, sample_poses.THIGH, atol=1e-6)


# Programs.


def test_other_values_need_no_new_program():
    def programs(ground: PlainTerrain, values: dict, seed: int, softness: float) -> int:
        rig = to_rig(make_rig(seed))
        for gate in (jaxik.HARD, Smooth(softness)):
            run_on(ground, wander_of(seed), values, rig, gate)
        return jaxik.run._cache_size()  # pyright: ignore[reportFunctionMemberAccess]

    level = planes((0.1, 0.0, 0.0))
    assert programs(DRIFTING, {}, 0, 0.5) == programs(level, ODD, 1, 0.1)


def test_only_the_smooth_program_contains_a_sigmoid():
    hard, smooth = (set(re.findall(r"= (\w+)", str(traced(smooth)))) for smooth in (False, True))
    assert not {"logistic", "tanh", "erf"} & hard and "logistic" in smooth


def test_smooth_tends_to_hard_as_softness_falls():
    apart, hard = [], wandered("odd").pose
    for softness in (1.0, 0.1, 1e-2, 1e-4, 1e-6):
        soft = run_on(DRIFTING, wander(), ODD, gate=Smooth(softness)).pose
        gaps = [np.abs(getattr(soft, j).pos - getattr(hard, j).pos).mean() for j in JOINTS]
        apart.append(max(gaps))
    assert apart == sorted(apart, reverse=True)
    assert apart[0] > 1e-3 and apart[-1] < 1e-7
