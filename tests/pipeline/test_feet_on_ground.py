"""Feet on the floor on which they were animated, and on slopes of up to 25 degrees.

On the floor: what locks may change, and what not. On slopes: the soles of `stride`, as it comes.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import Clip, clip_frames, contacts, load_clip
from fitting.clips.edit import resample
from fitting.synthetic import footsteps, walker
from jaxik.maths import quat
from jaxik.world import terrain
from reference import maths, sample_poses
from support.bodies import without_t_pose
from support.cases import QUICK, stacked
from support.clips import FLAT, animate, at, make_rig, to_frames, to_ik, to_rig, to_terrain

FPS, FRAMES = 60.0, 240
FLOOR = terrain.plane(np.zeros(3), np.array(maths.Y))
CLIPS = [f"cmu_asfamc/{name}.amc" for name in ("01_01", "02_01", "02_03")]
CLIPS += ["cmu_bvh_mb/cmu_12_01_walk.bvh", "cmu_bvh_max/scaled_131_01.bvh"]
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
    """The first four seconds; a shorter clip goes to and fro: in a pause any foot may lock."""
    clip = resample(without_t_pose(load_clip(path)), FPS)
    clip = dataclasses.replace(clip, stance=clip.stance_labels())
    last = clip.frame_count - 1
    return clip.select(last - np.abs(np.arange(FRAMES) % (2 * last) - last))


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
    balls: Any
    headings: Any

    @property
    def locked(self) -> Any:
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


@pytest.mark.slow
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


@pytest.mark.slow
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


# Slopes.


ANGLES = (5, 10, 15, 20, 25)  # degrees
DIRECTIONS = {"up": (0.0, 1.0), "down": (0.0, -1.0), "across": (1.0, 0.0)}  # to the left, ahead
UP = np.array([0.0, 1.0, 0.0])


class Figure(NamedTuple):
    """Who stands or walks, and where its soles are."""

    rig: jaxik.Rig
    frames: jaxik.Frame
    ankle_height: float  # m, of a flat foot
    ball_height: float  # m, likewise

    def soles_ws(self, pose: jaxik.LegPose, root_ws: np.ndarray) -> np.ndarray:
        """Heels and balls at the sole, m, world space, (frames, legs, 2, 3)."""
        shape = pose.ankle.pos.shape
        world = np.asarray(self.frames.world_from_model.rot)[:, None]
        heading, ankle, of_foot = (
            Rotation.from_quat(
                np.broadcast_to(rot, (*shape[:2], 4)).reshape(-1, 4), scalar_first=True
            )
            for rot in (world, pose.ankle.rot, self.rig.ankle_from_foot)
        )
        points = []
        for joint, below in (
            (pose.ankle, [0.0, -self.ankle_height, -footsteps.HEEL]),
            (pose.toe, [0.0, -self.ball_height, 0.0]),
        ):
            foot = (ankle * of_foot).apply(below)
            points.append(heading.apply(foot + np.asarray(joint.pos).reshape(-1, 3)).reshape(shape))
        return np.stack(points, axis=2) + root_ws[:, None, None]


class Soles(NamedTuple):
    """Heights of heels and balls at the sole, m, (frames, legs, 2)."""

    slope: str
    animated: np.ndarray  # above the floor
    solved: np.ndarray  # above the slope, at right angles to it
    heel_lifted: np.ndarray  # (frames, legs), on purpose


@functools.cache
def figures() -> dict[str, Figure]:
    """One stands; one walks straight ahead, by known footholds or only by which feet stand."""
    rig = to_rig(RIG)
    standing = to_frames(animate(RIG, count=120, hz=30.0))
    straight = dataclasses.replace(standing.stride, aside_ws=0.0 * standing.stride.last_ws)
    standing = dataclasses.replace(standing, stride=straight)
    clip = walker.walk(4, 30, style=walker.WalkStyle(bend=0.0, variation=0.0))
    static = {name: getattr(rig, name) for name in ("names", "joints", "pelvis")}
    walker_rig = dataclasses.replace(clip.rig, **static)  # others would be another program
    known = clip_frames.frames_from_clip(clip)
    stride = dataclasses.replace(known.stride, known=0.0 * known.stride.known)
    heights = footsteps.ANKLE_HEIGHT, footsteps.BALL_HEIGHT
    return {
        "standing": Figure(rig, standing, sample_poses.ANKLE, 0.02),
        "known": Figure(walker_rig, known, *heights),
        "predicted": Figure(walker_rig, dataclasses.replace(known, stride=stride), *heights),
    }


@functools.partial(jax.jit, compiler_options=QUICK)
@jax.vmap
def on_slope(rig: jaxik.Rig, ground: Any, frames: jaxik.Frame) -> tuple[jaxik.LegPose, jax.Array]:
    """Legs, and by how much rules beside the foot's turn it (legs, 4)."""
    result = jaxik.run(jaxik.presets.stride(), rig, ground, frames)
    trace = result.trace
    return result.pose, trace.advanced.effector.rot_ws - trace.sensed.ankle_rot_ws


def soles_of(figure: Figure) -> Iterator[Soles]:
    """On each slope through the origin, along which the root goes."""
    floor = figure.frames.world_from_model
    slopes, batch = [], []
    for (direction, ways), angle in ((x, angle) for x in DIRECTIONS.items() for angle in ANGLES):
        left, ahead = np.tan(np.radians(angle)) * np.array(ways)
        normal = np.array([-left, 1.0, -ahead]) / np.linalg.norm([left, 1.0, ahead])
        climb = np.array(floor.pos)[:, [0, 2]] @ [left, ahead]
        root = jaxik.Transform(floor.pos + climb[:, None] * UP, floor.rot)
        frames = dataclasses.replace(figure.frames, world_from_model=root)
        slopes.append((f"{angle} degrees {direction}", normal, root.pos))
        batch.append((figure.rig, terrain.plane(normal=tuple(normal)), frames))
    solved = jax.device_get(on_slope(*stacked(batch)))
    animated = figure.soles_ws(figure.frames.pose, np.asarray(floor.pos))[..., 1]
    for index, (name, normal, root_ws) in enumerate(slopes):
        pose, turned = at(solved, index)
        heights = figure.soles_ws(pose, root_ws) @ normal
        yield Soles(name, animated, heights, np.abs(turned).max(axis=-1) > 1e-9)


@pytest.mark.slow
def test_a_standing_sole_lies_on_the_slope():
    for soles in soles_of(figures()["standing"]):
        assert np.abs(soles.solved - soles.animated).max() < 0.002, soles.slope


@pytest.mark.slow
@pytest.mark.parametrize("footholds", ["known", "predicted"])
def test_a_walker_keeps_its_soles_on_the_slope(footholds: str):
    stands = np.asarray(figures()[footholds].frames.stride.standing) > 0.5
    # Before its first and after its last stance a foot has no stride.
    strides = np.logical_and.accumulate(~stands) | np.logical_and.accumulate(~stands[::-1])[::-1]
    inside = ~strides.any(axis=1, keepdims=True)
    stands, swings = stands & inside, ~stands & inside
    assert stands.mean() > 0.2 and swings.mean() > 0.2
    for slope, animated, solved, heel_lifted in soles_of(figures()[footholds]):
        heel, ball = np.moveaxis(solved - animated, -1, 0)
        assert np.abs(ball[stands]).max() < 0.007, slope
        assert heel[stands].min() > -0.005, f"{slope}: heels may rise, but not sink"
        assert np.abs(heel[stands & ~heel_lifted]).max() < 0.005, slope
        sunk = np.minimum(solved, 0.0) - np.minimum(animated, 0.0)
        assert sunk[swings].min() > -0.003, slope
