"""Properties of the other systems: symmetries, ups of legs, padding, batches, dtypes, programs."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_properties import (
    EXACT,
    JOINTS,
    assert_same_pose,
    assert_same_rot,
    assert_same_transform,
    doubles,
    moved_frames,
    moved_ground,
    single,
    some_move,
    wander,
)

import jaxik
from jaxik import HARD, Smooth
from jaxik.maths import parameter_tree
from jaxik.world import terrain
from support.cases import QUICK, RIG
from support.clips import BROKEN, assert_close, at, planes, to_ik, to_rig, to_terrain, to_transform
from support.padding import three_legged

pytestmark = pytest.mark.slow

PRESETS = ("ozz", "unreal", "mec", "stride", "by speed")
AWAKE: dict[str, dict[str, Any]] = {  # rules that act throughout the clip
    "ozz": {"root.enabled": False},
    "unreal": {"contact.idle_speed": 2.0, "effector.latch": False},
    "mec": {"probe.by_height": False},
    "stride": {"lock.enabled": True},
    "by speed": {"lock.enabled": True, "contact.half_life": 0.05, "pelvis.spring": True},
}
BAD = slice(40, 50)  # frames

quick = functools.partial(jax.jit, compiler_options=QUICK)
run = quick(jaxik.run)
crowd_run = quick(jax.vmap(jaxik.run))


def inputs(preset: str) -> tuple[jaxik.FootIK, jaxik.Rig, Any, jaxik.Frame]:
    return to_ik(AWAKE[preset], preset), to_rig(RIG), to_terrain(BROKEN), wander()


@functools.cache
def alone(preset: str) -> jaxik.Result:
    return run(*inputs(preset))


def crowd(preset: str, spoiled: bool = False) -> tuple[Any, ...]:
    """The character with a padding leg, itself in a moved world, and one with other parameters."""
    ik, rig, ground, frames = inputs(preset)
    by = some_move("turned, up too")
    rig, frames = three_legged(rig, frames)
    bad = frames.pose.ankle.pos.at[BAD, 0].set(jnp.nan)
    third = eqx.tree_at(lambda f: f.pose.ankle.pos, frames, bad) if spoiled else frames
    members = (
        (ik, rig, ground, frames),
        (ik, rig, to_terrain(moved_ground(BROKEN, by)), moved_frames(frames, to_transform(by))),
        (
            parameter_tree.replace(ik, {"leg.twist": 0.2, "leg.soften": 0.9}),
            rig,
            to_terrain(planes((0.1, 0.2, 0.05))),
            third,
        ),
    )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


@functools.cache
def crowded(preset: str) -> jaxik.Result:
    return crowd_run(*crowd(preset))


def two_legs(result: jaxik.Result, member: int) -> jaxik.Result:
    """The result of one member, with its first two legs."""
    result = at(result, member)
    pose = at(result.pose, (slice(None), slice(2)))
    return dataclasses.replace(result, pose=pose)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_clip_exercises_the_system(preset: str):
    result = alone(preset)
    assert np.asarray(result.trace.sensed.foothold.found).mean() > 0.2
    moved = np.asarray(result.pose.ankle.pos - wander().pose.ankle.pos)
    assert np.abs(moved).max() > 0.05


@pytest.mark.parametrize("preset", PRESETS[:-1])
def test_a_batch_equals_the_loop_and_padded_legs_change_nothing(preset: str):
    together = two_legs(crowded(preset), 0)
    assert_same_pose(together.pose, alone(preset).pose)
    assert_same_transform(together.body, alone(preset).body)
    for name in ("reached", "aimed"):
        ours = np.asarray(getattr(together, name))[:, :2]
        np.testing.assert_array_equal(ours, getattr(alone(preset), name))


@pytest.mark.parametrize("preset", PRESETS)
def test_moving_the_world_moves_the_result(preset: str):
    before, after = (two_legs(crowded(preset), member) for member in range(2))
    # Mec stretches legs fully, where the knee turns as the root of the distance: so does the
    # rounding.
    tolerance = 1e-7 if preset == "mec" else EXACT
    assert_same_pose(after.pose, before.pose, tolerance)
    assert_same_transform(after.body, before.body)
    for joint in ("hip", "knee", "ankle"):
        actual, expected = (getattr(r.corrections, joint) for r in (after, before))
        assert_same_rot(actual[:, :2], expected[:, :2], tolerance)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_bad_member_does_not_affect_the_others_of_a_batch(preset: str):
    for leaf in jax.tree.leaves(crowded(preset)):
        assert not np.isnan(leaf).any()
    result = crowd_run(*crowd(preset, spoiled=True))
    assert result.faulty[2].any() and np.isfinite(result.pose.ankle.pos).all()
    for member in (0, 1):
        assert_close(at(result, member), at(crowded(preset), member), 0.0)


@pytest.mark.parametrize("preset", PRESETS)
def test_other_values_need_no_new_program(preset: str):
    crowded(preset)
    programs = crowd_run._cache_size()  # pyright: ignore[reportAttributeAccessIssue]
    ik, rig, ground, frames = crowd(preset)
    ik = jax.tree.map(lambda leaf: ~leaf if leaf.dtype == bool else leaf, ik)
    crowd_run(
        parameter_tree.replace(ik, {"leg.twist": jnp.array([0.1, 0.2, 0.3])}), rig, ground, frames
    )
    assert crowd_run._cache_size() == programs  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("preset", PRESETS[:-1])
def test_legs_with_the_same_up_find_the_same_ground(preset: str):
    ik, rig, ground, frames = inputs(preset)
    each = run(ik, rig, terrain.LegTerrains(ground, (ground, ground)), frames)
    np.testing.assert_allclose(each.trace.sensed.leg_up_ws[:, 1], ground.up_ws[None].repeat(240, 0))
    for actual, expected in ((each.pose, alone(preset).pose), (each.body, alone(preset).body)):
        assert_close(actual, expected, 1e-12)


@pytest.mark.parametrize("preset", PRESETS[:-1])
def test_equal_values_per_leg_act_like_a_shared_value(preset: str):
    ik, rig, ground, frames = inputs(preset)

    def widened(name: str) -> jax.Array:
        leaf = parameter_tree.get(ik, name)
        return jnp.broadcast_to(leaf, (2, *leaf.shape))

    def may_be_per_leg(name: str) -> bool:
        if name in ("pelvis.min_length", "pelvis.max_length", "pelvis.extension"):
            return True
        one_for_all = name in ("effector.latch", "lock.hold_ball")
        return not one_for_all and not name.startswith(("root.", "lean.", "separation.", "pelvis."))

    names = [slot.name for slot in parameter_tree.slots(ik)]
    values = {name: widened(name) for name in filter(may_be_per_leg, names)}
    result = run(parameter_tree.replace(ik, values), rig, ground, frames)
    assert_same_pose(result.pose, alone(preset).pose)


@pytest.mark.parametrize("preset", PRESETS)
def test_single_precision_stays_within_a_tenth_of_a_millimetre_of_double(preset: str):
    result = run(*single(inputs(preset)))
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        floating = jnp.issubdtype(leaf.dtype, jnp.floating)
        assert not floating or leaf.dtype == jnp.float32, jax.tree_util.keystr(path)
    for joint in JOINTS:
        actual, expected = (getattr(r.pose, joint) for r in (result, alone(preset)))
        np.testing.assert_allclose(actual.pos, expected.pos, rtol=0, atol=1e-4)
        assert_same_rot(actual.rot, expected.rot, 1e-3)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("gate", [HARD, Smooth(1.0)], ids=["hard", "smooth"])
def test_a_single_precision_program_contains_no_doubles(preset: str, gate: Any):
    with jax.numpy_dtype_promotion("strict"):
        program = jax.make_jaxpr(jaxik.run)(*single(inputs(preset)), single(gate))
    assert not list(doubles(program.jaxpr))
