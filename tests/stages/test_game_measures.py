"""What games measure in units or between points of their own, in this pipeline's metres."""

import dataclasses

import numpy as np
import pytest

import jaxik
from reference import sample_poses
from support.clips import animate, make_rig, planes, to_frames, to_ik, to_rig, to_terrain

RIG, FRAMES = make_rig(), 3
STANDING = animate(RIG, count=FRAMES)
FLAT = to_terrain(planes((0.0, 0.0, 0.0)))


def run(ik, ground, scale=1.0) -> jaxik.Result:
    """The standing character, its mesh scaled."""
    frames = to_frames(STANDING)
    resized = jaxik.LegPose(
        *(jaxik.Transform(scale * joint.pos, joint.rot) for joint in vars(frames.pose).values())
    )
    return jaxik.run(ik, to_rig(RIG), ground, dataclasses.replace(frames, pose=resized))


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_raised_feet_of_unreal_stand_on_the_ground_whatever_the_scale_of_the_mesh(scale):
    step = 0.22
    capsule = {"probe.ray_up": 0.9 * scale, "probe.ray_down": 0.5 * scale}
    ik = to_ik({**capsule, "pelvis.half_height": 0.9 * scale}, "unreal")
    result = run(ik, to_terrain(planes((0.0, 0.0, step))), scale)
    ankles = result.pose.ankle.pos[..., 1]
    np.testing.assert_allclose(ankles, step + sample_poses.ANKLE * scale, rtol=0, atol=1e-9)
    assert (result.reached == 1).all() and (result.body.pos == 0).all()


def leg_lengths(result: jaxik.Result) -> np.ndarray:
    """From hip to ankle in the last frame, m."""
    return np.linalg.norm(result.pose.ankle.pos - result.pose.hip.pos, axis=-1)[-1]


def stretched(max_length: float | np.ndarray, min_length: float = 0.5) -> jaxik.Result:
    """Mec on level ground with these lengths of its legs, m; one a leg, to share a program."""
    lengths = {"pelvis.max_length": max_length, "pelvis.min_length": min_length}
    per_leg = {name: np.broadcast_to(length, 2) for name, length in lengths.items()}
    values = {"target.foot_height": sample_poses.ANKLE, "pelvis.damp": False}
    return run(to_ik(values | per_leg, "mec"), FLAT)


def test_mec_measures_legs_from_hip_to_ankle_so_that_nothing_moves_on_flat_ground():
    """A foot is `foot_height` above its contact: measured to that, standing legs were too long."""
    standing = STANDING[0]
    animated = np.linalg.norm(standing.ankle.pos - standing.hip.pos, axis=-1)
    longest = animated.max() + 1e-9
    result = stretched(longest)
    np.testing.assert_allclose(result.body.pos, 0.0, atol=1e-9)
    np.testing.assert_allclose(leg_lengths(result), animated, atol=1e-9)
    result = stretched(longest - 0.05)
    assert result.body.pos[-1, 1] < -0.03
    assert leg_lengths(result).max() == pytest.approx(longest - 0.05, abs=1e-6)
    result = stretched(0.88, min_length=longest + 0.02)
    assert leg_lengths(result).min() == pytest.approx(longest + 0.02, abs=1e-6)


def test_mec_keeps_the_length_of_each_leg():
    for leg in range(2):
        lengths = np.full(2, 0.88)
        lengths[leg] = 0.7
        assert leg_lengths(stretched(lengths))[leg] == pytest.approx(0.7, abs=1e-6)
