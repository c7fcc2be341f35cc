"""Standing feet on the floor on which they were animated: what locks may change, and what not."""

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxik
from fitting.datasets import clip_frames
from fitting.datasets.clips import Clip, contacts, load_clip
from fitting.datasets.clips.edit import drop_t_pose, resample
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
RELEASES = {  # far away, so that each test chooses what releases its feet
    "lock.release_distance": 9.0,
    "lock.release_cone": 1.5,
    "lock.release_min_angle": 0.0,
}
run = jax.jit(jaxik.run, compiler_options=QUICK)


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


def turning(angle: float) -> list:
    """A character on the spot that turns by `angle`, rad, in the second second."""
    return animate(RIG, heading=lambda time: angle * np.clip(time - 1.0, 0.0, 1.0))


def solved_feet(result: jaxik.Result, frames: list) -> tuple[np.ndarray, np.ndarray]:
    """Balls (frames, legs, 3), m, and headings (frames, legs), rad, in the world."""
    balls, headings = [], []
    for index, frame in enumerate(frames):
        world = frame.world_from_model
        balls.append([maths.apply(world, pos) for pos in np.asarray(result.pose.toe.pos)[index]])
        rots = np.asarray(result.pose.ankle.rot)[index]
        feet = [
            maths.multiply(world.rot, maths.multiply(rot, ankle_from_foot))
            for rot, ankle_from_foot in zip(rots, RIG.ankle_from_foot, strict=True)
        ]
        ahead = [maths.rotate(foot, maths.Z) for foot in feet]
        headings.append([np.arctan2(axis[0], axis[2]) for axis in ahead])
    return np.array(balls), np.array(headings)


def test_feet_stay_under_a_root_that_turns_until_they_point_too_far_away():
    angle, most = np.radians(60.0), 0.5
    frames = turning(angle)
    values = RELEASES | {"lock.lock_half_life": 0.0, "lock.release_heading": most}
    ik = to_ik(values, "record as it comes")
    result = run(ik, to_rig(RIG), to_terrain(FLAT), to_frames(frames))
    locked = np.asarray(result.trace.advanced.hold.locked) > 0
    balls, headings = solved_feet(result, frames)
    first = int(np.argmin(locked.all(axis=1)))  # frame of the release
    assert first == pytest.approx(60 + 60 * most / angle, abs=2), "when they point away by that"
    assert np.ptp(balls[:first], axis=0).max() < 1e-9
    assert np.ptp(headings[:first], axis=0).max() < 1e-9
    free_ik = to_ik({"lock.enabled": False}, "record as it comes")
    unlocked = run(free_ik, to_rig(RIG), to_terrain(FLAT), to_frames(frames))
    free, _ = solved_feet(unlocked, frames)
    pace = np.linalg.norm(np.diff(free, axis=0), axis=-1)  # as animated, m a frame
    step = np.linalg.norm(np.diff(balls, axis=0), axis=-1)
    assert (step <= pace + 0.01 + 1e-9).all(), "goes back by at most 1 cm a frame"
    assert (angle - headings[-1] < most).all() and (headings[-1] > headings[0] + most).all()


def test_the_heel_rises_about_a_held_ball():
    """While the root, and so the whole foot, drifts."""
    frames = animate(RIG, place=lambda time: [0.0, 0.0, 0.03 * time])
    for index, frame in enumerate(frames):
        pitch = 0.5 * np.clip(index / FPS - 1.0, 0.0, 1.0)  # rad, toes down
        tilt = maths.from_axis_angle(maths.X, pitch)
        arms = frame.ankle.pos - frame.toe.pos
        frame.ankle.pos[:] = frame.toe.pos + [maths.rotate(tilt, arm) for arm in arms]
        frame.ankle.rot[:] = [maths.multiply(tilt, rot) for rot in frame.ankle.rot]
    ik = to_ik(RELEASES | {"lock.lock_half_life": 0.0}, "record as it comes")
    result = run(ik, to_rig(RIG), to_terrain(FLAT), to_frames(frames))
    assert np.asarray(result.trace.advanced.hold.locked).all()
    balls, _ = solved_feet(result, frames)
    assert np.asarray(result.reached).all()
    assert np.ptp(balls, axis=0).max() < 1e-9
    heights = np.asarray(result.pose.ankle.pos)[..., 1]
    assert (heights[-1] - heights[0] > 0.05).all()
