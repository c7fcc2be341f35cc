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
from jaxik.maths import vec
from jaxik.pipeline.system import Trace
from jaxik.stages.contact import LabelContact
from jaxik.stages.effector import FoundEffector
from jaxik.stages.fade import SpeedFade
from jaxik.stages.inputs import SensedMoment
from jaxik.world.terrain import Terrain
from reference import sample_poses
from reference.stages import fade as reference
from support.cases import QUICK
from support.clips import at, make_rig, planes, to_frames, to_ik, to_rig, to_terrain, wandering
from support.padding import three_legged

HZ = 60.0
LIMIT = 0.01  # m a frame
PRESETS = ("record", "ozz", "unreal", "mec", "stride")
SLOW_PRESETS = [
    name if name == "ozz" else pytest.param(name, marks=pytest.mark.slow) for name in PRESETS
]
CASES, FRAMES = 12, 100
LANDING = 30  # frames
HEELS = 0.016  # m a frame: a heel rises faster than the body that stretches its leg
OFF, ON = 20, 70  # frames


def jumping(case: int) -> tuple[Terrain, jaxik.Frame]:
    """A standing pose over a slope, and weights that jump in the way of this case."""
    rng = np.random.default_rng(case)
    ankles = sample_poses.standing() + rng.uniform(-0.1, 0.1, (2, 3)) * [1.0, 0.0, 1.5]
    pose = sample_poses.make_frame(make_rig(), ankles, hip_height=rng.uniform(0.65, 0.9))
    frames = jax.tree.map(lambda x: jnp.repeat(x, FRAMES, axis=0), to_frames([pose]))
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


def falling() -> jaxik.Frame:
    """A standing pose that falls for 0.3 s, at up to 3 m/s, and then stands."""
    time = np.minimum((np.arange(FRAMES) - LANDING) / HZ, 0.0)
    pose = sample_poses.make_frame(make_rig(), sample_poses.standing(), hip_height=0.86)
    frames = jax.tree.map(lambda x: jnp.repeat(x, FRAMES, axis=0), to_frames([pose]))
    height = jnp.asarray(3.0 * np.minimum(-time, 0.3))
    root = frames.world_from_model
    root = dataclasses.replace(root, pos=root.pos.at[:, 1].add(height))
    grounded = jnp.asarray(np.arange(FRAMES) >= LANDING, float)
    return dataclasses.replace(frames, world_from_model=root, grounded=grounded)


@functools.cache
def jumps() -> tuple[Terrain, jaxik.Frame]:
    """All cases, and then the fall."""
    fall = to_terrain(planes((0.0, 0.0, -0.12))), falling()
    return jax.tree.map(lambda *x: jnp.stack(x), *map(jumping, range(CASES)), fall)


@functools.cache
def jumped(preset: str) -> jaxik.Result:
    rig, ik = to_rig(make_rig()), getattr(jaxik.presets, preset)()
    if preset == "mec":
        # Its root is on the ground, and so every foot within the limits of its pelvis, 0.5 to
        # 0.88 m from the hip: with those its hips would not move at all.
        ik = dataclasses.replace(ik, pelvis=dataclasses.replace(ik.pelvis, max_length=0.72))
    run = jax.vmap(lambda terrain, frames: jaxik.run(ik, rig, terrain, frames))
    return jax.jit(run, compiler_options=QUICK)(*jumps())


def speeds(result: jaxik.Result) -> dict[str, float]:
    """The furthest that each joint moves between frames once everything has settled, m."""
    joints = {"hip": result.pose.hip, "ankle": result.pose.ankle, "ball": result.pose.toe}
    return {
        name: float(np.linalg.norm(np.diff(joint.pos, axis=1), axis=-1)[:CASES, OFF - 2 :].max())
        for name, joint in joints.items()
    }


@pytest.mark.parametrize("preset", SLOW_PRESETS)
def test_no_joint_moves_faster_whatever_weight_jumps(preset):
    limits: dict[str, float] = dict.fromkeys(("hip", "ankle", "ball"), LIMIT)
    if preset == "stride":
        limits["ankle"] = HEELS
    for joint, moved in speeds(jumped(preset)).items():
        assert 0.002 < moved <= limits[joint], joint


@pytest.mark.parametrize("preset", SLOW_PRESETS)
def test_a_character_in_the_air_is_as_animated_after_its_fade(preset):
    result, frames = jumped(preset), jumps()[1]
    root = result.trace.sensed.root_ws
    airborne = slice(0, CASES, 4), ON - 1
    assert np.abs(np.asarray(result.pose.ankle.pos - frames.pose.ankle.pos)).max() > 0.05
    for joint in ("hip", "ankle", "toe"):
        moved = getattr(result.pose, joint).pos - getattr(frames.pose, joint).pos
        moved = np.asarray(moved)[airborne] - np.asarray(root)[airborne][:, None]
        assert np.abs(moved).max() < 1e-3


# The fade by itself.


@jax.jit
def faded(trace: Trace, ground: Terrain) -> tuple[Transform, jax.Array]:
    """The body and the weights that the fade makes of what the stages want without one."""
    fade, sensed, advanced = SpeedFade(), trace.sensed, trace.advanced
    wanted = Transform(advanced.state.pelvis.offset_ws, advanced.lean.rot_ws)

    def scanned(carry, frame):
        state, started = carry
        sensed, wanted, effector = frame
        now = SensedMoment(sensed.dt, started, HARD, sensed, ground)
        state, body = fade.body(now, wanted, sensed.weight, state)
        state, weight = fade.legs(now, effector, body, sensed.weight, state)
        return (state, jnp.ones_like(started)), (body, weight)

    start = (fade.init(to_rig(make_rig())), jnp.zeros((), bool))
    return jax.lax.scan(scanned, start, (sensed, wanted, advanced.effector))[1]


@functools.cache
def walked() -> tuple[Terrain, Trace]:
    """A walk without a fade."""
    rng = np.random.default_rng(4)
    frames = to_frames(wandering(make_rig(), rng, 200))
    ground = to_terrain(sample_poses.rough(rng, cells=14, size=4.5))
    trace = jaxik.run(to_ik({}), to_rig(make_rig()), ground, frames).trace
    assert trace is not None
    return ground, trace


def test_the_fade_is_that_of_the_reference():
    ground, trace = walked()
    body, weight = faded(trace, ground)
    sensed, advanced = jax.tree.map(np.asarray, (trace.sensed, trace.advanced))
    tilts = np.linalg.norm(sensed.ground.ankle.normal - sensed.leg_up_ws[:, None], axis=-1)
    turned = np.asarray(jax.vmap(lambda sensed: sensed.turned)(trace.sensed))
    memory, largest_gap = None, 0.0
    for i in range(len(sensed.dt)):
        wish = reference.Wish(
            dt=float(sensed.dt[i]),
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


def test_gradients_of_the_fade_are_finite_where_nothing_has_to_be_corrected():
    ground, trace = walked()
    sensed, advanced = trace.sensed, trace.advanced
    effector = dataclasses.replace(
        advanced.effector, target_ws=sensed.ankle_ws, rot_ws=sensed.ankle_rot_ws
    )
    pelvis = dataclasses.replace(
        advanced.state.pelvis, offset_ws=jnp.zeros_like(advanced.state.pelvis.offset_ws)
    )
    state = dataclasses.replace(advanced.state, pelvis=pelvis)
    advanced = dataclasses.replace(advanced, effector=effector, state=state)
    floats, rest = eqx.partition(Trace(sensed, advanced), eqx.is_inexact_array)

    def total(floats: Trace) -> jax.Array:
        body, weight = faded(eqx.combine(floats, rest), ground)
        return weight.sum() + body.pos.sum() + body.rot.sum()

    gradient = jax.jit(jax.grad(total))(floats)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))
    assert np.abs(gradient.sensed.weight).max() > 0


def test_a_foot_that_swings_joins_its_animation_faster_by_its_own_speed():
    ground, trace = walked()
    sensed, effector = jax.tree.map(lambda x: x[10], (trace.sensed, trace.advanced.effector))
    aside = jnp.array([0.0, 0.1, 0.1])
    effector = dataclasses.replace(effector, target_ws=sensed.ankle_ws + aside)
    fade, body = SpeedFade(), Transform(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]))
    state = fade.init(to_rig(make_rig()))
    state = dataclasses.replace(state, weight=jnp.ones(2), speed=jnp.asarray(0.5))

    def steps(foot_speed: float, weight: float) -> np.ndarray:
        """How far the weights of the legs move from 1 towards this weight in a frame."""
        moving = dataclasses.replace(
            sensed, foot_speed=jnp.full(2, foot_speed), weight=jnp.ones(2), dt=jnp.asarray(1e-3)
        )
        now = SensedMoment(moving.dt, jnp.asarray(True), HARD, moving, ground)
        return 1.0 - np.asarray(fade.legs(now, effector, body, jnp.full(2, weight), state)[1])

    assert (steps(0.0, 0.0) > 1e-4).all() and (steps(2.0, 0.0) < 1.0).all()
    np.testing.assert_allclose(steps(2.0, 0.0), steps(0.0, 0.0) * (0.5 + 2.0) / 0.5, rtol=1e-6)
    np.testing.assert_array_equal(steps(2.0, 1.0), 0.0)


def test_the_body_is_held_back_for_a_second_after_weights_have_changed():
    """After that, the rules of the pelvis may move it as they like."""
    ground, trace = walked()
    sensed = jax.tree.map(lambda x: x[10], trace.sensed)
    sensed = dataclasses.replace(sensed, dt=jnp.asarray(0.01))
    now = SensedMoment(sensed.dt, jnp.asarray(True), HARD, sensed, ground)
    fade, weight = SpeedFade(), jnp.ones(2)
    start = dataclasses.replace(fade.init(to_rig(make_rig())), goal=weight, weight=weight)
    goal = Transform(jnp.array([0.0, 0.2, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0]))
    # Seconds since weights have changed; height of the body one frame later, m.
    for since, height in ((0.5, 0.005), (0.95, 0.005), (1.05, 0.2), (1.95, 0.2)):
        state = dataclasses.replace(start, since=jnp.asarray(since))
        moved = fade.body(now, goal, weight, state)[1].pos[1]
        assert float(moved) == pytest.approx(height), since


# Landings, and feet that swing.


@pytest.mark.slow
def test_feet_land_at_the_speed_of_the_fall():
    result, fall = at(jumped("stride"), -1), at(jumps()[1], -1)
    feet = np.asarray(fall.world_from_model.pos[:, None] + result.pose.ankle.pos)
    moved = np.linalg.norm(np.diff(feet, axis=0), axis=-1).max(axis=1)
    assert moved.max() < 1.2 * 3.0 / HZ, "no foot is much faster than the fall"
    heights = feet[:, 0, 1] - (sample_poses.ANKLE - 0.12)
    assert heights[29] > 0.1 and abs(heights[35]) < 1e-3, "the ground is met within 0.1 s"


@pytest.mark.slow
def test_a_leg_that_is_not_there_changes_no_landing():
    ik, ground = jaxik.presets.ozz(), to_terrain(planes((0.2, 0.1, -0.12)))
    rig, frames = to_rig(make_rig()), falling()
    alone = jaxik.run(ik, rig, ground, frames)
    padded_rig, padded_frames = three_legged(rig, frames)
    padded = jaxik.run(ik, padded_rig, ground, padded_frames)
    np.testing.assert_allclose(padded.body.pos, alone.body.pos, atol=1e-9)
    np.testing.assert_allclose(padded.pose.ankle.pos[:, :2], alone.pose.ankle.pos, atol=1e-9)


@pytest.mark.slow
def test_gradients_through_a_fade_are_finite_where_nothing_has_to_be_corrected():
    def height(speed: jax.Array, rise: jax.Array) -> jax.Array:
        ik = dataclasses.replace(jaxik.presets.ozz(), fade=SpeedFade(speed=speed))
        ground = jaxik.world.terrain.plane()
        frames = at(falling(), slice(0, 2 * LANDING))
        frames = frames.translated(vec.scale(jnp.asarray([0.0, 1.0, 0.0]), rise))
        return jaxik.run(ik, to_rig(make_rig()), ground, frames).pose.ankle.pos[..., 1].sum()

    gradient = jax.jit(jax.grad(height, (0, 1)), compiler_options=QUICK)
    assert np.isfinite(gradient(jnp.asarray(0.5), jnp.zeros(()))).all()


def test_a_swinging_foot_is_as_animated_where_weights_go_by_contact():
    pose = sample_poses.make_frame(make_rig(), sample_poses.standing((0.14, 0.08)))
    frames = jax.tree.map(lambda x: jnp.repeat(x, 60, axis=0), to_frames([pose]))
    standing = frames.stride.standing.at[10:, 0].set(0.0)
    frames = dataclasses.replace(
        frames, stride=dataclasses.replace(frames.stride, standing=standing)
    )
    ground = to_terrain(planes((0.0, -0.3, -0.05)))

    def solved(by_contact: bool) -> tuple[np.ndarray, np.ndarray]:
        """Where the left ankle is, m: from its animation on the moved body, and by itself."""
        effector = FoundEffector(by_contact=by_contact)
        ik = dataclasses.replace(jaxik.presets.ozz(), contact=LabelContact(), effector=effector)
        result = jaxik.run(ik, to_rig(make_rig()), ground, frames)
        moved = result.pose.ankle.pos - frames.pose.ankle.pos - result.body.pos[:, None]
        return np.asarray(moved[:, 0]), np.asarray(result.pose.ankle.pos[:, 0])

    moved, ankle = solved(by_contact=True)
    always = solved(by_contact=False)[0]
    assert np.linalg.norm(always[-1]) > 0.03, "else a swinging foot is pulled to the ground"
    np.testing.assert_allclose(moved[9], always[9], atol=1e-9)
    assert np.abs(moved[-1]).max() < 1e-4
    assert np.linalg.norm(np.diff(ankle, axis=0), axis=-1).max() < LIMIT
