"""The preset `stride`, as it comes, on planes of up to 25 degrees: soles lie on them."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.synthetic import gait, walker
from jaxik.world import terrain
from reference import sample_poses
from support.cases import QUICK, stacked
from support.clips import animate, at, make_rig, to_frames, to_rig

ANGLES = (5, 10, 15, 20, 25)  # degrees
DIRECTIONS = {"up": (0.0, 1.0), "down": (0.0, -1.0), "across": (1.0, 0.0)}  # to the left, ahead
SLOPES = [(name, angle) for name in DIRECTIONS for angle in ANGLES]
SECONDS, HZ = 4, 30


class Figure(NamedTuple):
    """Who stands or walks, and where its soles are."""

    rig: jaxik.Rig
    frames: jaxik.Frame
    ankle_height: float  # m, of a flat foot
    ball_height: float  # m, likewise

    def soles_ws(self, pose: jaxik.LegPose, root_ws: np.ndarray) -> np.ndarray:
        """Heels and balls at the sole, m, world space, (frames, legs, 2, 3)."""
        shape = pose.ankle.pos.shape
        heading, ankle, of_foot = (
            Rotation.from_quat(
                np.broadcast_to(rot, (*shape[:2], 4)).reshape(-1, 4), scalar_first=True
            )
            for rot in (
                np.asarray(self.frames.world_from_model.rot)[:, None],
                pose.ankle.rot,
                self.rig.ankle_from_foot,
            )
        )
        points = []
        for joint, below in (
            (pose.ankle, [0.0, -self.ankle_height, -gait.HEEL]),
            (pose.toe, [0.0, -self.ball_height, 0.0]),
        ):
            foot = (ankle * of_foot).apply(below)
            points.append(heading.apply(foot + np.asarray(joint.pos).reshape(-1, 3)).reshape(shape))
        return np.stack(points, axis=2) + root_ws[:, None, None]


class Soles(NamedTuple):
    """Heights of heels and balls at the sole, m, (frames, legs, 2)."""

    animated: np.ndarray  # above the floor
    solved: np.ndarray  # above the slope, at right angles to it
    heel_lifted: np.ndarray  # (frames, legs), on purpose

    @property
    def error(self) -> np.ndarray:
        return self.solved - self.animated


@functools.cache
def figures() -> dict[str, Figure]:
    """One stands; one walks straight ahead, by known footholds or only by which feet stand."""
    rig = to_rig(make_rig())
    standing = to_frames(animate(make_rig(), count=SECONDS * HZ, hz=HZ))
    straight = dataclasses.replace(standing.stride, aside_ws=0.0 * standing.stride.last_ws)
    standing = dataclasses.replace(standing, stride=straight)
    clip = walker.walk(SECONDS, HZ, style=walker.WalkStyle(bend=0.0, variation=0.0))
    walker_rig = dataclasses.replace(
        clip.rig, names=rig.names, joints=rig.joints, pelvis=rig.pelvis
    )  # static: other names would be another program
    known = frames_from_clip(clip)
    stride = dataclasses.replace(known.stride, known=0.0 * known.stride.known)
    heights = gait.ANKLE_HEIGHT, gait.BALL_HEIGHT
    return {
        "standing": Figure(rig, standing, sample_poses.ANKLE, 0.02),
        "known": Figure(walker_rig, known, *heights),
        "predicted": Figure(walker_rig, dataclasses.replace(known, stride=stride), *heights),
    }


@functools.partial(jax.jit, compiler_options=QUICK)
@jax.vmap
def solve(rig: jaxik.Rig, ground: Any, frames: jaxik.Frame) -> tuple[jaxik.LegPose, jax.Array]:
    """Legs, and by how much rules beside the foot's turn it (legs, 4)."""
    result = jaxik.run(jaxik.presets.stride(), rig, ground, frames)
    trace = result.trace
    return result.pose, trace.advanced.effector.rot_ws - trace.sensed.ankle_rot_ws


@functools.cache
def soles() -> dict[tuple[str, str, int], Soles]:
    """The soles of each figure, whose root goes along a slope through the origin."""
    cases, batch = [], []
    for name, figure in figures().items():
        for direction, angle in SLOPES:
            left, ahead = np.tan(np.radians(angle)) * np.array(DIRECTIONS[direction])
            normal = np.array([-left, 1.0, -ahead])
            root = figure.frames.world_from_model
            climb = np.array(root.pos)[:, [0, 2]] @ [left, ahead]
            root_ws = root.pos + climb[:, None] * np.array([0.0, 1.0, 0.0])
            moved = jaxik.Transform(root_ws, root.rot)
            frames = dataclasses.replace(figure.frames, world_from_model=moved)
            cases.append((name, direction, angle, normal / np.linalg.norm(normal), root_ws))
            batch.append((figure.rig, terrain.plane(normal=tuple(normal)), frames))
    solved = jax.device_get(solve(*stacked(batch)))
    table = {}
    for index, (name, direction, angle, normal, root_ws) in enumerate(cases):
        figure, (pose, turned) = figures()[name], at(solved, index)
        floor_ws = np.asarray(figure.frames.world_from_model.pos)
        animated = figure.soles_ws(figure.frames.pose, floor_ws)[..., 1]
        heights = figure.soles_ws(pose, root_ws) @ normal
        lifted = np.abs(turned).max(axis=-1) > 1e-9
        table[name, direction, angle] = Soles(animated, heights, lifted)
    return table


@pytest.mark.slow
def test_a_standing_sole_lies_on_the_slope():
    for direction, angle in SLOPES:
        error = np.abs(soles()["standing", direction, angle].error).max()
        assert error < 0.002, (direction, angle)


@pytest.mark.slow
@pytest.mark.parametrize("footholds", ["known", "predicted"])
def test_a_walker_keeps_its_soles_on_the_slope(footholds: str):
    stands = np.asarray(figures()[footholds].frames.stride.standing) > 0.5
    # Before its first and after its last stance a foot has no stride.
    strides = np.logical_and.accumulate(~stands) | np.logical_and.accumulate(~stands[::-1])[::-1]
    inside = ~strides.any(axis=1, keepdims=True)
    stands, swings = stands & inside, ~stands & inside
    assert stands.mean() > 0.2 and swings.mean() > 0.2

    for direction, angle in SLOPES:
        on_slope, where = soles()[footholds, direction, angle], (direction, angle)
        heel, ball = np.moveaxis(on_slope.error, -1, 0)
        assert np.abs(ball[stands]).max() < 0.005, where
        assert heel[stands].min() > -0.005, (*where, "heels may rise, but not sink")
        assert np.abs(heel[stands & ~on_slope.heel_lifted]).max() < 0.005, where
        sunk = np.minimum(on_slope.solved, 0.0) - np.minimum(on_slope.animated, 0.0)
        assert sunk[swings].min() > -0.003, where
