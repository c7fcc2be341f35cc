"""Situations from bug reports of others, with the presets as they come: what is right in each."""

import functools
from collections.abc import Callable
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
OZZ, MEC, RECORD, STRIDE = (
    pytest.param(name, marks=pytest.mark.slow) for name in ("ozz", "mec", "record", "stride")
)
GAMES = (OZZ, "unreal", MEC)  # with roots of their own
TOES = standing()[0, 2] + 0.12  # m, ahead of the root
APART = 20.0  # m, from the middle of one place to that of the next

# Level rectangles, each by its height and its ends in x and z, m. All situations stand side by side
# on one ground, so that each preset is one program.
BENCH = (0.45, -0.4, 0.4, -0.8, 0.0)
PLACES = {
    "floor": [(0.0, -9, 9, -9, 9)],
    "under a roof at 2.4 m": [(0.0, -9, 9, -9, 9), BENCH, (2.4, -5, 5, -5, 5)],
    "under a roof at 5 m": [(0.0, -9, 9, -9, 9), BENCH, (5.0, -5, 5, -5, 5)],
    "dip": [(-0.2, -9, 9, -9, 9), (0.0, -5, 0, -5, 5)],
    "block": [(0.0, -9, 9, -9, 9), (0.12, 0.05, 5, -5, 5)],
    "ledge": [(-0.15, -9, 9, -9, 9), (0.0, -5, 5, -5, TOES)],
}


def middle(place: str) -> np.ndarray:
    return np.array([APART * list(PLACES).index(place), 0.0, 0.0])


@functools.cache
def ground() -> terrain.Terrain:
    vertices, triangles = [], []
    for place, rectangles in PLACES.items():
        for height, left, right, back, front in rectangles:
            first = len(vertices)
            corners = [(x, height, z) for x in (left, right) for z in (back, front)]
            vertices += [middle(place) + corner for corner in corners]
            triangles += [(first, first + 1, first + 2), (first + 1, first + 3, first + 2)]
    return terrain.mesh(np.array(vertices), np.array(triangles))


@functools.partial(jax.jit, compiler_options=QUICK)
def solved(ik: jaxik.FootIK, ground: terrain.Terrain, frames: jaxik.Frame) -> jaxik.Result:
    return jaxik.run(ik, to_rig(clips.make_rig()), ground, frames)


def run(preset: str, frames: jaxik.Frame) -> jaxik.Result:
    return solved(getattr(jaxik.presets, preset)(), ground(), frames)


def standing_clip(
    where: str, way: Callable[[float], Any] = lambda time: (0.0, 0.0, 0.0), **motion: Any
) -> jaxik.Frame:
    """A character that stands there and moves as a whole as these functions of the time say."""
    rig = clips.make_rig()
    frames = clips.animate(
        rig, count=FRAMES, hz=HZ, place=lambda time: middle(where) + way(time), **motion
    )
    return to_frames(frames)


def ankles(result: jaxik.Result) -> np.ndarray:
    return np.asarray(result.pose.ankle.pos)


@pytest.mark.parametrize("preset", GAMES)
@pytest.mark.parametrize("place", [place for place in PLACES if "roof" in place])
def test_nobody_climbs_onto_a_roof_or_the_bench_on_which_it_sits(preset: str, place: str):
    result = run(preset, standing_clip(place))
    np.testing.assert_allclose(result.body.pos, 0.0, atol=0.05)
    assert ankles(result)[..., 1].max() < ANKLE + 0.05


@pytest.mark.slow
@pytest.mark.parametrize("yaw, push", [(1.0, 0.0), (0.0, 0.2)])
def test_mec_lets_go_of_a_foot_that_its_body_leaves(yaw: float, push: float):
    frames = standing_clip(
        "floor", way=lambda time: (0.0, 0.0, push * time), heading=lambda time: yaw * time
    )
    result = run("mec", frames)
    away = np.linalg.norm(ankles(result) - frames.pose.ankle.pos, axis=-1)
    turned = np.degrees(np.asarray(quat.angle(result.pose.ankle.rot, frames.pose.ankle.rot)))
    assert 0.05 < max(away.max(), turned.max() / 90) and away.max() < 0.2 and turned.max() < 35.0
    places = jax.vmap(lambda world, ankle: world.apply(ankle))(
        frames.world_from_model, result.pose.ankle.pos
    )
    assert np.linalg.norm(np.diff(places, axis=0), axis=-1).max() < 0.02


@pytest.mark.slow
def test_a_leg_of_mec_reaches_into_a_dip():
    lowered = ankles(run("mec", standing_clip("dip")))[-1, :, 1] - ANKLE
    np.testing.assert_allclose(sorted(lowered), [-0.2, 0.0], atol=0.01)


def test_unreal_takes_a_captured_idle_for_standing():
    sway = standing_clip("block", way=lambda time: (0.002 * np.sin(5.0 * time), 0.0, 0.0))
    assert 0.0 < np.asarray(sway.speed)[1:].max() < 0.02
    raised = ankles(run("unreal", sway))[-1, :, 1] - ANKLE
    np.testing.assert_allclose(sorted(raised), [0.0, 0.12], atol=0.01)


@pytest.mark.parametrize("preset", [RECORD, MEC])
def test_a_foot_whose_toes_are_over_a_ledge_stays_level(preset: str):
    frames = standing_clip("ledge")
    result = run(preset, frames)
    assert np.degrees(quat.angle(result.pose.ankle.rot, frames.pose.ankle.rot)).max() < 12.0
    np.testing.assert_allclose(ankles(result)[-1], frames.pose.ankle.pos[-1], atol=0.01)


@pytest.mark.parametrize("preset", ["record", "stride"])
def test_four_legs_lie_along_a_slope_and_two_do_not(preset: str):
    quadruped, person = multi_limb.locomotion(multi_limb.QUADRUPED, 1.0), clips.make_rig()
    for rig, along in ((quadruped.rig, 1.0), (to_rig(person), None)):
        lean = getattr(jaxik.presets, preset)(rig).lean
        rate = float(lean.forward_rate if preset == "record" else lean.pelvis_rate)
        assert (rate == along) if along else rate < 0


@pytest.mark.parametrize("preset", [RECORD, STRIDE, MEC])
def test_a_squatter_with_a_foot_on_a_block_puts_it_on_top(preset: str):
    """The legs fold hardly more than animated, so the body rises with the block."""
    squat = standing_clip(
        "block", hip_height=lambda time: 0.90 - 0.48 * np.sin(min(time, 1.0) * np.pi / 2)
    )
    heights = ankles(run(preset, squat))[30:, :, 1] - ANKLE
    left = 0 if heights[0, 0] > heights[0, 1] else 1
    np.testing.assert_allclose(heights[:, left], 0.12, atol=0.015)
    np.testing.assert_allclose(heights[:, 1 - left], 0.0, atol=0.015)
