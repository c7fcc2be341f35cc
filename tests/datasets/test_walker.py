"""The synthetic walk: still feet, constant bone lengths, and the effect of its events."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting.datasets import clip_frames
from fitting.datasets.clips import contacts, load_clip, save_clip
from fitting.datasets.clips.kinematics import local_from_world
from fitting.datasets.synthetic import gait, speed_profile, walker

FPS = 60.0
STRAIGHT = walker.WalkStyle(bend=0.0)
EXACT = 1e-9  # m
PENETRATION = 0.002  # m, of the heel in the last frames of a swing; 0 for standing feet


@pytest.fixture(scope="module", params=[0, 1, 2])
def clip(request):
    return walker.walk(12.0, FPS, request.param)


def stances(clip, leg):
    """First and last frame of each stance, whole ones only."""
    return [
        (first, last)
        for first, last in contacts.runs(clip.stance[:, leg])
        if first > 0 and last < clip.frame_count - 1
    ]


def heel(clip, leg):
    """The rear end of a sole, m."""
    ankle = clip.rig.joints[leg][2]
    rot = Rotation.from_quat(clip.rotations_ws[:, ankle], scalar_first=True)
    return clip.positions_ws[:, ankle] + rot.apply([0, -gait.ANKLE_HEIGHT, -gait.HEEL])


def test_the_ball_of_a_standing_foot_does_not_move(clip):
    balls_stand(clip, 9)


def balls_stand(clip, minimum):
    for leg, joints in enumerate(clip.rig.joints):
        assert len(stances(clip, leg)) >= minimum
        for first, last in stances(clip, leg):
            ball = clip.positions_ws[first : last + 1, joints[3]]
            assert np.ptp(ball, axis=0).max() < EXACT
            np.testing.assert_allclose(ball[:, 1], gait.BALL_HEIGHT, rtol=0, atol=EXACT)


def test_a_foot_rolls_over_its_heel_lies_flat_and_rises_about_its_ball(clip):
    for leg, joints in enumerate(clip.rig.joints):
        ankle = clip.positions_ws[:, joints[2]]
        rear = heel(clip, leg)
        for first, last in stances(clip, leg)[1:]:
            roll = slice(first - 6, first + 1)
            assert np.ptp(rear[roll], axis=0).max() < EXACT
            flat = slice(first, first + 16)
            np.testing.assert_allclose(ankle[flat, 1], gait.ANKLE_HEIGHT, rtol=0, atol=EXACT)
            assert ankle[last, 1] > gait.ANKLE_HEIGHT + 0.03


def test_no_foot_sinks_into_the_floor(clip):
    for leg, joints in enumerate(clip.rig.joints):
        assert clip.positions_ws[:, joints[3], 1].min() > gait.BALL_HEIGHT - EXACT
        assert heel(clip, leg)[:, 1].min() > -PENETRATION


def test_bones_keep_their_lengths_and_joints_are_rigid_on_their_parents(clip):
    rig = clip.rig
    for joints in rig.joints:
        positions = [clip.positions_ws[:, joint] for joint in joints]
        lengths = [
            np.linalg.norm(b - a, axis=-1) for a, b in zip(positions, positions[1:], strict=False)
        ]
        for length, expected in zip(lengths, (gait.THIGH, gait.SHIN, gait.FOOT), strict=True):
            np.testing.assert_allclose(length, expected, rtol=0, atol=EXACT)
    positions_ls, _ = local_from_world(clip.parents, clip.positions_ws, clip.rotations_ws)
    assert np.ptp(positions_ls[:, 1:], axis=0).max() < EXACT


def test_legs_are_recognised_with_flat_feet_and_forward_knees(clip):
    rig = clip.rig
    assert rig.names == ("left", "right")
    np.testing.assert_allclose(rig.knee_axis_ls, [[-1.0, 0.0, 0.0]] * 2, rtol=0, atol=0.02)
    np.testing.assert_allclose(rig.ankle_from_foot, [[1.0, 0.0, 0.0, 0.0]] * 2, rtol=0, atol=0.02)


def test_stride_cadence_and_pelvis_height_are_those_of_the_measured_walk():
    clip = walker.walk(12.6, FPS, style=walker.WalkStyle(bend=0.0, variation=0.0))
    pelvis = clip.positions_ws[:, 0]
    speed = gait.STRIDE / gait.PERIOD
    np.testing.assert_allclose(np.diff(pelvis[:, 2]), speed / FPS, rtol=0, atol=EXACT)
    again = round(gait.PERIOD * FPS)
    ahead = np.array([0.0, 0.0, gait.STRIDE])
    np.testing.assert_allclose(
        clip.positions_ws[again : 2 * again] + ahead,
        clip.positions_ws[2 * again : 3 * again],
        rtol=0,
        atol=EXACT,
    )
    assert abs(pelvis[:, 1].mean() - gait.HEIGHT[0]) < 0.03
    swing = clip.positions_ws[:, clip.rig.joints[0][2], 1].max()
    assert 0.2 < swing < 0.3


def test_motion_is_smooth_where_a_foot_lifts_off_and_lands(clip):
    joints = [joint for leg in clip.rig.joints for joint in leg[2:]]
    speeds = np.linalg.norm(np.diff(clip.positions_ws[:, joints], axis=0), axis=-1) * FPS
    assert speeds.max() < 6.0
    assert np.abs(np.diff(speeds, axis=0)).max() * FPS < 120.0


def test_the_seed_determines_the_walk():
    first, same, other = (walker.walk(3.0, FPS, seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.positions_ws, same.positions_ws)
    assert np.abs(first.positions_ws - other.positions_ws).max() > 0.01


def test_a_slip_moves_standing_feet_by_its_speed_change():
    change, start, end = 0.06, 2.0, 5.0
    slipping = walker.walk(
        8.0, FPS, events=[speed_profile.Slip(start, end, change)], style=STRAIGHT
    )
    still = walker.walk(8.0, FPS, style=STRAIGHT)
    moved = slipping.positions_ws - still.positions_ws
    np.testing.assert_allclose(moved, moved[:, :1] * np.ones((1, 9, 1)), rtol=0, atol=EXACT)
    assert np.abs(moved[: round(start * FPS)]).max() < EXACT
    full = (end - start - speed_profile.EASE) * change * gait.STRIDE / gait.PERIOD
    assert moved[-1, 0, 2] == pytest.approx(full, rel=0.01)


def test_a_slide_freezes_the_walk_on_both_feet_and_keeps_the_speed():
    clip = walker.walk(8.0, FPS, events=[speed_profile.Slide(3.0, 5.0)])
    assert clip.slide is not None
    np.testing.assert_array_equal(np.flatnonzero(clip.slide), np.arange(180, 300))
    frozen = slice(round(4.5 * FPS), round(4.85 * FPS))
    about = clip.positions_ws[frozen] - clip.positions_ws[frozen, :1]
    assert np.ptp(about, axis=0).max() < 1e-6
    for _, _, ankle, _ in clip.rig.joints:
        assert clip.positions_ws[frozen, ankle, 1].max() < gait.ANKLE_HEIGHT + 0.04
    travel = np.linalg.norm(np.diff(clip.positions_ws[:, 0, [0, 2]], axis=0), axis=-1) * FPS
    np.testing.assert_allclose(travel, gait.STRIDE / gait.PERIOD, rtol=0.01)


@pytest.fixture(scope="module")
def stopping():
    """A walk that stands from 2.5 s to 3.7 s and from 5.8 s to 7.2 s."""
    return walker.walk(
        9.0, FPS, 4, events=[speed_profile.Stop(1.6, 3.7), speed_profile.Stop(5.0, 7.2)]
    )


def test_in_a_stop_the_walk_stands_exactly_still_on_two_flat_feet(stopping):
    speed = np.asarray(clip_frames.frames_from_clip(stopping).speed)
    stands = contacts.runs(speed == 0.0)
    assert len(stands) == 2
    for (first, last), end in zip(stands, (3.7, 7.2), strict=True):
        assert 1.0 <= (last - first) / FPS <= 1.5
        assert last == pytest.approx(end * FPS, abs=2)
        still = slice(first + 3, last - 2)
        assert stopping.stance[still].all()
        assert all(len(contacts.runs(stopping.stance[first:last, leg])) == 1 for leg in (0, 1))
        for _, _, ankle, toe in stopping.rig.joints:
            for joint, height in ((ankle, gait.ANKLE_HEIGHT), (toe, gait.BALL_HEIGHT)):
                positions = stopping.positions_ws[still, joint]
                assert np.ptp(positions, axis=0).max() < 1e-6
                np.testing.assert_allclose(positions[:, 1], height, rtol=0, atol=1e-6)
    np.testing.assert_allclose(speed[-30:], gait.STRIDE / gait.PERIOD, rtol=0.02)


def test_the_front_foot_stays_flat_as_the_walk_resumes(stopping):
    for end in (3.7, 7.2):
        frame = round(end * FPS)
        ahead = int(np.argmax(stopping.joints_ws(3)[frame, :, 2]))
        gone_on = slice(frame, frame + round(0.4 * FPS))
        ankle = stopping.joints_ws(2)[gone_on, ahead]
        assert stopping.stance[gone_on, ahead].all()
        np.testing.assert_allclose(ankle[:, 1], gait.ANKLE_HEIGHT, rtol=0, atol=1e-6)


def test_the_pelvis_of_a_standing_body_only_moves_up_and_down(stopping):
    speed = np.asarray(clip_frames.frames_from_clip(stopping).speed)
    for first, last in contacts.runs(speed == 0.0):
        range_of = np.ptp(stopping.positions_ws[first : last + 1, 0], axis=0)
        assert range_of[0] == range_of[2] == 0.0
        assert 0.0005 < range_of[1] < 0.004


def test_a_walk_that_stops_is_as_exact_and_smooth_as_any_other(stopping):
    balls_stand(stopping, 3)
    test_bones_keep_their_lengths_and_joints_are_rigid_on_their_parents(stopping)
    test_motion_is_smooth_where_a_foot_lifts_off_and_lands(stopping)
    test_no_foot_sinks_into_the_floor(stopping)


def test_the_slide_is_stored_and_trimmed_with_the_clip_and_may_be_absent(tmp_path):
    clip = walker.walk(6.0, FPS, events=[speed_profile.Slide(3.0, 5.0)])
    save_clip(tmp_path / "walk.npz", clip)
    loaded, trimmed = load_clip(tmp_path / "walk.npz"), clip.select(slice(0, 200))
    assert clip.slide is not None and loaded.slide is not None and trimmed.slide is not None
    np.testing.assert_array_equal(loaded.slide, clip.slide)
    assert trimmed.slide.sum() == 20
    assert walker.walk(1.0, FPS).slide is None


@pytest.mark.parametrize(
    "options, message",
    [
        ({"seconds": 0.0}, "above 0, got 0.0 s"),
        ({"fps": -60.0}, "-60.0 fps"),
        ({"events": [speed_profile.Slip(1.0, 9.0, 0.1)]}, r"Slip\(start=1.0, end=9.0.*5.0 s"),
        ({"events": [speed_profile.Slide(3.0, 2.0)]}, r"Slide\(start=3.0, end=2.0\)"),
        ({"events": [speed_profile.Stop(-1.0, 2.0)]}, r"Stop\(start=-1.0, end=2.0\)"),
    ],
)
def test_impossible_walks_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        walker.walk(**{"seconds": 5.0, **options})


def test_a_walk_and_its_standing_feet_face_along_its_path():
    clip = walker.walk(12.0, FPS, style=walker.WalkStyle(bend=0.6))
    pelvis_ws = clip.positions_ws[:, clip.rig.pelvis]
    travel = np.gradient(pelvis_ws[:, [0, 2]], axis=0)
    yaw = np.arctan2(travel[:, 0], travel[:, 1])
    assert yaw.min() < -0.3 and yaw.max() > 0.3, "the path is too straight to tell"
    facing = Rotation.from_quat(clip.rotations_ws[:, clip.rig.pelvis], scalar_first=True)
    ahead = facing.apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(np.arctan2(ahead[:, 0], ahead[:, 2])[1:-1], yaw[1:-1], atol=1e-4)

    for leg, joints in enumerate(clip.rig.joints):
        foot = clip.positions_ws[:, joints[3]] - clip.positions_ws[:, joints[2]]
        foot_yaw = np.arctan2(foot[:, 0], foot[:, 2])
        rot = Rotation.from_quat(clip.rotations_ws[:, joints[2]], scalar_first=True)
        left = rot.apply([1.0, 0.0, 0.0])
        turned = np.arctan2(-left[:, 2], left[:, 0])
        for first, last in stances(clip, leg):
            ball = clip.positions_ws[first, joints[3]]
            nearest = np.argmin(np.linalg.norm((pelvis_ws - ball)[:, [0, 2]], axis=-1))
            np.testing.assert_allclose(foot_yaw[first:last], yaw[nearest], atol=0.01)
            np.testing.assert_allclose(turned[first:last], foot_yaw[first:last], atol=1e-9)
        np.testing.assert_allclose(left[:, 1], 0.0, atol=1e-9)
        assert np.abs(np.diff(turned)).max() < 0.05, "a foot turns with a jerk"
