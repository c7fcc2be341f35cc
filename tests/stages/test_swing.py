"""How feet swing over uneven ground: later, higher, and with the toes pointed down."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.stages.probe.swing import bump
from reference import maths
from reference.stages import swing as reference
from reference.terrain import Terrain as PlainTerrain
from support.cases import RIG
from support.clips import to_frames, to_ik, to_rig, to_terrain
from support.strides import walk

COUNT = 90


def ground(*tops: tuple[float, float, float, float, float]) -> PlainTerrain:
    """Level rectangles: from and to along x, from and to along z, height, m."""
    triangles = []
    for left, right, near, far, height in tops:
        a, b, c, d = ([x, height, z] for x in (left, right) for z in (near, far))
        triangles += [[a, b, c], [b, d, c]]
    return PlainTerrain(maths.Y, triangles=np.array(triangles))


FLAT = ground((-2.0, 2.0, -3.0, 3.0, 0.0))


def step_up(height: float) -> PlainTerrain:
    """A step across the way of `frames_over_a_step`, m."""
    return ground((-2.0, 2.0, -3.0, 0.3, 0.0), (-2.0, 2.0, 0.3, 3.0, height))


STEP_UP = step_up(0.25)


def frames_over_a_step() -> jaxik.Frame:
    return to_frames(walk(RIG, COUNT, start=(0.0, 0.0, -0.5)))


def hits(
    terrain: PlainTerrain, frames: jaxik.Frame, **values: float
) -> jaxik.world.frame.GroundHits:
    ik = to_ik({f"probe.{name}": value for name, value in values.items()}, "stride")
    return jaxik.run(ik, to_rig(RIG), to_terrain(terrain), frames).trace.sensed.ground


@pytest.mark.parametrize("peak", [0.23, 0.5, 0.75])
def test_a_bump_is_one_at_its_peak_and_nothing_at_both_ends(peak: float):
    x = np.linspace(0.0, 1.0, 41)
    expected = [reference.bump(value, peak) for value in x]
    np.testing.assert_allclose(bump(jnp.asarray(x), peak), expected, rtol=0, atol=1e-6)
    assert float(bump(jnp.asarray(peak), peak)) == pytest.approx(1.0, abs=1e-6)
    slopes = jax.vmap(jax.grad(lambda fraction: bump(fraction, peak)))(jnp.asarray(x))
    assert np.isfinite(slopes).all()
    assert float(slopes[0]) == float(slopes[-1]) == 0.0


def test_on_a_flat_floor_no_foot_is_lifted_or_pitched():
    swing = hits(FLAT, frames_over_a_step())
    assert np.abs(np.asarray(swing.lift)).max() == 0.0
    assert np.abs(np.asarray(swing.pitch)).max() == 0.0


def test_feet_that_swing_as_animated_are_neither_lifted_nor_pitched():
    swing = hits(STEP_UP, frames_over_a_step(), swing_as_animated=True)
    assert np.abs(np.asarray(swing.lift)).max() == np.abs(np.asarray(swing.pitch)).max() == 0.0


def test_strides_that_are_not_used_are_as_if_unknown():
    frames = frames_over_a_step()
    unknown = dataclasses.replace(frames.stride, known=jnp.zeros_like(frames.stride.known))
    predicted = hits(STEP_UP, dataclasses.replace(frames, stride=unknown))
    unused, used = (hits(STEP_UP, frames, use_strides=use) for use in (False, True))
    for name in ("lift", "pitch"):
        np.testing.assert_array_equal(getattr(unused, name), getattr(predicted, name))
    np.testing.assert_array_equal(unused.ankle.point, predicted.ankle.point)
    assert np.abs(unused.ankle.point - used.ankle.point).max() > 0.1


def test_only_swinging_feet_are_lifted_onto_a_step():
    frames = frames_over_a_step()
    swing = hits(STEP_UP, frames, held_lift=0.0)
    standing = np.asarray(frames.stride.fraction) == 0.0
    assert np.abs(np.asarray(swing.lift)[standing]).max() == 0.0
    assert np.asarray(swing.lift).max() > 0.1
    assert np.asarray(swing.pitch).min() < -0.2


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["up", "down"])
def test_steps_higher_than_captured_ones_change_a_swing_no_more(way: float):
    low, high, higher = (
        hits(step_up(way * height), frames_over_a_step()) for height in (0.2, 0.35, 0.5)
    )
    for name in ("lift", "pitch"):
        highest = np.asarray(getattr(high, name))
        np.testing.assert_allclose(getattr(higher, name), highest, rtol=0, atol=1e-9)
        assert np.abs(getattr(low, name) - highest).max() > 0.02


def test_a_foot_that_goes_round_a_hurdle_does_not_step_over_it():
    frames = frames_over_a_step()
    last, following = (np.asarray(x)[:, 0] for x in (frames.stride.last_ws, frames.stride.next_ws))
    middle = int(np.argmax(np.asarray(frames.stride.fraction)[:, 0] > 0.4))
    same = np.all(last == last[middle], axis=-1)  # the frames of one swing of the left foot
    x, _, z = 0.5 * (last[middle] + following[middle])
    floor = (-2.0, 2.0, -3.0, 3.0, 0.0)
    hurdle = ground(floor, (x - 0.5, x + 0.5, z - 0.06, z + 0.06, 0.2))
    aside = jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0]), frames.stride.last_ws.shape)
    stride = dataclasses.replace(frames.stride, aside_ws=aside)
    straight = hits(hurdle, frames, held_lift=0.0).lift
    round_it = hits(hurdle, dataclasses.replace(frames, stride=stride), held_lift=0.0).lift
    assert np.asarray(straight)[same, 0].max() > 0.2
    assert np.abs(np.asarray(round_it)[same, 0]).max() < 0.01
