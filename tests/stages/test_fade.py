"""Fades: whatever weight jumps, joints move at a limited speed, and end where they would be."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD, Transform
from jaxik.pipeline.system import Trace
from jaxik.stages.contact import LabelContact
from jaxik.stages.effector import DirectEffector
from jaxik.stages.fade import SpeedFade
from jaxik.stages.inputs import SensedMoment
from jaxik.stages.root import KeepRoot
from jaxik.world.frame import Sensed
from jaxik.world.terrain import Terrain
from reference import sample_poses
from reference.stages import fade as reference
from support import clips
from support.cases import QUICK, RIG
from support.clips import animate, assert_close, at, planes, to_frames, to_rig, to_terrain

HZ = 60.0
LIMIT = 0.01  # m a frame
CASES, FRAMES = 12, 100
OFF, ON, LANDING, LIFTED = 20, 70, 30, 10  # frames


def jumping(case: int) -> tuple[Terrain, jaxik.Frame]:
    """A standing pose over a slope, and weights that jump in the way of this case."""
    rng = np.random.default_rng(case)
    ankles = sample_poses.standing() + rng.uniform(-0.1, 0.1, (2, 3)) * [1.0, 0.0, 1.5]
    pose = sample_poses.make_frame(RIG, ankles, hip_height=rng.uniform(0.65, 0.9))
    frames = to_frames([pose] * FRAMES)
    slope = (rng.uniform(-0.3, 0.3), rng.uniform(-0.6, 0.6), rng.uniform(-0.2, 0.15))
    grounded, weight = np.ones(FRAMES), np.ones((FRAMES, 2))
    match case % 4:
        case 0:
            grounded[OFF:ON] = 0.0
        case 1:
            weight[OFF:ON, 0] = 0.0
        case 2:
            grounded[OFF : OFF + 5] = 0.0
            weight[OFF + 10 : ON, 1] = 0.0
        case _:
            weight = rng.choice([0.0, 0.5, 1.0], (FRAMES // 10, 2)).repeat(10, axis=0)
    frames = dataclasses.replace(frames, grounded=jnp.asarray(grounded), weight=jnp.asarray(weight))
    return to_terrain(planes(slope)), frames


def falling() -> tuple[Terrain, jaxik.Frame]:
    """A character that falls for 0.3 s, at 3 m/s, and stands."""

    def place(time: float) -> list[float]:
        return [0.0, 3.0 * np.clip(LANDING / HZ - time, 0.0, 0.3), 0.0]

    frames = to_frames(animate(RIG, count=FRAMES, hip_height=0.86, place=place))
    grounded = jnp.asarray(np.arange(FRAMES) >= LANDING, float)
    ground = to_terrain(planes((0.0, 0.0, -0.12)))
    return ground, dataclasses.replace(frames, grounded=grounded)


def lifting() -> tuple[Terrain, jaxik.Frame]:
    """A standing pose whose left foot soon counts as swinging."""
    frames = to_frames([sample_poses.make_frame(RIG, sample_poses.standing((0.14, 0.08)))] * FRAMES)
    standing = frames.stride.standing.at[LIFTED:, 0].set(0.0)
    stride = dataclasses.replace(frames.stride, standing=standing)
    return to_terrain(planes((0.0, -0.3, -0.05))), dataclasses.replace(frames, stride=stride)


@functools.cache
def jumps() -> tuple[Terrain, jaxik.Frame]:
    """All cases, and then the fall, and twice the foot that is lifted."""
    each = *map(jumping, range(CASES)), falling(), lifting(), lifting()
    return jax.tree.map(lambda *x: jnp.stack(x), *each)


@functools.cache
def jumped() -> jaxik.Result:
    """Weights go by contact, except for the last clip."""

    def run(by_contact: jax.Array, ground: Terrain, frames: jaxik.Frame) -> jaxik.Result:
        effector = DirectEffector(if_found=True, by_contact=by_contact)
        rules = {"contact": LabelContact(), "root": KeepRoot(), "effector": effector}
        ik = dataclasses.replace(jaxik.presets.ozz(), **rules)
        return jaxik.run(ik, to_rig(RIG), ground, frames)

    by_contact = jnp.arange(CASES + 3) < CASES + 2
    return jax.jit(jax.vmap(run), compiler_options=QUICK)(by_contact, *jumps())


@pytest.mark.slow
def test_no_joint_moves_faster_whatever_weight_jumps():
    """Once everything has settled."""
    pose = at(jumped().pose, (slice(CASES), slice(OFF - 2, None)))
    for name in ("hip", "ankle", "toe"):
        moved = np.linalg.norm(np.diff(getattr(pose, name).pos, axis=1), axis=-1).max()
        assert 0.002 < moved <= LIMIT, name


@pytest.mark.slow
def test_a_character_in_the_air_is_as_animated_after_its_fade():
    result, frames = jumped(), jumps()[1]
    assert np.abs(np.asarray(result.pose.ankle.pos - frames.pose.ankle.pos)).max() > 0.05
    for joint in ("hip", "ankle", "toe"):
        moved = getattr(result.pose, joint).pos - getattr(frames.pose, joint).pos
        assert np.abs(moved[0:CASES:4, ON - 1]).max() < 1e-3


@pytest.mark.slow
def test_feet_land_at_the_speed_of_the_fall():
    result, fall = at((jumped(), jumps()[1]), CASES)
    feet = np.asarray(fall.world_from_model.pos[:, None] + result.pose.ankle.pos)
    moved = np.linalg.norm(np.diff(feet, axis=0), axis=-1).max(axis=1)
    assert moved.max() < 1.2 * 3.0 / HZ, "no foot is much faster than the fall"
    heights = feet[:, 0, 1] - (float(jaxik.presets.ozz().target.foot_height) - 0.12)
    assert heights[29] > 0.1 and abs(heights[35]) < 1e-3, "the ground is met within 0.1 s"


@pytest.mark.slow
def test_a_swinging_foot_is_as_animated_where_weights_go_by_contact():
    result, frames = jumped(), jumps()[1]
    ankle = result.pose.ankle.pos
    moved = np.asarray(ankle - frames.pose.ankle.pos - result.body.pos[:, :, None])
    swinging, always = moved[-2:, :, 0]
    assert np.linalg.norm(always[-1]) > 0.03, "else a swinging foot is pulled to the ground"
    np.testing.assert_allclose(swinging[LIFTED - 1], always[LIFTED - 1], atol=1e-9)
    assert np.abs(swinging[-1]).max() < 1e-4
    assert np.linalg.norm(np.diff(ankle[-2, :, 0], axis=0), axis=-1).max() < LIMIT


# The fade by itself.


@jax.jit
def faded(trace: Trace, ground: Terrain) -> tuple[Transform, jax.Array]:
    """The body and the weights that the fade makes of what the stages want without one."""
    fade, sensed, advanced = SpeedFade(), trace.sensed, trace.advanced
    wanted = Transform(advanced.state.pelvis.offset_ws, advanced.lean.rot_ws)

    def scanned(carry, frame):
        state, started = carry
        sensed, wanted, effector = frame
        now = SensedMoment(jnp.asarray(1.0 / HZ), started, HARD, sensed, ground)
        state, body = fade.body(now, wanted, sensed.weight, state)
        state, weight = fade.legs(now, effector, body, sensed.weight, state)
        return (state, jnp.ones_like(started)), (body, weight)

    start = (fade.init(to_rig(RIG)), jnp.zeros((), bool))
    return jax.lax.scan(scanned, start, (sensed, wanted, advanced.effector))[1]


@functools.cache
def walked() -> tuple[Terrain, Trace]:
    """A walk without a fade."""
    rng = np.random.default_rng(4)
    frames = to_frames(clips.wandering(RIG, rng, 200))
    ground = to_terrain(sample_poses.rough(rng, cells=14, size=4.5))
    trace = jaxik.run(clips.to_ik({}), to_rig(RIG), ground, frames).trace
    assert trace is not None
    return ground, trace


def test_the_fade_is_that_of_the_reference():
    ground, trace = walked()
    body, weight = faded(trace, ground)
    sensed, advanced = jax.tree.map(np.asarray, (trace.sensed, trace.advanced))
    tilts = np.linalg.norm(sensed.ground.ankle.normal - sensed.leg_up_ws[:, None], axis=-1)
    turned = np.asarray(jax.vmap(lambda sensed: sensed.turned)(trace.sensed))
    memory, largest_gap = None, 0.0
    for i in range(len(sensed.weight)):
        wish = reference.Wish(
            dt=1.0 / HZ,
            up=sensed.up_ws[i],
            weights=sensed.weight[i],
            hips=sensed.hip_ws[i],
            ankles=sensed.ankle_ws[i],
            ankle_rots=sensed.ankle_rot_ws[i],
            balls=sensed.ball_ws[i],
            targets=advanced.effector.target_ws[i],
            target_rots=advanced.effector.rot_ws[i],
            tilts=tilts[i] * turned[i],
            reach=(sensed.thigh + sensed.shin)[i],
            lift=sensed.root_ws[i],
            offset=advanced.state.pelvis.offset_ws[i],
            rot=advanced.lean.rot_ws[i],
        )
        memory = reference.step(0.5, wish, memory)
        np.testing.assert_allclose(weight[i], memory.weights, atol=1e-6)
        np.testing.assert_allclose(body.pos[i], memory.offset, atol=1e-6)
        assert sample_poses.rotation_angle(np.asarray(body.rot[i]), memory.rot) < 1e-4
        largest_gap = max(largest_gap, float(np.abs(wish.weights - memory.weights).max()))
    assert largest_gap > 0.5, "the clip has jumps of weights"


def test_weights_that_stay_leave_no_trace_of_the_fade():
    ground, trace = walked()
    sensed = dataclasses.replace(trace.sensed, weight=jnp.full_like(trace.sensed.weight, 0.7))
    body, weight = faded(dataclasses.replace(trace, sensed=sensed), ground)
    np.testing.assert_allclose(weight, 0.7, atol=1e-12)
    np.testing.assert_allclose(body.pos, trace.advanced.state.pelvis.offset_ws, atol=1e-12)
    np.testing.assert_allclose(body.rot, trace.advanced.lean.rot_ws, atol=1e-12)


@pytest.mark.parametrize("noise", [1.2e-7, 1e-3])
def test_weights_that_differ_by_noise_hold_the_body_back_by_as_little(noise):
    ground, trace = walked()
    odd = (jnp.arange(len(trace.sensed.weight)) % 2)[:, None]
    weight = jnp.ones_like(trace.sensed.weight) - noise * odd
    sensed = dataclasses.replace(trace.sensed, weight=weight)
    body, faded_weight = faded(dataclasses.replace(trace, sensed=sensed), ground)
    lag = np.linalg.norm(body.pos - trace.advanced.state.pelvis.offset_ws, axis=-1)
    reach = float((trace.sensed.thigh + trace.sensed.shin).max())
    assert lag.max() <= noise * reach
    np.testing.assert_allclose(faded_weight, weight, atol=noise)


def test_a_leg_that_is_missing_for_a_frame_is_forgotten_at_once():
    """As after a NaN in it: what pelvis and lean want is wrong in this frame, too."""
    ground, trace = walked()
    weight = jnp.ones_like(trace.sensed.weight)
    goal = trace.advanced.state.pelvis.offset_ws
    missing = dataclasses.replace(trace.sensed, weight=weight.at[100, 0].set(0.0))
    moved = eqx.tree_at(
        lambda done: done.state.pelvis.offset_ws, trace.advanced, goal.at[100].add(0.2)
    )
    body, _ = faded(Trace(missing, moved), ground)
    lag = np.linalg.norm(body.pos - goal, axis=-1)
    speed = np.linalg.norm(np.diff(goal, axis=0), axis=-1).max()
    assert lag.max() < LIMIT + speed and lag[110:].max() < 1e-6


@pytest.mark.slow
def test_gradients_of_the_fade_are_finite_where_nothing_has_to_be_corrected():
    ground, trace = walked()
    sensed, offset_ws = trace.sensed, trace.advanced.state.pelvis.offset_ws
    still = eqx.tree_at(
        lambda done: (done.effector.target_ws, done.effector.rot_ws, done.state.pelvis.offset_ws),
        trace.advanced,
        (sensed.ankle_ws, sensed.ankle_rot_ws, 0.0 * offset_ws),
    )
    floats, rest = eqx.partition(Trace(sensed, still), eqx.is_inexact_array)

    def total(floats: Trace) -> jax.Array:
        body, weight = faded(eqx.combine(floats, rest), ground)
        return weight.sum() + body.pos.sum() + body.rot.sum()

    gradient = jax.jit(jax.grad(total))(floats)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))
    assert np.abs(gradient.sensed.weight).max() > 0


def moment(
    ground: Terrain, sensed: Sensed, dt: float = 1.0 / HZ, **changes: jax.Array
) -> SensedMoment:
    """A frame of `walked` as one that is not the first, with changes."""
    sensed = dataclasses.replace(sensed, **changes)
    return SensedMoment(jnp.asarray(dt), jnp.asarray(True), HARD, sensed, ground)


def test_a_foot_that_swings_joins_its_animation_faster_by_its_own_speed():
    ground, trace = walked()
    sensed, effector = at((trace.sensed, trace.advanced.effector), 10)
    aside = jnp.array([0.0, 0.1, 0.1])
    effector = dataclasses.replace(effector, target_ws=sensed.ankle_ws + aside)
    fade, body = SpeedFade(), Transform(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]))
    state = fade.init(to_rig(RIG))
    state = dataclasses.replace(state, weight=jnp.ones(2), speed=jnp.asarray(0.5))

    def steps(foot_speed: float, weight: float) -> np.ndarray:
        """How far the weights of the legs move from 1 towards this weight in a frame."""
        swings = {"foot_speed": jnp.full(2, foot_speed), "weight": jnp.ones(2)}
        now = moment(ground, sensed, dt=1e-3, **swings)
        return 1.0 - np.asarray(fade.legs(now, effector, body, jnp.full(2, weight), state)[1])

    assert (steps(0.0, 0.0) > 1e-4).all() and (steps(2.0, 0.0) < 1.0).all()
    np.testing.assert_allclose(steps(2.0, 0.0), steps(0.0, 0.0) * (0.5 + 2.0) / 0.5, rtol=1e-6)
    np.testing.assert_array_equal(steps(2.0, 1.0), 0.0)


def test_a_change_of_a_weight_holds_the_body_back_in_proportion():
    """By a leg's length for a full one; then the lag closes at the speed of the fade."""
    ground, trace = walked()
    now = moment(ground, at(trace.sensed, 10), dt=0.01, weight=jnp.ones(2))
    reach, fade = float((now.sensed.thigh + now.sensed.shin).max()), SpeedFade()
    start = dataclasses.replace(fade.init(to_rig(RIG)), weight=jnp.ones(2))
    goal = Transform(jnp.array([0.0, 0.2, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0]))
    # Change of a weight, lag so far in m; height of the body one frame later, m.
    for change, lag, height in (
        (0.0, 0.0, 0.2),
        (1.2e-7, 0.0, 0.2),
        (0.01, 0.0, 0.2 - 0.01 * reach),
        (1.0, 0.0, 0.0025),
        (0.0, 0.1, 0.2 - 0.1 + 0.005),
        (0.0, 0.3, 0.005),
    ):
        state = dataclasses.replace(start, lag=jnp.asarray(lag))
        weight = jnp.array([1.0, 1.0 - change])
        after, body = fade.body(now, goal, weight, state)
        assert float(body.pos[1]) == pytest.approx(height, abs=2e-7 + 0.01 * change), change
        assert float(after.lag) == pytest.approx(0.2 - float(body.pos[1]), abs=1e-9)


def test_a_leg_that_is_not_there_moves_no_body_and_is_no_part_of_a_fall():
    ground, trace = walked()
    fade, sensed = SpeedFade(), jax.tree.map(jnp.asarray, at(trace.sensed, 10))
    first = {name: getattr(sensed, name)[jnp.array([0, 0])] for name in ("hip_ws", "thigh")}
    absent = {name: leaf.at[1].set(9.0) for name, leaf in first.items()}
    absent |= {"present": jnp.array([True, False])}
    goal = Transform(jnp.array([0.0, 0.2, 0.0]), jnp.array([0.8, 0.0, 0.6, 0.0]))
    start = fade.init(to_rig(RIG))
    start = dataclasses.replace(start, hip_height=jnp.asarray(2.0))
    expected, actual = (
        fade.body(moment(ground, sensed, **legs), goal, jnp.zeros(2), start)
        for legs in (first, absent)
    )
    assert expected[0].fall_speed > 1.0
    assert_close(actual, expected, 1e-12)
