"""Feet that keep their place: nothing pops, and a moving platform carries them."""

import functools

import numpy as np
import pytest

import jaxik
from reference import maths
from reference.systems import record as reference
from support.clips import FLAT, animate, make_rig, stepping, to_frames, to_ik, to_rig, to_terrain

RIG = make_rig()
FIRM = {  # holds at once, and until the foot is lifted
    "lock.lock_half_life": 0.0,
    "lock.release_distance": 9.0,
    "lock.release_cone": 1.5,
    "lock.release_max_angle": np.pi,
    "lock.release_min_angle": 0.0,
}


def run(values: dict, frames: list) -> jaxik.Result:
    return jaxik.run(to_ik(values), to_rig(RIG), to_terrain(FLAT), to_frames(frames))


@functools.cache
def slipping() -> jaxik.Result:
    """A walk whose feet slip over the ground while they stand."""
    return run({}, stepping(RIG, drift=0.15))


def tracks(result: jaxik.Result) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Targets, footholds and unlocked targets (frames, legs, 3), m, and locked (frames, legs)."""
    advanced, sensed = result.trace.advanced, result.trace.sensed
    unlocked = advanced.foothold_ws + sensed.contact.lift[..., None] * sensed.up_ws[:, None]
    tracks = (
        advanced.effector.target_ws,
        advanced.foothold_ws,
        unlocked,
        advanced.state.lock.locked > 0,
    )
    return tuple(map(np.asarray, tracks))  # type: ignore[return-value]


def test_nothing_pops_at_lock_or_release():
    targets, footholds, unlocked, locked = tracks(slipping())
    offset = np.linalg.norm(targets - unlocked, axis=-1)
    assert (np.diff(locked.astype(int), axis=0) == 1).any(axis=0).all()
    assert (np.diff(locked.astype(int), axis=0) == -1).any(axis=0).all()
    assert offset.max() > 0.04, "an anchor that is let go would pop by this"

    # The lock adds to the second difference no more than the slip of a frame that it takes away or
    # gives back, twice, and the share of the offset that decays in a frame.
    added = np.linalg.norm(np.diff(targets - unlocked, 2, axis=0), axis=-1)
    slip = np.linalg.norm(np.diff(footholds, axis=0), axis=-1)[locked[1:]].max()
    decay = 1.0 - 2.0 ** -(1 / 60 / 0.10)  # at the default half-life
    assert added.max() <= 2 * slip + decay * offset.max()
    assert added.max() < 0.01

    # Nor does it ever hurry a foot: a frame's move is the animation's, and the decay.
    move, animated = (np.linalg.norm(np.diff(x, axis=0), axis=-1) for x in (targets, unlocked))
    assert (move <= animated + decay * offset[:-1] + 1e-12).all()


def test_a_locked_foot_slips_less_and_lifts_as_animated():
    targets, footholds, unlocked, locked = tracks(slipping())
    held = locked[1:] & locked[:-1]
    flat = np.array([1.0, 0.0, 1.0])
    slip = np.linalg.norm(np.diff(targets * flat, axis=0), axis=-1)[held]
    animated = np.linalg.norm(np.diff(unlocked * flat, axis=0), axis=-1)[held]
    assert slip.mean() < 0.3 * animated.mean()
    np.testing.assert_allclose(targets[..., 1], unlocked[..., 1], atol=1e-12)


def test_a_foot_locked_firmly_does_not_move_at_all():
    result = run(FIRM, stepping(RIG, drift=0.15))
    targets, _, _, locked = tracks(result)
    flat = np.array([1.0, 0.0, 1.0])
    held = locked[1:] & locked[:-1]
    assert held.mean() > 0.3
    assert np.abs(np.diff(targets * flat, axis=0))[held].max() < 1e-12


def carousel(time: float) -> reference.Transform:
    """A platform that drives off and turns about its own middle, 0.4 m beside the feet."""
    pos = np.array([0.4 + 0.05 * time, 0.3, -0.1 + 0.04 * time])
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
        assert np.abs(targets - footholds).max() > 0.01, "a root that rides does not turn with it"
    reached = np.asarray(result.reached) > 0
    assert reached.mean() > 0.5, "the platform carries the feet of a root that stands out of reach"
    ankles = (
        np.asarray(result.pose.ankle.pos) + np.array([place(i / 60) for i in range(240)])[:, None]
    )
    np.testing.assert_allclose(ankles[reached], targets[reached], atol=1e-9)
