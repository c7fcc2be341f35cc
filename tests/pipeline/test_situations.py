"""Situations from bug reports of others, with the presets as they come: what is right in each."""

import functools
from typing import Any

import jax
import numpy as np
import pytest

import jaxik
from fitting.synthetic import multi_limb
from jaxik.maths import quat
from jaxik.world import terrain
from reference.sample_poses import ANKLE, standing
from support import clips
from support.cases import QUICK
from support.clips import to_frames, to_rig

FRAMES, HZ = 120, 60.0
FLOOR = 0.0
GAMES = ("ozz", "unreal", "mec")


def boxes(floor: float, *tops: tuple[float, float, float, float, float]) -> terrain.Terrain:
    """A floor with level tops over it, each by its height and its ends in x and z, m."""
    vertices = [(9.0, floor, -9.0), (-9.0, floor, -9.0), (0.0, floor, 18.0)]
    triangles = [(0, 1, 2)]
    for height, left, right, back, front in tops:
        first = len(vertices)
        vertices += [(x, height, z) for x in (left, right) for z in (back, front)]
        triangles += [(first, first + 1, first + 2), (first + 1, first + 3, first + 2)]
    return terrain.mesh(np.array(vertices), np.array(triangles))


@functools.partial(jax.jit, compiler_options=QUICK)
def run(ik: jaxik.FootIK, ground: terrain.Terrain, frames: jaxik.Frame) -> jaxik.Result:
    return jaxik.run(ik, to_rig(clips.make_rig()), ground, frames)


def standing_clip(**motion: Any) -> jaxik.Frame:
    """A character that stands, and moves as a whole as these functions of the time say."""
    return to_frames(clips.animate(clips.make_rig(), count=FRAMES, hz=HZ, **motion))


def ankles(result: jaxik.Result) -> np.ndarray:
    return np.asarray(result.pose.ankle.pos)


@pytest.mark.parametrize("preset", GAMES)
@pytest.mark.parametrize("roof", [2.4, 5.0])
def test_nobody_climbs_onto_a_roof_or_the_bench_on_which_it_sits(preset: str, roof: float):
    above = boxes(FLOOR, (0.45, -0.4, 0.4, -0.8, 0.0), (roof, -5, 5, -5, 5))
    frames = standing_clip()
    result = run(getattr(jaxik.presets, preset)(), above, frames)
    np.testing.assert_allclose(result.body.pos, 0.0, atol=0.05)
    assert ankles(result)[..., 1].max() < ANKLE + 0.05


@pytest.mark.parametrize("yaw, push", [(1.0, 0.0), (0.0, 0.2)])
def test_mec_lets_go_of_a_foot_that_its_body_leaves(yaw: float, push: float):
    frames = standing_clip(
        heading=lambda time: yaw * time, place=lambda time: np.array([0.0, 0.0, push * time])
    )
    result = run(jaxik.presets.mec(), boxes(FLOOR), frames)
    away = np.linalg.norm(ankles(result) - frames.pose.ankle.pos, axis=-1)
    turned = np.degrees(np.asarray(quat.angle(result.pose.ankle.rot, frames.pose.ankle.rot)))
    assert 0.05 < max(away.max(), turned.max() / 90) and away.max() < 0.2 and turned.max() < 35.0
    places = jax.vmap(lambda world, ankle: world.apply(ankle))(
        frames.world_from_model, result.pose.ankle.pos
    )
    assert np.linalg.norm(np.diff(places, axis=0), axis=-1).max() < 0.02


def test_a_leg_of_mec_reaches_into_a_dip():
    dip = boxes(-0.2, (0.0, -5.0, 0.0, -5.0, 5.0))
    lowered = ankles(run(jaxik.presets.mec(), dip, standing_clip()))[-1, :, 1] - ANKLE
    np.testing.assert_allclose(sorted(lowered), [-0.2, 0.0], atol=0.01)


def test_unreal_takes_a_captured_idle_for_standing():
    block = boxes(FLOOR, (0.12, 0.05, 5.0, -5.0, 5.0))
    sway = standing_clip(place=lambda time: [0.002 * np.sin(5.0 * time), 0.0, 0.0])
    assert 0.0 < np.asarray(sway.speed)[1:].max() < 0.02
    raised = ankles(run(jaxik.presets.unreal(), block, sway))[-1, :, 1] - ANKLE
    np.testing.assert_allclose(sorted(raised), [0.0, 0.12], atol=0.01)


@pytest.mark.parametrize("preset", ["record", "mec"])
def test_a_foot_whose_toes_are_over_a_ledge_stays_level(preset: str):
    toes = standing()[0, 2] + 0.12
    ledge = boxes(-0.15, (0.0, -5.0, 5.0, -5.0, toes))
    frames = standing_clip()
    result = run(getattr(jaxik.presets, preset)(), ledge, frames)
    assert np.degrees(quat.angle(result.pose.ankle.rot, frames.pose.ankle.rot)).max() < 12.0
    np.testing.assert_allclose(ankles(result)[-1], frames.pose.ankle.pos[-1], atol=0.01)


@pytest.mark.parametrize("preset", ["record", "stride"])
def test_four_legs_lie_along_a_slope_and_two_do_not(preset: str):
    quadruped, person = multi_limb.locomotion(multi_limb.QUADRUPED, 1.0), clips.make_rig()
    for rig, along in ((quadruped.rig, 1.0), (to_rig(person), None)):
        lean = getattr(jaxik.presets, preset)(rig).lean
        rate = float(lean.forward_rate if preset == "record" else lean.pelvis_rate)
        assert (rate == along) if along else rate < 0
