"""Fades: whatever weight jumps, joints move at a limited speed, and end where they would be."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik import HARD, Transform
from jaxik.maths import vec
from jaxik.stages.contact import LabelContact
from jaxik.stages.effector import FoundEffector
from jaxik.stages.fade import NoFade, SpeedFade
from jaxik.stages.inputs import SensedMoment
from jaxik.world.terrain import Terrain
from reference import sample_poses
from reference.stages import fade as reference
from support.cases import QUICK
from support.clips import make_rig, planes, to_frames, to_ik, to_rig, to_terrain, wandering
from support.padding import three_legged

HZ = 60.0
LIMIT = 0.01  # m a frame
PRESETS = ("record", "ozz", "unreal", "mec", "stride")
CASES, FRAMES = 12, 100
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


@functools.cache
def jumps() -> tuple[Terrain, jaxik.Frame]:
    return jax.tree.map(lambda *x: jnp.stack(x), *map(jumping, range(CASES)))


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
        name: float(np.linalg.norm(np.diff(joint.pos, axis=1), axis=-1)[:, OFF - 2 :].max())
        for name, joint in joints.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_no_joint_moves_faster_whatever_weight_jumps(preset):
    limits: dict[str, float] = dict.fromkeys(("hip", "ankle", "ball"), LIMIT)
    if preset == "stride":
        limits["ankle"] = HEELS
    for joint, moved in speeds(jumped(preset)).items():
        assert 0.002 < moved <= limits[joint], joint


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_a_character_in_the_air_is_as_animated_after_its_fade(preset):
    result, frames = jumped(preset), jumps()[1]
    root = result.trace.sensed.root_ws
    airborne = slice(0, CASES, 4), ON - 1
    assert np.abs(np.asarray(result.pose.ankle.pos - frames.pose.ankle.pos)).max() > 0.05
    for joint in ("hip", "ankle", "toe"):
        moved = getattr(result.pose, joint).pos - getattr(frames.pose, joint).pos
        moved = np.asarray(moved)[airborne] - np.asarray(root)[airborne][:, None]
        assert np.abs(moved).max() < 1e-3


def alone(ik: jaxik.FootIK, frames: jaxik.Frame, ground: Terrain) -> tuple:
    """The fade by itself: what the stages want without one, and what it makes of that."""
    fade, rig = SpeedFade(), to_rig(make_rig())
    trace = jaxik.run(dataclasses.replace(ik, fade=NoFade()), rig, ground, frames).trace
    assert trace is not None
    sensed, advanced = trace.sensed, trace.advanced
    wanted = Transform(advanced.state.pelvis.offset_ws, advanced.lean.rot_ws)

    def scanned(carry, frame):
        state, started = carry
        sensed, wanted, effector = frame
        now = SensedMoment(sensed.dt, started, HARD, sensed, ground)
        state, body = fade.body(now, wanted, sensed.weight, state)
        state, weight = fade.legs(now, effector, body, sensed.weight, state)
        return (state, jnp.ones_like(started)), (body, weight)

    start = (fade.init(rig), jnp.zeros((), bool))
    return trace, jax.lax.scan(scanned, start, (sensed, wanted, advanced.effector))[1]


def test_the_fade_is_that_of_the_reference():
    rng = np.random.default_rng(4)
    frames = to_frames(wandering(make_rig(), rng, 200))
    ground = to_terrain(sample_poses.rough(rng, cells=14, size=4.5))
    trace, (body, weight) = jax.jit(alone, compiler_options=QUICK)(to_ik({}), frames, ground)
    sensed, advanced = jax.tree.map(np.asarray, (trace.sensed, trace.advanced))
    tilts = np.linalg.norm(sensed.ground.ankle.normal - sensed.leg_up_ws[:, None], axis=-1)
    turned = jax.vmap(lambda sensed: sensed.turned)(trace.sensed)
    memory, largest_gap = None, 0.0
    for i in range(len(frames.dt)):
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
            tilts=tilts[i] * np.asarray(turned[i]),
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
    frames = to_frames(wandering(make_rig(), np.random.default_rng(5), 60))
    frames = dataclasses.replace(frames, weight=jnp.full_like(frames.weight, 0.7))
    frames = dataclasses.replace(frames, grounded=jnp.ones_like(frames.grounded))
    ground, rig = to_terrain(planes((0.2, 0.1, -0.1))), to_rig(make_rig())
    results = [
        jax.jit(jaxik.run, compiler_options=QUICK)(
            dataclasses.replace(to_ik({}), fade=fade), rig, ground, frames
        )
        for fade in (NoFade(), SpeedFade())
    ]
    without, faded = ((result.pose, result.body) for result in results)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), without, faded)


def falling() -> jaxik.Frame:
    """A standing pose that falls for 0.3 s, at up to 3 m/s, and then stands."""
    count, landing = 60, 30
    time = np.minimum((np.arange(count) - landing) / HZ, 0.0)
    pose = sample_poses.make_frame(make_rig(), sample_poses.standing(), hip_height=0.86)
    frames = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), to_frames([pose]))
    height = jnp.asarray(3.0 * np.minimum(-time, 0.3))
    root = frames.world_from_model
    root = dataclasses.replace(root, pos=root.pos.at[:, 1].add(height))
    grounded = jnp.asarray(np.arange(count) >= landing, float)
    return dataclasses.replace(frames, world_from_model=root, grounded=grounded)


@pytest.mark.slow
def test_feet_land_at_the_speed_of_the_fall():
    frames, ground = falling(), to_terrain(planes((0.0, 0.0, -0.12)))
    rig = to_rig(make_rig())
    result = jax.jit(jaxik.run, compiler_options=QUICK)(jaxik.presets.stride(), rig, ground, frames)
    feet = np.asarray(
        jax.vmap(lambda w, x: w.apply(x))(frames.world_from_model, result.pose.ankle.pos)
    )
    moved = np.linalg.norm(np.diff(feet, axis=0), axis=-1).max(axis=1)
    assert moved.max() < 1.2 * 3.0 / HZ, "no foot is much faster than the fall"
    heights = feet[:, 0, 1] - (sample_poses.ANKLE - 0.12)
    assert heights[29] > 0.1 and abs(heights[35]) < 1e-3, "the ground is met within 0.1 s"


@pytest.mark.slow
def test_a_leg_that_is_not_there_changes_no_landing():
    ik, ground = jaxik.presets.record(), to_terrain(planes((0.2, 0.1, -0.12)))
    rig, frames = to_rig(make_rig()), falling()
    padded_rig, padded_frames = three_legged(rig, frames)
    run = jax.jit(jaxik.run, compiler_options=QUICK)
    alone, padded = run(ik, rig, ground, frames), run(ik, padded_rig, ground, padded_frames)
    np.testing.assert_allclose(padded.body.pos, alone.body.pos, atol=1e-9)
    np.testing.assert_allclose(padded.pose.ankle.pos[:, :2], alone.pose.ankle.pos, atol=1e-9)


@pytest.mark.slow
def test_gradients_through_a_fade_are_finite_where_nothing_has_to_be_corrected():
    def height(speed: jax.Array, rise: jax.Array) -> jax.Array:
        fade = SpeedFade(speed=speed)
        ik = dataclasses.replace(jaxik.presets.ozz(), fade=fade)
        ground = jaxik.world.terrain.plane()
        frames = falling().translated(vec.scale(jnp.asarray([0.0, 1.0, 0.0]), rise))
        return jaxik.run(ik, to_rig(make_rig()), ground, frames).pose.ankle.pos[..., 1].sum()

    for argument in (0, 1):
        gradient = jax.jit(jax.grad(height, argument), compiler_options=QUICK)
        assert np.isfinite(gradient(jnp.asarray(0.5), jnp.zeros(())))


def test_a_swinging_foot_is_as_animated_where_weights_go_by_contact():
    def solved(by_contact: jax.Array) -> tuple[jax.Array, jax.Array]:
        effector = FoundEffector(by_contact=by_contact)
        ik = dataclasses.replace(jaxik.presets.ozz(), contact=LabelContact(), effector=effector)
        pose = sample_poses.make_frame(make_rig(), sample_poses.standing((0.14, 0.08)))
        frames = jax.tree.map(lambda x: jnp.repeat(x, 60, axis=0), to_frames([pose]))
        standing = frames.stride.standing.at[10:, 0].set(0.0)
        stride = dataclasses.replace(frames.stride, standing=standing)
        frames = dataclasses.replace(frames, stride=stride)
        ground = to_terrain(planes((0.0, -0.3, -0.05)))
        result = jaxik.run(ik, to_rig(make_rig()), ground, frames)
        moved = result.pose.ankle.pos - frames.pose.ankle.pos - result.body.pos[:, None]
        return moved[:, 0], result.pose.ankle.pos[:, 0]

    program = jax.jit(solved, compiler_options=QUICK)
    moved, ankle = map(np.asarray, program(jnp.asarray(True)))
    always = np.asarray(program(jnp.asarray(False))[0])
    assert np.linalg.norm(always[-1]) > 0.03, "else a swinging foot is pulled to the ground"
    np.testing.assert_allclose(moved[9], always[9], atol=1e-9)
    assert np.abs(moved[-1]).max() < 1e-4
    assert np.linalg.norm(np.diff(ankle, axis=0), axis=-1).max() < LIMIT


@pytest.mark.parametrize("preset", PRESETS[:-1])
def test_faithful_systems_have_no_fade_of_ours(preset):
    faithful = getattr(jaxik.presets, preset)(faithful=True)
    assert jax.tree.leaves(faithful.fade) == []
    assert isinstance(getattr(jaxik.presets, preset)().fade, SpeedFade)


def test_a_foot_that_swings_joins_its_animation_faster_by_its_own_speed():
    frames = to_frames(wandering(make_rig(), np.random.default_rng(4), 20))
    ground, rig = to_terrain(planes((0.2, 0.1, -0.12))), to_rig(make_rig())
    ik = dataclasses.replace(to_ik({}), fade=NoFade())
    trace = jax.jit(jaxik.run, compiler_options=QUICK)(ik, rig, ground, frames).trace
    sensed, effector = jax.tree.map(lambda x: x[10], (trace.sensed, trace.advanced.effector))
    aside = jnp.array([0.0, 0.1, 0.1])
    effector = dataclasses.replace(effector, target_ws=sensed.ankle_ws + aside)
    fade, body = SpeedFade(), Transform(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]))
    state = dataclasses.replace(fade.init(rig), weight=jnp.ones(2), speed=jnp.asarray(0.5))

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
    frames = to_frames(wandering(make_rig(), np.random.default_rng(4), 20))
    ground, rig = to_terrain(planes((0.2, 0.1, -0.12))), to_rig(make_rig())
    trace = jax.jit(jaxik.run, compiler_options=QUICK)(to_ik({}), rig, ground, frames).trace
    sensed = jax.tree.map(lambda x: x[10], trace.sensed)
    sensed = dataclasses.replace(sensed, dt=jnp.asarray(0.01))
    now = SensedMoment(sensed.dt, jnp.asarray(True), HARD, sensed, ground)
    fade, weight = SpeedFade(), jnp.ones(2)
    goal = Transform(jnp.array([0.0, 0.2, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0]))

    def height(since: float) -> float:
        """m, of the body one frame later, if weights have not changed for so many seconds."""
        state = dataclasses.replace(
            fade.init(rig), goal=weight, weight=weight, since=jnp.asarray(since)
        )
        return float(fade.body(now, goal, weight, state)[1].pos[1])

    assert height(0.5) == pytest.approx(0.5 * 0.01)
    assert height(0.95) == pytest.approx(0.5 * 0.01)
    assert height(1.05) == height(1.95) == pytest.approx(0.2)
