"""Frames and rigs of an engine's joints, against those that come with clips."""

# pyright: reportArgumentType=false

import dataclasses

import jax
import numpy as np
import pytest

import jaxik
from jaxik.world.skeleton import Rig, Transform
from support import clips
from support.clips import at, make_rig, to_frames, to_rig, wandering

FRAMES = 6
CLIP = jax.tree.map(np.asarray, to_frames(wandering(make_rig(), np.random.default_rng(3), FRAMES)))
MOVING = ("velocity_ws", "foot_speed", "toe_speed")


def built(clip: jaxik.Frame, **options) -> list[jaxik.Frame]:
    builder = jaxik.FrameBuilder()
    tracks = clip.platforms if clip.platforms.pos.size else None
    return [
        builder.build(
            at(clip.world_from_model, n),
            at(clip.pose, n),
            float(clip.dt[n]),
            at(tracks, n) if tracks else None,
            **options,
        )
        for n in range(len(clip.dt))
    ]


def test_speeds_are_the_ways_since_the_frame_before():
    frames = built(CLIP)
    places = np.asarray(CLIP.world_from_model.pos)
    for n in range(1, FRAMES):
        way = (places[n] - places[n - 1]) / CLIP.dt[n]
        np.testing.assert_allclose(frames[n].velocity_ws, way, atol=1e-12)
        np.testing.assert_allclose(frames[n].foot_speed, CLIP.foot_speed[n], atol=1e-9)
        np.testing.assert_allclose(frames[n].toe_speed, CLIP.toe_speed[n], atol=1e-9)
    assert all(not np.any(getattr(frames[0], name)) for name in MOVING)


def test_who_stands_on_a_platform_is_still_and_a_number_without_platform_is_refused():
    angles = np.array([[0.1], [0.3]])
    rot = np.stack([np.cos(angles), 0 * angles, np.sin(angles), 0 * angles], axis=-1)
    track = Transform(np.array([[[1.0, 0.0, 0.0]], [[1.3, 0.1, 0.2]]]), rot)
    riding = at(CLIP, slice(0, 2))
    root = jax.vmap(lambda platform, world: platform @ world)(
        Transform(track.pos[:, 0], track.rot[:, 0]), at(CLIP.world_from_model, np.array([0, 0]))
    )
    riding = dataclasses.replace(
        riding,
        pose=jax.tree.map(lambda x: np.stack([x[0], x[0]]), riding.pose),
        world_from_model=root,
        platforms=track,
    )
    (_, carried), (_, free) = built(riding, platform=0), built(riding)
    for name in MOVING:
        np.testing.assert_allclose(getattr(carried, name), 0.0, atol=1e-9)
        assert np.all(np.linalg.norm(np.atleast_1d(getattr(free, name)), axis=-1) > 0)
    with pytest.raises(ValueError, match="platform is 1; there are 1 platforms, numbered from 0"):
        built(riding, platform=1)


def test_the_rig_of_a_standing_pose_is_that_of_its_joints():
    rig = make_rig()
    pose = at(to_frames(clips.animate(rig, count=1)).pose, 0)
    made, expected = Rig.from_pose(pose), to_rig(rig)
    for name in ("knee_axis_ls", "thigh", "shin", "side"):
        np.testing.assert_allclose(getattr(made, name), getattr(expected, name), atol=1e-9)
    same = np.abs(np.sum(made.ankle_from_foot * expected.ankle_from_foot, axis=-1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)
