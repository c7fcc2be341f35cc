"""Clips as frames of the pipeline, and its results as clips."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.datasets import clip_frames
from fitting.datasets.clips import contacts
from fitting.datasets.synthetic import gait, speed_profile, walker
from jaxik.maths import parameter_tree
from jaxik.world import terrain

FPS = 60.0
SLOPE = 0.15  # rise per metre of z


@pytest.fixture(scope="module")
def clip():
    return walker.walk(2.0, FPS, events=[speed_profile.Slide(1.0, 1.5)])


@pytest.fixture(scope="module")
def result(clip):
    ground = terrain.plane(normal=(0.0, 1.0, -SLOPE))
    ik = parameter_tree.replace(jaxik.presets.record(), {"lean.forward_rate": 0.5})
    return jaxik.run(ik, clip.rig, ground, clip_frames.frames_from_clip(clip))


def test_frames_hold_the_clip_in_model_space_over_the_floor(clip):
    made = clip_frames.frames_from_clip(clip, floor=-0.1)
    pose = made.pose
    for role, joint in enumerate((pose.hip, pose.knee, pose.ankle, pose.toe)):
        back = made.world_from_model
        for leg in range(2):
            placed = Rotation.from_quat(np.array(back.rot), scalar_first=True).apply(
                np.array(joint.pos[:, leg])
            )
            np.testing.assert_allclose(
                placed + back.pos, clip.joints_ws(role)[:, leg], rtol=0, atol=1e-9
            )
    assert float(pose.ankle.pos[..., 1].min()) == pytest.approx(gait.ANKLE_HEIGHT + 0.1)
    assert made.weight.shape == (clip.frame_count, 2)
    np.testing.assert_allclose(made.dt, 1 / FPS)
    np.testing.assert_array_equal(made.slide, clip.slide)
    np.testing.assert_allclose(made.speed, gait.STRIDE / gait.PERIOD, rtol=0.02)


def test_a_single_frame_stands_and_does_not_slide(clip):
    made = clip_frames.frames_from_clip(dataclasses.replace(clip, slide=None).select(slice(0, 1)))
    np.testing.assert_array_equal(made.speed, [0.0])
    np.testing.assert_array_equal(made.slide, [0.0])


def test_the_solved_clip_has_the_solved_legs_and_carries_the_rest_with_the_body(clip, result):
    solved = clip_frames.clip_from_result(clip, result)
    world = clip.world_from_model()
    for leg, joints in enumerate(clip.rig.joints):
        parts = (result.pose.hip, result.pose.knee, result.pose.ankle, result.pose.toe)
        for joint, part in zip(joints, parts, strict=True):
            for frame in (0, 40, 119):
                turn = Rotation.from_quat(np.array(world.rot[frame]), scalar_first=True)
                place = turn.apply(np.array(part.pos[frame, leg])) + world.pos[frame]
                np.testing.assert_allclose(solved.positions_ws[frame, joint], place, atol=1e-9)
    before = clip.positions_ws[:, 1] - clip.positions_ws[:, 0]
    after = solved.positions_ws[:, 1] - solved.positions_ws[:, 0]
    lengths = np.linalg.norm(before, axis=-1), np.linalg.norm(after, axis=-1)
    np.testing.assert_allclose(*lengths, rtol=0, atol=1e-9)
    tilt = Rotation.from_quat(solved.rotations_ws[100, 0], scalar_first=True).magnitude()
    assert tilt > 0.03
    assert solved.rig.joints == clip.rig.joints


def test_joints_above_the_pelvis_and_below_a_foot_keep_their_places_on_their_parents(clip, result):
    turned = Rotation.from_quat(clip.rotations_ws[:, 4], scalar_first=True)
    tip = clip.positions_ws[:, 4] + turned.apply([0.01, -0.02, 0.05])
    head = clip.positions_ws[:, 0] + [0.0, 0.6, 0.0]
    longer = dataclasses.replace(
        clip,
        joint_names=(*clip.joint_names, "tip", "head"),
        parents=(*clip.parents, 4, 0),
        offsets_ls=np.concatenate([clip.offsets_ls, [[0.01, -0.02, 0.05], [0.0, 0.6, 0.0]]]),
        positions_ws=np.concatenate(
            [clip.positions_ws, np.stack([tip, head], axis=1)], axis=1
        ),
        rotations_ws=np.concatenate(
            [clip.rotations_ws, clip.rotations_ws[:, [4, 0]]], axis=1
        ),
    )  # fmt: skip
    solved = clip_frames.clip_from_result(longer, result)
    for joint, parent, offset in ((9, 4, [0.01, -0.02, 0.05]), (10, 0, [0.0, 0.6, 0.0])):
        holder = Rotation.from_quat(solved.rotations_ws[:, parent], scalar_first=True)
        hung = solved.positions_ws[:, parent] + holder.apply(offset)
        np.testing.assert_allclose(solved.positions_ws[:, joint], hung, rtol=0, atol=1e-9)
        same = np.abs(np.sum(solved.rotations_ws[:, joint] * solved.rotations_ws[:, parent], -1))
        np.testing.assert_allclose(same, 1.0, atol=1e-12)


def test_on_flat_ground_the_solved_clip_is_the_clip_away_from_its_limits(clip):
    quiet = {"lock.enabled": jnp.array(False), "leg.max_knee_angle": 3.1415, "leg.soften": 1.0}
    ik = parameter_tree.replace(jaxik.presets.record(), quiet)
    result = jaxik.run(ik, clip.rig, terrain.plane(), clip_frames.frames_from_clip(clip))
    solved = clip_frames.clip_from_result(clip, result)
    np.testing.assert_allclose(solved.positions_ws, clip.positions_ws, rtol=0, atol=1e-4)
    same = np.abs(np.sum(solved.rotations_ws * clip.rotations_ws, axis=-1))
    assert same.min() > np.cos(0.5e-3)


def test_strides_lead_from_stance_to_stance(clip):
    made, stance = clip_frames.frames_from_clip(clip).stride, clip.stance_labels()
    np.testing.assert_array_equal(made.standing, stance)
    np.testing.assert_array_equal(made.known, 1.0)
    balls = clip.joints_ws(3)
    for leg in range(2):
        spells = contacts.runs(stance[:, leg])
        middles = [np.median(balls[a : b + 1, leg], axis=0) for a, b in spells]
        for (first, last), (then, _), here, there in zip(
            spells, spells[1:], middles, middles[1:], strict=False
        ):
            np.testing.assert_array_equal(made.last_ws[first:then, leg], [here] * (then - first))
            np.testing.assert_array_equal(made.next_ws[first:then, leg], [there] * (then - first))
            np.testing.assert_array_equal(made.fraction[first : last + 1, leg], 0.0)
            np.testing.assert_allclose(
                np.diff(made.fraction[last:then, leg]), 1 / (then - last), rtol=1e-9
            )


def test_a_foot_that_never_stands_knows_no_stride(clip):
    stance = clip.stance_labels().copy()
    stance[:, 1] = False
    made = clip_frames.frames_from_clip(dataclasses.replace(clip, stance=stance)).stride
    np.testing.assert_array_equal(made.known, np.broadcast_to([1.0, 0.0], stance.shape))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(made))


def test_toes_are_as_fast_as_they_move(clip):
    made = clip_frames.frames_from_clip(clip)
    steps = np.linalg.norm(np.diff(clip.joints_ws(3), axis=0), axis=-1) * FPS
    np.testing.assert_allclose(made.toe_speed[1:], steps, rtol=1e-9)
