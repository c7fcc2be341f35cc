"""Standing feet on the floor on which they were animated: what locks may change, and what not."""

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets import clip_frames
from fitting.datasets.clips import Clip, contacts, load_clip
from fitting.datasets.clips.edit import drop_t_pose, resample
from jaxik.maths import quat
from jaxik.world import terrain
from reference import maths
from support.cases import QUICK
from support.clips import FLAT, animate, make_rig, to_frames, to_ik, to_rig, to_terrain

FPS, FRAMES = 60.0, 240
FLOOR = terrain.plane(np.zeros(3), np.array(maths.Y))
CLIPS = (
    "cmu_asfamc/01_01.amc",
    "cmu_asfamc/02_01.amc",
    "cmu_asfamc/02_03.amc",
    "cmu_bvh_mb/cmu_12_01_walk.bvh",
    "cmu_bvh_max/scaled_131_01.bvh",
)
RIG = make_rig()
# Held at once, and released by nothing unless a test says by what.
HELD = {"lock.release_distance": 9.0, "lock.release_cone": 1.5, "lock.release_min_angle": 0.0}
HELD |= {"lock.lock_half_life": 0.0}


@functools.partial(jax.jit, static_argnames="preset", compiler_options=QUICK)
def solve(preset: str, rig: jaxik.Rig, frames: jaxik.Frame) -> jaxik.Result:
    """The preset as it comes for the body of a rig: one program for all clips."""
    return jaxik.run(getattr(jaxik.presets, preset)(rig), rig, FLOOR, frames)


@functools.cache
def captured(path: Path) -> Clip:
    """The first four seconds; the last frame is repeated where a clip is shorter."""
    clip = resample(drop_t_pose(load_clip(path)), FPS)
    clip = dataclasses.replace(clip, stance=clip.stance_labels())
    return clip.select(np.minimum(np.arange(FRAMES), clip.frame_count - 1))


def slides(clip: Clip, stance: np.ndarray) -> np.ndarray:
    """Horizontal path of the ball in each stance, m."""
    steps = np.linalg.norm(np.diff(clip.joints_ws(3)[..., [0, 2]], axis=0), axis=-1)
    legs = range(stance.shape[1])
    runs = [(leg, *ends) for leg in legs for ends in contacts.runs(stance[:, leg])]
    return np.array([steps[first:last, leg].sum() for leg, first, last in runs])


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "most"), [("record", 0.002), ("mec", 0.007)])
def test_a_standing_foot_slides_no_more_than_animated(mocap, preset: str, most: float):
    """And no lock stays in a swing, or moves a foot that has been free for a second."""
    for name in CLIPS:
        clip = captured(mocap / "clips" / name)
        rig = dataclasses.replace(clip.rig, names=("l", "r"), joints=((0,) * 4,) * 2, pelvis=0)
        result = solve(preset, rig, clip_frames.frames_from_clip(clip))
        solved, stance = clip_frames.clip_from_result(clip, result), clip.stance_labels()
        added = slides(solved, stance) - slides(clip, stance)
        assert added.max() < most and np.median(added) < 0.001, name
        locked = np.asarray(result.trace.advanced.hold.locked) > 0
        assert locked[stance].mean() > (0.8 if preset == "record" else 0.15), name
        late = np.maximum.reduce([np.roll(stance, shift, axis=0) for shift in range(-2, 3)])
        assert (locked & ~late).mean() < 0.01, f"{name}: no lock in a swing"
        moved = np.linalg.norm(solved.joints_ws(2) - clip.joints_ws(2), axis=-1)
        free = ~np.array([locked[max(n - 60, 0) : n + 1].any(axis=0) for n in range(FRAMES)])
        assert moved[free].max(initial=0.0) < 0.01, f"{name}: as animated away from locks"


class Feet(NamedTuple):
    """Balls (frames, legs, 3), m, and headings (frames, legs), rad, of a clip in world space."""

    result: jaxik.Result
    balls: np.ndarray
    headings: np.ndarray

    @property
    def locked(self) -> np.ndarray:
        """(frames, legs)"""
        return self.result.trace.advanced.hold.locked > 0


@functools.partial(jax.jit, compiler_options=QUICK)
def with_feet(ik: jaxik.FootIK, frames: jaxik.Frame) -> Feet:
    rig, world = to_rig(RIG), frames.world_from_model
    result = jaxik.run(ik, rig, to_terrain(FLAT), frames)
    feet = quat.multiply(result.pose.ankle.rot, rig.ankle_from_foot)
    ahead = quat.rotate(quat.multiply(world.rot[:, None], feet), jnp.asarray(maths.Z))
    balls = jax.vmap(jaxik.Transform.apply)(world, result.pose.toe.pos)
    return Feet(result, balls, jnp.arctan2(ahead[..., 0], ahead[..., 2]))


def on_the_floor(values: dict[str, Any], frames: list) -> Feet:
    return jax.device_get(with_feet(to_ik(values, "record as it comes"), to_frames(frames)))


def test_feet_stay_under_a_root_that_turns_until_they_point_too_far_away():
    angle, most = np.radians(60.0), 0.5
    frames = animate(RIG, heading=lambda time: angle * np.clip(time - 1.0, 0.0, 1.0))
    feet = on_the_floor(HELD | {"lock.release_heading": most}, frames)
    first = int(np.argmin(feet.locked.all(axis=1)))  # frame of the release
    assert first == pytest.approx(60 + 60 * most / angle, abs=2), "when they point away by that"
    assert np.ptp(feet.balls[:first], axis=0).max() < 1e-9
    assert np.ptp(feet.headings[:first], axis=0).max() < 1e-9
    free = on_the_floor({"lock.enabled": False}, frames)
    # As animated and solved, m a frame.
    pace, step = (np.linalg.norm(np.diff(x.balls, axis=0), axis=-1) for x in (free, feet))
    assert (step <= pace + 0.01 + 1e-9).all(), "goes back by at most 1 cm a frame"
    start, *_, end = feet.headings
    assert (angle - end < most).all() and (end > start + most).all()


def test_the_heel_rises_about_a_held_ball():
    """While the root, and so the whole foot, drifts."""
    frames = animate(RIG, place=lambda time: [0.0, 0.0, 0.03 * time])
    for index, frame in enumerate(frames):
        pitch = 0.5 * np.clip(index / FPS - 1.0, 0.0, 1.0)  # rad, toes down
        tilt = maths.from_axis_angle(maths.X, pitch)
        arms = frame.ankle.pos - frame.toe.pos
        frame.ankle.pos[:] = frame.toe.pos + [maths.rotate(tilt, arm) for arm in arms]
        frame.ankle.rot[:] = [maths.multiply(tilt, rot) for rot in frame.ankle.rot]
    feet = on_the_floor(HELD, frames)
    assert feet.locked.all() and feet.result.reached.all()
    assert np.ptp(feet.balls, axis=0).max() < 1e-9
    heights = feet.result.pose.ankle.pos[..., 1]
    assert (heights[-1] - heights[0] > 0.05).all()
