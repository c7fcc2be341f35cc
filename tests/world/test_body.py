"""Transforms, skeletons, and bodies of other sizes: their numbers, and similar motion."""

import dataclasses
import itertools
from math import inf
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import edit, load_clip
from fitting.clips.clip_frames import frames_from_clip
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    angle,
    constant,
    duration,
    half_life,
    length,
    parameter,
    speed,
    switch,
)
from jaxik.pipeline.shapes import check_system
from jaxik.stages.contact import HeightContact, SpeedContact
from jaxik.world import body, skeleton, terrain
from jaxik.world.body import exponent, similar
from jaxik.world.frame import rise_of
from jaxik.world.skeleton import LegPose, Skeleton, Still, Transform, bone_lengths
from support.bodies import scaled
from support.clips import assert_close, make_rig, to_rig
from support.experiments import ROOT
from support.gradients import ROWS, TINY, assert_all_gradients_match, quaternions, unit, vectors

RNG = np.random.default_rng(2)
FORK = (-1, 0, 0)
OFFSETS = RNG.normal(size=(6, 3))


def transforms() -> Transform:
    return Transform(jnp.asarray(vectors(RNG, 1.0, TINY, 0.0)), jnp.asarray(quaternions(RNG)))


def matrices(transform: Transform) -> np.ndarray:
    """4 x 4."""
    result = np.tile(np.eye(4), (*transform.pos.shape[:-1], 1, 1))
    rotations = Rotation.from_quat(np.asarray(transform.rot), scalar_first=True)
    result[..., :3, :3], result[..., :3, 3] = rotations.as_matrix(), transform.pos
    return result


def pose(parents: tuple[int, ...], offsets, rotations, positions=None) -> Transform:
    """World transforms of the joints of a skeleton."""
    names = tuple(f"joint{joint}" for joint in range(len(parents)))
    bones = Skeleton(jnp.asarray(offsets), names, parents)
    return skeleton.forward_kinematics(bones, jnp.asarray(rotations), positions)


def pose_of_fork(offsets, rotations):
    return pose(FORK, offsets, rotations)


def test_transforms_agree_with_matrices_from_scipy():
    a, b, points = transforms(), transforms(), vectors(RNG, 1.0, TINY, 0.0)
    assert_allclose(matrices(a @ b), matrices(a) @ matrices(b), atol=1e-14)
    assert_allclose(matrices(a.inverse()), np.linalg.inv(matrices(a)), atol=1e-14)
    assert_allclose(a.apply_rot(b.rot), (a @ b).rot, atol=0)
    assert_close(a @ Transform.identity(a.pos.dtype), a, 1e-13)
    moved = matrices(a) @ np.concatenate([points, np.ones((ROWS, 1))], axis=1)[..., None]
    assert_allclose(a.apply(jnp.asarray(points)), moved[:, :3, 0], atol=1e-14)


def test_a_place_rises_as_the_platform_that_carries_it():
    before = np.array([[0.3, 0.1, -0.2], [-0.4, 0.2, 0.5]])
    shift, up = np.array([0.2, 0.35, -0.1]), jnp.array([0.0, 1.0, 0.0])
    for angles in ([0, 0, 0], [20, -30, 15]):
        turn = Rotation.from_euler("xyz", angles, degrees=True)
        after = turn.apply(before) + shift
        carry = Transform(jnp.asarray(shift), jnp.asarray(turn.as_quat(scalar_first=True)))
        rise = rise_of(carry.repeat(2), jnp.asarray(after), up)
        assert_allclose(rise, (after - before)[:, 1], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rise_of(Still(), jnp.asarray(before), up), 0.0)


def test_forward_kinematics_multiplies_the_matrices_from_the_root_down_in_derivatives_too():
    for parents in (
        (-1, 0, 1, 2, 3, 4), (-1, 0, 0, 0, 0, 0), (-1, 0, 1, 0, 3, 1), (-1, -1, 0, 1, -1, 4)
    ):  # fmt: skip
        offsets, translated = RNG.normal(size=(2, 6, 3))
        offsets[RNG.integers(6)] = 0.0  # a bone of length zero
        rotations = unit(RNG.normal(size=(6, 4)))
        for positions, argument in ((offsets, None), (translated, jnp.asarray(translated))):
            local = matrices(Transform(jnp.asarray(positions), jnp.asarray(rotations)))
            expected = []
            for joint, parent in enumerate(parents):
                expected.append(local[joint] if parent < 0 else expected[parent] @ local[joint])
            world = pose(parents, offsets, rotations, argument)
            assert_allclose(matrices(world), expected, atol=1e-13, err_msg=str(parents))
    rotations = np.stack([quaternions(RNG) for _ in FORK], axis=1)
    assert_all_gradients_match(pose_of_fork, np.tile(OFFSETS[:3], (ROWS, 1, 1)), rotations)


def test_a_batch_of_poses_equals_single_poses_in_either_precision():
    rotations, positions = unit(RNG.normal(size=(2, 3, 3, 4))), RNG.normal(size=(2, 3, 3, 3))
    args = [jnp.asarray(x) for x in (OFFSETS[:3], rotations, positions)]

    def posed(offsets, rotations, positions):
        return pose((-1, 0, 1), offsets, rotations, positions)

    single = jax.vmap(jax.vmap(posed, (None, 0, 0)), (None, 0, 0))
    clip = jax.jit(posed)(*args)
    assert clip.pos.shape == (2, 3, 3, 3) and clip.rot.shape == (2, 3, 3, 4)
    assert_close(clip, jax.jit(single)(*args), 1e-14)
    for dtype in (jnp.float32, jnp.float64):
        leaves = jax.tree.leaves(jax.eval_shape(posed, *(x.astype(dtype) for x in args)))
        leaves += jax.tree.leaves(Transform.identity(dtype))
        assert {leaf.dtype for leaf in leaves} == {jnp.dtype(dtype)}


def test_a_skeleton_that_is_not_a_tree_is_refused_with_the_faulty_joint():
    for names, parents, offsets, message in (
        ("a", (-1, 0), 2, "1 names, 2 parents, 2 offsets"),
        ("ab", (-1, 0), 3, "2 names, 2 parents, 3 offsets"),
        ("ab", (1, -1), 2, r"joint 0 \(a\) has parent 1"),
        ("ab", (-1, 1), 2, r"joint 1 \(b\) has parent 1"),
        ("ab", (-1, -2), 2, r"joint 1 \(b\) has parent -2"),
    ):
        with pytest.raises(ValueError, match=message):
            Skeleton(jnp.zeros((offsets, 3)), tuple(names), parents)


def test_a_transformed_pose_keeps_its_bone_lengths():
    # Two hanging legs: thighs of 0.4 and 0.5 m, shins of 0.3 and 0.45 m.
    joints = np.zeros((4, 2, 3))
    joints[..., 1] = [[1.0, 1.1], [0.6, 0.6], [0.3, 0.15], [0.3, 0.15]]
    joints[3, :, 2] = 0.12
    rot = jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
    legs = LegPose(*(Transform(jnp.asarray(pos), rot) for pos in joints))
    by = jax.tree.map(lambda x: x[:, None], transforms())
    moved = legs.transformed(by)
    thigh, shin = bone_lengths(moved)
    assert_allclose(thigh, np.tile([0.4, 0.5], (ROWS, 1)), atol=1e-14)
    assert_allclose(shin, np.tile([0.3, 0.45], (ROWS, 1)), atol=1e-14)
    back = by.inverse().apply(moved.toe.pos)
    assert_allclose(back, np.tile(joints[3], (ROWS, 1, 1)), atol=1e-14)
    assert_allclose(moved.ankle.rot, np.repeat(by.rot, 2, axis=1), atol=1e-15)


def test_repeating_a_transform_adds_up_the_gradients_of_its_copies():
    transform = Transform(jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([0.5, 0.5, -0.5, 0.5]))
    copies = transform.repeat(3)
    assert_allclose(copies.pos, np.tile(transform.pos, (3, 1)), atol=0)
    assert_allclose(copies.rot, np.tile(transform.rot, (3, 1)), atol=0)
    weights = jnp.asarray([[1.0], [10.0], [100.0]])
    gradient = jax.grad(lambda transform: jnp.sum(weights * transform.repeat(3).pos))(transform)
    assert_allclose(gradient.pos, [111.0] * 3, atol=0)


PRESETS = ["record", "ozz", "unreal", "mec", "stride"]
SIZE = 1.3


class Kick(Rule):
    """A rule of a user's own."""

    reach: Leaf = length((0.1, 0.2), 0, 1, "How far it goes.")
    speed: Leaf = speed(1, 0, 4, "How fast it is.")
    pull: Leaf = parameter(8, 0, 20, "How hard it pulls.", unit="m/s²")
    pause: Leaf = duration(1, 0, 4, "How long.", follows="time")
    height: Leaf = length(0.115, 0, 0.4, "How high it is.", follows="over ankle height")
    free: Leaf = length(inf, 0, 1, "How far it may go.")
    angle: Leaf = angle(1, 0, 2, "How far it turns.")
    half_life: Leaf = half_life(0.1, "How smooth it is.")
    tick_hz: Leaf = constant(30, "Ticks per second.", unit="Hz")
    on: Leaf = switch(True, "Whether it does anything.")


def make_body(
    leg: Any = body.LEG, ankle: Any = body.ANKLE, ball: Any = body.BALL, foot: Any = None
) -> jaxik.Rig:
    """A rig with legs, ankles and balls of these lengths and heights, m; feet as long as legs."""
    rig = to_rig(make_rig())
    lengths = {"thigh": 0.5 * leg, "shin": 0.5 * leg, "ankle_height": ankle, "ball_height": ball}
    lengths["foot"] = body.FOOT * leg / body.LEG if foot is None else foot
    return dataclasses.replace(rig, **{k: v * jnp.ones(2) for k, v in lengths.items()})


def number(system: eqx.Module, name: str) -> jax.Array:
    return parameter_tree.get(system, name)


def values(system: eqx.Module) -> dict[str, np.ndarray]:
    return {name: np.asarray(number(system, name)) for name in parameter_tree.declarations(system)}


def ray_up(system: eqx.Module) -> jax.Array:
    return number(system, "probe.ray_up")


def test_numbers_and_ranges_of_any_rule_follow_what_they_declare():
    rig = make_body(4 * body.LEG, 0.3)
    kick = body.scale(Kick(), rig)
    np.testing.assert_allclose(kick.reach, [0.4, 0.8], rtol=1e-6)
    assert float(kick.speed) == pytest.approx(2.0) and float(kick.pause) == pytest.approx(2.0)
    assert float(kick.height) == pytest.approx(0.3 + 4 * 0.03)
    assert np.isinf(kick.free)
    assert float(kick.angle) == 1.0 and float(kick.half_life) == pytest.approx(0.1)
    declared = body.scaled_declarations(Kick(), rig)
    assert (declared["speed"].high, declared["angle"].high) == (8.0, 2.0)
    assert body.scaled_declarations(Kick(), None)["speed"].high == 4.0


def test_an_adult_has_the_numbers_of_a_preset_and_ranges_contain_those_of_any_body():
    bodies = make_body(2.1, 0.25, 0.14), make_body(0.46, 0.04, 0.02), make_body(0.84, 0.3)
    for preset in PRESETS:
        make = getattr(presets, preset)
        defaults, declared, adult = values(make()), parameter_tree.declarations(make()), make_body()
        for name, value in values(make(adult)).items():
            expected = body.ANKLE if name == "target.foot_height" else defaults[name]
            np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-7)
        for rig in bodies:
            ik = make(rig)
            ranges = body.scaled_declarations(ik, rig)
            for name, value in values(ik).items():
                low, high = ranges[name].low, ranges[name].high
                assert low < high, (preset, name)
                default, of_adult = defaults[name], declared[name]
                if (of_adult.low <= default).all() and (default <= of_adult.high).all():
                    assert (low <= value).all() and (value <= high).all(), (preset, name)


def test_no_number_of_a_preset_is_weakly_typed():
    """Programs would compile once more for the same system from a file."""
    for preset, rig in itertools.product(PRESETS, (None, make_body())):
        leaves = jax.tree.leaves(getattr(presets, preset)(rig))
        assert not any(leaf.weak_type for leaf in leaves), preset


def test_heights_of_soles_are_those_of_the_rig_and_over_them_follow_the_length_of_the_foot():
    rig = make_body(2.1, 0.31, 0.12)
    for name in ("record", "ozz", "mec", "stride"):
        ik = getattr(presets, name)(rig)
        assert float(number(ik, "target.foot_height")) == pytest.approx(0.31)
    assert float(number(presets.stride(rig), "probe.ball_height")) == pytest.approx(0.12)
    contact = body.scale(SpeedContact(), rig)
    assert float(contact.planted_height) == pytest.approx(0.12 + 2.5 * 0.02)
    # Within twice the length of the leg.
    for foot, ratio in ((0.18, 1.5), (0.06, 0.5), (0.5, 2.0), (0.0, 0.5)):
        rig = make_body(body.LEG, 0.1, 0.06, foot)
        planted = body.scale(HeightContact(), rig).planted_height
        assert float(planted) == pytest.approx(0.1 + ratio * 0.015)
        assert float(ray_up(presets.record(rig))) == pytest.approx(0.5)


def test_legs_share_a_number_unless_they_differ_noticeably_and_absent_ones_do_not_count():
    alike = presets.mec(make_body(jnp.array([0.80, 0.82])))
    assert ray_up(alike).shape == number(alike, "pelvis.max_length").shape == ()
    legs = np.array([0.8, 0.4])
    unlike = presets.mec(make_body(jnp.asarray(legs)))
    np.testing.assert_allclose(ray_up(unlike), legs * 0.5 / 0.84, rtol=1e-6)
    np.testing.assert_allclose(number(unlike, "pelvis.max_length"), legs)
    assert number(unlike, "root.ray_up").shape == ()  # of the whole body
    toe = number(presets.record(make_body(jnp.asarray(legs))), "probe.toe_ls")
    np.testing.assert_allclose(toe[0], 2.0 * toe[1], rtol=1e-6)
    for name in PRESETS:
        check_system(getattr(presets, name)(make_body(jnp.asarray(legs))), make_body())
    # Values per leg stay so.
    ik = parameter_tree.replace(presets.record(), {"probe.ray_up": [0.5, 0.6]})
    scaled = body.scale(ik, make_body(2 * body.LEG))
    np.testing.assert_allclose(ray_up(scaled), [1.0, 1.2], rtol=1e-6)
    for rig in (
        dataclasses.replace(make_body(jnp.array([1.68, 9.0])), present=jnp.array([True, False])),
        make_body(jnp.array([1.68, 0.0])),
    ):
        assert float(ray_up(presets.record(rig))) == pytest.approx(1.0)
        assert body.ratio(rig) == pytest.approx(2.0)
    assert body.ratio(make_body(0.0)) == 1.0
    rig = to_rig(make_rig(legs=3))
    lengths, present = jnp.array([1.0, 3.0, 9.0]) * body.LEG, jnp.array([True, True, False])
    rig = dataclasses.replace(rig, thigh=0.5 * lengths, shin=0.5 * lengths, present=present)
    assert body.ratio(rig) == pytest.approx(2.0)


def test_a_batch_of_bodies_has_the_numbers_of_each_alone():
    legs = jnp.array([[0.84, 0.84], [2.1, 2.1], [0.46, 0.8]])
    bodies = [make_body(leg) for leg in legs]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *bodies)

    def height(rig: jaxik.Rig) -> jax.Array:
        return ray_up(presets.record(rig))

    expected = [jnp.broadcast_to(height(rig), 2) for rig in bodies]
    for batched in (jax.jit(jax.vmap(height)), jax.jit(jaxik.lanes(height))):
        np.testing.assert_allclose(batched(batch), expected, rtol=1e-6)

    def ray_down(leg: jax.Array) -> jax.Array:
        return number(presets.ozz(make_body(leg)), "probe.ray_down")

    slopes = jax.jit(jax.jacobian(ray_down))(jnp.ones(2))
    assert np.isfinite(slopes).all()  # the ray is endless


def test_numbers_of_a_similar_body_change_by_their_units_and_nothing_else_does():
    powers = {
        "m": 1.0, "m/s": 0.5, "s": 0.5, "1/s": -0.5, "Hz": -0.5, "m/s²": 0.0, "m²": 2.0,
        "1/m": -1.0, "rad/s": -0.5, "rad": 0.0, "1": 0.0,
    }  # fmt: skip
    assert {name: exponent(name) for name in powers} == powers
    for name in ("kg", "m/kg", "m s", ""):
        with pytest.raises(ValueError, match=r"is not made of \['m', 's', 'Hz'"):
            exponent(name)
    for name in PRESETS:
        for slot in parameter_tree.slots(getattr(presets, name)()):
            exponent(slot.unit)
    larger = similar(Kick(), 4.0)
    np.testing.assert_allclose(larger.reach, [0.4, 0.8], rtol=1e-6)
    assert float(larger.tick_hz) == pytest.approx(15.0) and float(larger.angle) == 1.0
    assert float(larger.pull) == 8.0 and np.isinf(larger.free) and bool(larger.on)
    back = similar(larger, jnp.asarray(0.25))
    np.testing.assert_allclose(back.reach, Kick().reach, rtol=1e-6)
    slope = jax.jit(jax.grad(lambda r: jnp.sum(similar(Kick(), r).reach)))(jnp.asarray(1.0))
    assert float(slope) == pytest.approx(0.3, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_two_bodies_of_equal_shape_move_alike(name):
    """The larger one 1.3 times as far in the root of 1.3 times the time."""
    heights = 0.04 * np.random.default_rng(0).normal(size=(40, 40))
    walk = load_clip(ROOT / "data" / "clips" / "uneven_walk_base.npz")
    clip, run = edit.trim(walk, 0.0, 1.5), jax.jit(jaxik.run)

    def solve(ik: jaxik.FootIK, size: float) -> jaxik.Result:
        character = scaled(clip, size, froude=True)
        ground = terrain.heightfield(size * heights, size * 0.25, origin=(-5.0 * size, 0.0, -size))
        return run(ik, character.rig, ground, frames_from_clip(character))

    ik = getattr(presets, name)()
    small, large, unscaled = solve(ik, 1.0), solve(similar(ik, SIZE), SIZE), solve(ik, SIZE)

    def difference(result: jaxik.Result) -> float:  # m, of the small body
        legs = np.abs(result.pose.ankle.pos / SIZE - small.pose.ankle.pos).max()
        return float(max(legs, np.abs(result.body.pos / SIZE - small.body.pos).max()))

    # The probe of `stride` rounds distances of a micrometre, whatever the body. `mec`
    # magnifies rounding in legs whose targets are out of reach: 1e-15 of a height moves 5e-10 m.
    assert difference(large) < {"stride": 1e-5, "mec": 1e-6}.get(name, 1e-8)
    assert difference(unscaled) > 3e-3
    assert np.abs(small.body.pos).max() > 0.02, "there was something to do"
