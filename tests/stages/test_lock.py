"""Foot locks: nothing jumps, and a moving platform carries locked feet."""

import dataclasses
import functools

import numpy as np
import pytest

import jaxik
from reference import maths, sample_poses
from reference.systems import record as reference
from support.clips import FLAT, animate, make_rig, stepping, to_frames, to_ik, to_rig, to_terrain

RIG = make_rig()
FIRM = {  # locked at once, and until the foot is lifted
    "lock.lock_half_life": 0.0,
    "lock.release_distance": 9.0,
    "lock.release_cone": 1.5,
    "lock.release_max_angle": np.pi,
    "lock.release_min_angle": 0.0,
}
HORIZONTAL = np.array([1.0, 0.0, 1.0])


GROUND = to_terrain(dataclasses.replace(FLAT, platform=0))


def run(values: dict, frames: list) -> jaxik.Result:
    """On a platform, which all frames have."""
    return jaxik.run(to_ik(values), to_rig(RIG), GROUND, to_frames(frames))


def slips(drift: float = 0.15) -> list:
    """A walk whose standing feet slip over the ground, by this speed, m/s."""
    return stepping(RIG, drift=drift, platform=lambda time: sample_poses.STILL)


@functools.cache
def slipping() -> jaxik.Result:
    return run({}, slips())


def tracks(result: jaxik.Result) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Targets, footholds and unlocked targets (frames, legs, 3), m, and locked (frames, legs)."""
    advanced, sensed = result.trace.advanced, result.trace.sensed
    unlocked = advanced.foothold_ws + sensed.contact.lift[..., None] * sensed.up_ws[:, None]
    target_ws, locked = advanced.effector.target_ws, advanced.state.lock.locked > 0
    tracks = (target_ws, advanced.foothold_ws, unlocked, locked)
    return tuple(map(np.asarray, tracks))  # type: ignore[return-value]


@pytest.mark.slow
def test_nothing_jumps_at_lock_or_release():
    targets, footholds, unlocked, locked = tracks(slipping())
    offset = np.linalg.norm(targets - unlocked, axis=-1)
    assert (np.diff(locked.astype(int), axis=0) == 1).any(axis=0).all()
    assert (np.diff(locked.astype(int), axis=0) == -1).any(axis=0).all()
    assert offset.max() > 0.04, "without decay a release would jump by this much"

    # A lock changes the second difference by at most the slip of a frame that it cancels or
    # restores, twice, plus the part of the offset that decays in a frame.
    added = np.linalg.norm(np.diff(targets - unlocked, 2, axis=0), axis=-1)
    slip = np.linalg.norm(np.diff(footholds, axis=0), axis=-1)[locked[1:]].max()
    decay = 1.0 - 2.0 ** -(1 / 60 / 0.10)  # at the default half-life
    assert added.max() <= 2 * slip + decay * offset.max()
    assert added.max() < 0.01

    # A lock never speeds a foot up by more than the decay of its offset.
    move, animated = (np.linalg.norm(np.diff(x, axis=0), axis=-1) for x in (targets, unlocked))
    assert (move <= animated + decay * offset[:-1] + 1e-12).all()


@pytest.mark.slow
def test_a_locked_foot_slips_less_and_lifts_as_animated():
    targets, footholds, unlocked, locked = tracks(slipping())
    locked_twice = locked[1:] & locked[:-1]
    slip = np.linalg.norm(np.diff(targets * HORIZONTAL, axis=0), axis=-1)[locked_twice]
    animated = np.linalg.norm(np.diff(unlocked * HORIZONTAL, axis=0), axis=-1)[locked_twice]
    assert slip.mean() < 0.3 * animated.mean()
    np.testing.assert_allclose(targets[..., 1], unlocked[..., 1], atol=1e-12)


def test_a_foot_locked_firmly_does_not_move_at_all():
    result = run(FIRM, slips())
    targets, _, _, locked = tracks(result)
    locked_twice = locked[1:] & locked[:-1]
    assert locked_twice.mean() > 0.3
    assert np.abs(np.diff(targets * HORIZONTAL, axis=0))[locked_twice].max() < 1e-12


def carousel(time: float) -> reference.Transform:
    """A platform that moves away and turns about its own centre, 0.4 m beside the feet."""
    pos = np.array([0.4 + 0.05 * time, 0.0, -0.1 + 0.04 * time])
    return reference.Transform(pos, maths.from_axis_angle(maths.Y, 1.0 + 0.1 * time))


@pytest.mark.parametrize("root", ["stands", "rides"])
def test_a_locked_foot_stays_on_a_platform_that_moves_and_turns(root):
    start = carousel(0.0)

    def place(time: float) -> np.ndarray:
        if root == "stands":
            return np.zeros(3)
        return maths.apply(carousel(time), maths.unapply(start, np.zeros(3)))

    result = run(FIRM, animate(RIG, platform=carousel, place=place))
    targets, footholds, _, locked = tracks(result)
    assert locked.all()
    on_platform = np.array(
        [
            [maths.unapply(carousel(index / 60), target) for target in frame]
            for index, frame in enumerate(targets)
        ]
    )
    assert np.linalg.norm(targets[-1] - targets[0], axis=-1).min() > 0.1
    assert np.abs(on_platform - on_platform[0]).max() < 1e-9
    if root == "rides":
        assert np.abs(targets - footholds).max() > 0.01, (
            "a root that rides along does not turn with the platform"
        )
    reached = np.asarray(result.reached) > 0
    assert reached.mean() > 0.5, "the platform carries the feet of a standing root out of reach"
    ankles = (
        np.asarray(result.pose.ankle.pos) + np.array([place(i / 60) for i in range(240)])[:, None]
    )
    np.testing.assert_allclose(ankles[reached], targets[reached], atol=1e-9)


def test_a_lock_lets_go_in_the_frame_in_which_its_knee_would_open_too_far():
    max_angle = 2.5
    result = run(FIRM | {"lock.release_max_angle": max_angle}, slips(0.6))
    targets, _, unlocked, locked = tracks(result)
    assert result.trace is not None
    sensed = result.trace.sensed
    kept = np.stack([targets[:-1, :, 0], unlocked[1:, :, 1], targets[:-1, :, 2]], axis=-1)
    span = np.linalg.norm(kept - np.asarray(sensed.hip_ws)[1:], axis=-1)
    thigh, shin = np.asarray(sensed.thigh)[1:], np.asarray(sensed.shin)[1:]
    angle = np.arccos(np.clip((thigh**2 + shin**2 - span**2) / (2 * thigh * shin), -1.0, 1.0))
    held = locked[:-1] & ~(np.asarray(sensed.contact.lifted)[1:] > 0)
    lets_go = held & ~locked[1:]
    assert lets_go.sum() > 2 and (held & locked[1:]).sum() > 20
    np.testing.assert_array_equal(angle[held] > max_angle, lets_go[held])
