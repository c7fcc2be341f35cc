"""The preset `stride`, as it comes, on planes of up to 25 degrees: soles lie on them."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.synthetic import gait, walker
from jaxik.world import terrain
from reference import sample_poses
from support.cases import QUICK
from support.clips import FRAMES, animate, make_rig, to_frames, to_rig

pytestmark = pytest.mark.slow

ANGLES = (5, 10, 15, 20, 25)  # degrees
DIRECTIONS = {"up": (0.0, 1.0), "down": (0.0, -1.0), "across": (1.0, 0.0)}  # to the left, ahead
run = jax.jit(jaxik.run, compiler_options=QUICK)
slopes = pytest.mark.parametrize(
    ("direction", "angle"), [(name, angle) for name in DIRECTIONS for angle in ANGLES]
)


class Soles(NamedTuple):
    """Heights of heels and balls at the sole, m, (frames, legs, 2)."""

    animated: np.ndarray  # above the floor
    solved: np.ndarray  # above the slope, at right angles to it
    heel_lifted: np.ndarray  # (frames, legs), on purpose

    @property
    def error(self) -> np.ndarray:
        return self.solved - self.animated


class Figure(NamedTuple):
    """Who stands or walks, and where its soles are."""

    rig: jaxik.Rig
    frames: jaxik.Frame
    ankle_height: float  # m, of a flat foot
    ball_height: float  # m, likewise


def points_of_soles(figure: Figure, pose: jaxik.LegPose, root_ws: np.ndarray) -> np.ndarray:
    """Heels and balls at the sole, m, world space, (frames, legs, 2, 3)."""

    def rotations(rot: jax.Array) -> Rotation:
        return Rotation.from_quat(np.array(rot).reshape(-1, 4), scalar_first=True)

    shape = pose.ankle.pos.shape
    heading = rotations(jnp.repeat(figure.frames.world_from_model.rot[:, None], shape[1], axis=1))
    foot_of_leg = jnp.broadcast_to(figure.rig.ankle_from_foot, (*shape[:2], 4))
    foot = heading * rotations(pose.ankle.rot) * rotations(foot_of_leg)
    points = []
    for joint, below in (
        (pose.ankle, [0.0, -figure.ankle_height, -gait.HEEL]),
        (pose.toe, [0.0, -figure.ball_height, 0.0]),
    ):
        point = heading.apply(np.array(joint.pos).reshape(-1, 3)) + foot.apply(below)
        points.append(point.reshape(shape) + root_ws[:, None])
    return np.stack(points, axis=2)


def on_slope(figure: Figure, direction: str, angle: float) -> Soles:
    """The soles of a figure whose root goes along a slope through the origin."""
    rises = np.tan(np.radians(angle)) * np.array(DIRECTIONS[direction])
    normal = np.array([-rises[0], 1.0, -rises[1]])
    root_ws = np.array(figure.frames.world_from_model.pos)
    animated = points_of_soles(figure, figure.frames.pose, root_ws)[..., 1]
    climb = np.zeros_like(root_ws)
    climb[:, 1] = root_ws[:, [0, 2]] @ rises
    frames = jax.vmap(jaxik.Frame.translated)(figure.frames, jnp.asarray(climb))
    ground = terrain.plane(normal=tuple(normal))
    result = run(jaxik.presets.stride(), figure.rig, ground, frames)
    solved = points_of_soles(figure, result.pose, root_ws + climb)
    turned = result.trace.advanced.effector.rot_ws - result.trace.sensed.ankle_rot_ws
    return Soles(
        animated,
        solved @ normal / np.linalg.norm(normal),
        np.abs(np.asarray(turned)).max(axis=-1) > 1e-9,
    )


@functools.cache
def standing() -> Figure:
    rig = make_rig()
    frames = to_frames(animate(rig, count=FRAMES))
    return Figure(to_rig(rig), frames, sample_poses.ANKLE, 0.02)


@functools.cache
def walking(known: bool) -> Figure:
    """The synthetic walk, straight ahead, with known footholds or only which feet stand."""
    clip = walker.walk(seconds=4.0, style=walker.WalkStyle(bend=0.0, variation=0.0))
    frames = frames_from_clip(clip)
    stride = dataclasses.replace(
        frames.stride, known=jnp.full_like(frames.stride.known, float(known))
    )
    frames = dataclasses.replace(frames, stride=stride)
    return Figure(clip.rig, frames, gait.ANKLE_HEIGHT, gait.BALL_HEIGHT)


@slopes
def test_a_standing_sole_lies_on_the_slope(direction: str, angle: float):
    assert np.abs(on_slope(standing(), direction, angle).error).max() < 0.002


@slopes
@pytest.mark.parametrize("known", [True, False], ids=["known", "predicted"])
def test_a_walker_keeps_its_soles_on_the_slope(direction: str, angle: float, known: bool):
    figure = walking(known)
    soles = on_slope(figure, direction, angle)
    stands = np.asarray(figure.frames.stride.standing) > 0.5
    # Before its first and after its last stance a foot has no stride.
    strides = np.logical_and.accumulate(~stands) | np.logical_and.accumulate(~stands[::-1])[::-1]
    inside = ~strides.any(axis=1, keepdims=True)
    stands, swings = stands & inside, ~stands & inside
    assert stands.mean() > 0.2 and swings.mean() > 0.2

    heel, ball = np.moveaxis(soles.error, -1, 0)
    assert np.abs(ball[stands]).max() < 0.005
    assert heel[stands].min() > -0.005, "heels may rise, but not sink"
    assert np.abs(heel[stands & ~soles.heel_lifted]).max() < 0.005
    sunk = np.minimum(soles.solved, 0.0) - np.minimum(soles.animated, 0.0)
    assert sunk[swings].min() > -0.003
