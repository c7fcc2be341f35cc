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
from support.cases import QUICK
from support.clips import at, make_rig, planes, to_frames, to_rig, to_terrain, wandering

SLOW = (pytest.param(preset, marks=pytest.mark.slow) for preset in ("ozz", "unreal", "stride"))
PRESETS = ["record", "mec", *SLOW]  # the first two remember most
COUNT, BAD = 16, 8
RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
LEG_FIELDS = ("pose", "weight", "foot_speed", "toe_speed", "stride")
BOTH, SECOND, NONE = (True, True), (False, True), (False, False)  # legs that are there


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


def sequence(*singles: jaxik.Frame) -> jaxik.Frame:
    """A clip of as many frames as all others: these, and then the last one again and again."""
    padding = [singles[-1]] * (COUNT - len(singles))
    return jax.tree.map(lambda *x: np.stack(x), *singles[:COUNT], *padding)


def damages(frame: jaxik.Frame):
    """Names of a frame's arrays, and the frame with a number replaced in each."""
    leaves, structure = jax.tree.flatten(frame)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(frame)]
    for i, (name, leaf) in enumerate(zip(names, leaves, strict=True)):
        if leaf.size:
            for value in (np.nan, np.inf, -np.inf, 1e30):
                damaged = np.array(leaf)
                damaged[(0,) * leaf.ndim] = value
                yield (
                    f"{name} = {value}",
                    structure.unflatten([*leaves[:i], damaged, *leaves[i + 1 :]]),
                )


@functools.cache
def rows() -> list[Row]:
    """The clip as it is, with a bad frame before frame `BAD`, with pauses, and with long frames."""
    each = [at(frames(), index) for index in range(COUNT)]
    before, here, after = each[:BAD], each[BAD], each[BAD:]
    many = [Row(present, "nothing", frames()) for present in (BOTH, SECOND, NONE)]
    for name, bad in damages(here):
        row = Row(BOTH, name, sequence(*before, bad, *after))
        many += [row] if not row.of_leg else [row._replace(present=p) for p in (BOTH, SECOND, NONE)]

    def lasting(frame: jaxik.Frame, dt: float) -> jaxik.Frame:
        return dataclasses.replace(frame, dt=np.full_like(frame.dt, dt))

    for dt in (0.0, -1.0):
        pause = [lasting(here, dt)] * 2
        many.append(Row(BOTH, f"pause of {dt}", sequence(*before, here, *pause, *after[1:])))
    for dt in (0.0, 1.0, 1e4):
        many.append(Row(BOTH, f"begins with {dt}", sequence(lasting(each[0], dt), *each[1:])))
    many.append(Row(BOTH, "takes long", sequence(each[0], lasting(here, 1e4), *each[1:])))
    return many


class Played(NamedTuple):
    """The solved rows (rows, frames, ...): results without trace, and memory after each frame."""

    result: jaxik.Result
    state: jaxik.State

    def row(self, event: str, present: tuple[bool, bool] = BOTH) -> "Played":
        """That with an event."""
        (number,) = (n for n, row in enumerate(rows()) if row[:2] == (present, event))
        return at(self, number)


@functools.cache
def played(preset: str) -> Played:
    ik = getattr(jaxik.presets, preset)()

    @functools.partial(jax.jit, compiler_options=QUICK)
    @jax.vmap
    def run(present: jax.Array, clip: jaxik.Frame) -> Played:
        rig = dataclasses.replace(RIG, present=present)
        result = jaxik.run(ik, rig, GROUND, clip)
        return Played(dataclasses.replace(result, trace=None), result.trace.advanced.state)

    clips = jax.tree.map(lambda *x: np.stack(x), *(row.clip for row in rows()))
    return jax.device_get(run(np.array([row.present for row in rows()]), clips))


def assert_same(tree: Any, expected: Any, atol: float = 0.0, name: str = "") -> None:
    for got, wanted in zip(jax.tree.leaves(tree), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=atol, err_msg=name)


def finite(tree: Any) -> bool:
    return all(np.isfinite(x).all() for x in jax.tree.leaves(tree))


def damaged(present: tuple[bool, bool] = BOTH) -> list[Row]:
    return [row for row in rows() if row.event.startswith(".") and row.present == present]


@pytest.mark.parametrize("preset", PRESETS)
def test_one_bad_number_leaves_memory_as_it_was(preset: str):
    """Whatever array has it, the frame or the leg is flagged and passed through."""
    animated, identity = at(frames(), BAD).pose, np.array([1.0, 0.0, 0.0, 0.0])
    for row in damaged():
        now, name = played(preset).row(row.event), row.event
        result = at(now.result, BAD)
        np.testing.assert_array_equal(result.faulty, [True, not row.of_leg], err_msg=name)
        assert not now.result.faulty[np.arange(COUNT) != BAD].any(), name
        assert finite(now), name
        if not row.of_leg:
            assert_same(at(now.state, BAD), at(now.state, BAD - 1), name=name)
            assert_same(result.pose, animated, 1e-6, name)
            assert_same(result.body.pos, np.zeros(3), name=name)
            assert not result.reached.any() and not result.aimed.any(), name
        for correction in (result.corrections.hip, result.corrections.knee):
            np.testing.assert_allclose(correction[0], identity, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_next_frame_goes_on_as_if_the_bad_one_had_not_been(preset: str):
    usual = at(played(preset).row("nothing"), slice(BAD, COUNT - 1))
    for row in damaged():
        if not row.of_leg:
            later = at(played(preset).row(row.event), slice(BAD + 1, COUNT))
            assert_same(later, usual, name=row.event)


@pytest.mark.parametrize("preset", PRESETS)
def test_legs_that_are_not_there_may_hold_anything(preset: str):
    """Sums over legs take in what has the weight 0, which makes NaN of what is infinite."""
    for present in (SECOND, NONE):
        expected = played(preset).row("nothing", present).result.pose.ankle.pos[:BAD, 1]
        later = played(preset).row("nothing", present).result.pose.ankle.pos[BAD, 1]
        for row in damaged(present):
            now = played(preset).row(row.event, present)
            assert finite(now) and not now.result.faulty.any(), row.event
            ankles = now.result.pose.ankle.pos[:, 1]
            assert_same(ankles[: BAD + 1], np.stack([*expected, later]), 1e-9, row.event)


@pytest.mark.parametrize("preset", PRESETS)
def test_nothing_moves_in_a_pause(preset: str):
    for dt in (0.0, -1.0):
        result, state = played(preset).row(f"pause of {dt}")
        assert not result.faulty.any()
        for still in (BAD + 1, BAD + 2):
            assert_same(at(state, still), at(state, BAD))
        assert_same(at(result, BAD + 2), at(result, BAD + 1))
        assert_same(result.pose.hip.pos[BAD + 1], result.pose.hip.pos[BAD], 1e-6)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_first_frame_of_any_length_is_settled(preset: str):
    expected = at(played(preset).row("nothing").result, 0)
    for dt in (0.0, 1.0, 1e4):
        first = at(played(preset).row(f"begins with {dt}").result, 0)
        assert_same(first.pose, expected.pose, 1e-9)


@pytest.mark.parametrize("preset", PRESETS)
def test_after_a_long_frame_everything_is_where_it_is_going(preset: str):
    long = played(preset).row("takes long")
    assert finite(long) and not long.result.faulty.any()
