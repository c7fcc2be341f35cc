"""Frames with numbers that are not finite, and pauses: they change neither memory nor others.

All clips of a preset are rows of one batch: one with each damage, and some with a pause or a jump.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from support.cases import QUICK, stacked
from support.clips import at, make_rig, planes, to_frames, to_rig, to_terrain, wandering

COUNT, BAD = 16, 8
RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
LEG_FIELDS = ("pose", "weight", "foot_speed", "toe_speed", "stride")
BOTH, SECOND, NONE = (True, True), (False, True), (False, False)  # legs that are there
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


class Row(NamedTuple):
    """A clip, by the legs that are there and by what happens in it."""

    present: tuple[bool, bool]
    event: str
    clip: jaxik.Frame

    @property
    def of_leg(self) -> bool:
        """Whether the damage is in an array with a number a leg."""
        return self.event.split()[0].split(".")[1] in LEG_FIELDS


@functools.cache
def frames() -> jaxik.Frame:
    clip = to_frames(wandering(make_rig(), np.random.default_rng(3), COUNT))
    clip = dataclasses.replace(clip, stride_scale=jnp.ones_like(clip.dt))
    return jax.tree.map(np.asarray, clip)


def damages(frame: jaxik.Frame):
    """Names of a frame's arrays, and the frame with a number replaced in each."""
    paths, structure = jax.tree_util.tree_flatten_with_path(frame)
    leaves = [leaf for _, leaf in paths]
    for i, (path, leaf) in enumerate(paths):
        for value in (np.nan, np.inf, -1e30) if leaf.size else ():
            damaged = np.array(leaf)
            damaged[(0,) * leaf.ndim] = value
            others = [*leaves[:i], damaged, *leaves[i + 1 :]]
            yield f"{jax.tree_util.keystr(path)} = {value}", structure.unflatten(others)


@functools.cache
def rows() -> list[Row]:
    """The clip as it is, with a bad frame before frame `BAD`, with pauses, and with long frames."""
    each = [at(frames(), index) for index in range(COUNT)]
    before, here, after = each[:BAD], each[BAD], each[BAD:]

    def row(event: str, *singles: jaxik.Frame, present: tuple[bool, bool] = BOTH) -> Row:
        """A clip as long as all others, for which the last frame is repeated."""
        padding = [singles[-1]] * (COUNT - len(singles))
        return Row(present, event, stacked([*singles[:COUNT], *padding]))

    def lasting(frame: jaxik.Frame, dt: float) -> jaxik.Frame:
        return dataclasses.replace(frame, dt=np.full_like(frame.dt, dt))

    many = [row("nothing", *each, present=present) for present in (BOTH, SECOND, NONE)]
    for name, bad in damages(here):
        damaged = row(name, *before, bad, *after)
        legs = (BOTH, SECOND, NONE) if damaged.of_leg else (BOTH,)
        many += [damaged._replace(present=present) for present in legs]
    for dt in (0.0, -1.0):
        many.append(row(f"pause of {dt}", *before, here, *[lasting(here, dt)] * 2, *after[1:]))
    for dt in (0.0, 1.0, 1e4):
        many.append(row(f"begins with {dt}", lasting(each[0], dt), *each[1:]))
    return [*many, row("takes long", each[0], lasting(here, 1e4), *each[1:])]


class Played(NamedTuple):
    """The solved rows (rows, frames, ...): results without trace, and memory after each frame."""

    result: jaxik.Result
    state: jaxik.State

    def row(self, event: str, present: tuple[bool, bool] = BOTH) -> "Played":
        """That with an event."""
        (number,) = (n for n, row in enumerate(rows()) if row[:2] == (present, event))
        return at(self, number)


MOST = [pytest.param(name, marks=pytest.mark.slow) for name in ("mec", "record")]


@pytest.fixture(scope="module", params=["unreal", *MOST])
def played(request: pytest.FixtureRequest) -> Played:
    """By the preset that compiles soonest, and by those that remember most."""
    ik = getattr(jaxik.presets, request.param)()

    @functools.partial(jax.jit, compiler_options=QUICK)
    @jax.vmap
    def run(present: jax.Array, clip: jaxik.Frame) -> Played:
        rig = dataclasses.replace(RIG, present=present)
        result = jaxik.run(ik, rig, GROUND, clip)
        return Played(dataclasses.replace(result, trace=None), result.trace.advanced.state)

    clips = stacked([row.clip for row in rows()])
    return jax.device_get(run(np.array([row.present for row in rows()]), clips))


def assert_same(tree: Any, expected: Any, atol: float = 0.0, name: str = "") -> None:
    for ours, wanted in zip(jax.tree.leaves(tree), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, wanted, rtol=0, atol=atol, err_msg=name)


def finite(tree: Any) -> bool:
    return all(np.isfinite(x).all() for x in jax.tree.leaves(tree))


def damaged(present: tuple[bool, bool] = BOTH) -> list[Row]:
    return [row for row in rows() if row.event.startswith(".") and row.present == present]


def test_one_bad_number_leaves_memory_as_it_was_and_the_next_frame_goes_on(played: Played):
    """Whatever array has it, the frame or the leg is flagged and passed through."""
    animated, usual = at(frames(), BAD).pose, at(played.row("nothing"), slice(BAD, COUNT - 1))
    for row in damaged():
        now, name = played.row(row.event), row.event
        result = at(now.result, BAD)
        np.testing.assert_array_equal(result.faulty, [True, not row.of_leg], err_msg=name)
        assert not now.result.faulty[np.arange(COUNT) != BAD].any(), name
        assert finite(now), name
        if not row.of_leg:
            assert_same(at(now.state, BAD), at(now.state, BAD - 1), name=name)
            assert_same(at(now, slice(BAD + 1, COUNT)), usual, name=name)
            assert_same(result.pose, animated, 1e-6, name)
            assert_same(result.body.pos, np.zeros(3), name=name)
            assert not result.reached.any() and not result.aimed.any(), name
        for correction in (result.corrections.hip, result.corrections.knee):
            np.testing.assert_allclose(correction[0], IDENTITY, atol=1e-6, err_msg=name)


def test_legs_that_are_not_there_may_hold_anything(played: Played):
    """Sums over legs take in what has the weight 0, which makes NaN of what is infinite."""
    for present in (SECOND, NONE):
        expected = played.row("nothing", present).result.pose.ankle.pos[: BAD + 1, 1]
        for row in damaged(present):
            now = played.row(row.event, present)
            assert finite(now) and not now.result.faulty.any(), row.event
            ankles = now.result.pose.ankle.pos[: BAD + 1, 1]
            assert_same(ankles, expected, 1e-9, row.event)


def test_nothing_moves_in_a_pause(played: Played):
    for dt in (0.0, -1.0):
        result, state = played.row(f"pause of {dt}")
        assert not result.faulty.any()
        for still in (BAD + 1, BAD + 2):
            assert_same(at(state, still), at(state, BAD))
        assert_same(at(result, BAD + 2), at(result, BAD + 1))
        assert_same(result.pose.hip.pos[BAD + 1], result.pose.hip.pos[BAD], 1e-6)


def test_a_first_frame_is_settled_and_a_later_one_finite_however_long_it_is(played: Played):
    expected = at(played.row("nothing").result, 0)
    for dt in (0.0, 1.0, 1e4):
        assert_same(at(played.row(f"begins with {dt}").result, 0).pose, expected.pose, 1e-9)
    long = played.row("takes long")
    assert finite(long) and not long.result.faulty.any()
