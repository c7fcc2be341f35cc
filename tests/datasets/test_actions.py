"""The synthetic run, jump, crouch and turn: still feet, true labels, bodies that fall freely."""

import numpy as np
import pytest

from fitting.datasets.clips import contacts
from fitting.datasets.synthetic import actions, gait

FPS = 60.0
EXACT = 1e-9  # m
ACTIONS = {"run": actions.run, "jump": actions.jump, "crouch": actions.crouch, "turn": actions.turn}


@pytest.fixture(scope="module", params=ACTIONS)
def clip(request):
    return ACTIONS[request.param](4.0, FPS)


def test_the_ball_of_a_standing_foot_does_not_move(clip):
    for leg, ball in enumerate(np.moveaxis(clip.joints_ws(3), 1, 0)):
        stances = contacts.runs(clip.stance[:, leg])
        assert stances
        for first, last in stances:
            assert np.ptp(ball[first : last + 1], axis=0).max() < EXACT
            np.testing.assert_allclose(ball[first : last + 1, 1], gait.BALL_HEIGHT, atol=EXACT)


def test_a_foot_without_a_label_is_on_its_way(clip):
    balls = clip.joints_ws(3)
    moving = ~(clip.stance[1:-1] | clip.stance[:-2] | clip.stance[2:])
    speeds = np.linalg.norm(np.diff(balls, axis=0), axis=-1)[1:] * FPS
    assert (speeds[moving] > 0.02).all()


def test_no_foot_is_below_the_floor(clip):
    assert clip.joints_ws(3)[..., 1].min() > gait.BALL_HEIGHT - EXACT
    assert clip.joints_ws(2)[..., 1].min() > gait.ANKLE_HEIGHT - 1e-6


def test_bones_keep_their_lengths_and_knees_point_forward(clip):
    hip, knee, ankle, ball = (clip.joints_ws(role) for role in range(4))
    for upper, lower, length in ((hip, knee, gait.THIGH), (knee, ankle, gait.SHIN)):
        np.testing.assert_allclose(np.linalg.norm(upper - lower, axis=-1), length, atol=EXACT)
    np.testing.assert_allclose(np.linalg.norm(ball - ankle, axis=-1), gait.FOOT, atol=EXACT)
    left = clip.left_ws()[:, None]
    forward = np.cross(left, [0.0, 1.0, 0.0])
    bent = np.sum((knee - (hip + ankle) / 2) * forward, axis=-1)
    assert (bent > 0.0).all()


def test_the_motion_is_smooth(clip):
    joints = [clip.rig.pelvis, *(joint for leg in clip.rig.joints for joint in leg[1:])]
    speeds = np.diff(clip.positions_ws[:, joints], axis=0) * FPS
    changes = np.linalg.norm(np.diff(speeds, axis=0), axis=-1) * FPS
    assert changes.max() < 150.0  # m/s²; a foot that pops by 2 cm has 1200


def test_a_body_falls_freely_in_the_middle_of_a_flight():
    clip = actions.jump(4.0, FPS)
    flying = ~clip.stance.any(axis=1)
    middle = flying & np.roll(flying, 8) & np.roll(flying, -8)
    height = clip.positions_ws[:, clip.rig.pelvis, 1]
    fall = np.diff(height, n=2) * FPS**2
    np.testing.assert_allclose(fall[middle[1:-1]], -actions.GRAVITY, rtol=0.02)
    assert middle.sum() > 5


def test_a_run_has_moments_without_contact_and_never_two_feet_down():
    stance = actions.run(4.0, FPS).stance
    assert 0.2 < np.mean(~stance.any(axis=1)) < 0.4 and not stance.all(axis=1).any()


def test_a_turn_turns_and_a_crouch_goes_down_and_up():
    turned = np.unwrap(
        2 * np.arctan2(*np.moveaxis(actions.turn(4.0, FPS).rotations_ws[:, 0, [2, 0]], -1, 0))
    )
    assert turned[-1] - turned[0] > np.radians(150.0)
    height = actions.crouch(4.0, FPS).positions_ws[:, 0, 1]
    assert height[0] == pytest.approx(height[-1]) == pytest.approx(height.min() + actions.DEPTH)
