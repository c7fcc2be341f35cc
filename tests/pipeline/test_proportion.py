"""What comes out moves in proportion to what goes in: equal floats decide nothing."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from support import clips
from support.cases import QUICK, stacked
from support.clips import BROKEN, to_frames, to_rig, to_terrain

FRAMES = 90
JITTER, LARGEST = 1e-7, 1e-5  # of each number that goes in; m, of what comes out
FRACTIONS = ("weight", "grounded", "slide", "standing", "fraction", "known")
SIZES = ("foot_speed", "toe_speed")
ROWS, STEPS = 5, 20  # clips; of a weight from 0 to 1
# Weights of the right leg, and how that of the left one goes into it.
OTHERS = ((0.0, 0.0), (0.3, 0.0), (1.0, 0.0), (0.0, 1.0))
STEEPEST = 4.0  # times a full switch, over which no part of a switch moves anything
GAMES = ("ozz", "unreal", "mec")
PRESETS = ("record", *GAMES, "stride")
QUICKEST = "unreal"  # to compile
LIKEWISE = [pytest.param(name, marks=pytest.mark.slow) for name in PRESETS if name != QUICKEST]
RNG = np.random.default_rng(5)


def wandering() -> jaxik.Frame:
    """Walks and stands, with speeds, slides and footholds of all kinds."""
    rig = clips.make_rig()
    return to_frames(clips.wandering(rig, np.random.default_rng(3), FRAMES, stand=(0.3, 0.45)))


def at_the_ends(frames: jaxik.Frame) -> Iterator[jaxik.Frame]:
    """The clip with weights that are 0 or 1: of one leg, of none, of the character in the air."""
    number, ones = np.arange(FRAMES)[:, None], np.ones((FRAMES, 2))
    whole = dataclasses.replace(frames, grounded=jnp.ones(FRAMES), slide=jnp.zeros(FRAMES))
    weights = (ones, 0.0 * ones, (number // 30 + np.arange(2)) % 2 * ones)
    yield from (dataclasses.replace(whole, weight=jnp.asarray(weight)) for weight in weights)
    in_air = number[:, 0] // 15 % 2
    yield dataclasses.replace(whole, weight=jnp.asarray(ones), grounded=jnp.asarray(1.0 * in_air))


def jittered(frames: jaxik.Frame) -> jaxik.Frame:
    """Each float off by up to `JITTER`, but still in its range."""

    def jitter(path: Any, leaf: jax.Array) -> jax.Array:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        name = path[-1].name
        numbers = np.asarray(leaf) + RNG.uniform(-JITTER, JITTER, leaf.shape)
        if name == "rot":
            numbers /= np.linalg.norm(numbers, axis=-1, keepdims=True)
        if name in (*FRACTIONS, *SIZES):
            numbers = np.clip(numbers, 0.0, 1.0 if name in FRACTIONS else np.inf)
        return jnp.asarray(numbers)

    return jax.tree_util.tree_map_with_path(jitter, frames)


@pytest.fixture(scope="module", params=[QUICKEST, *LIKEWISE])
def result(request) -> jaxik.Result:
    """All that a preset makes of the clips, of these jittered, and of frames with any weights."""
    ik, rig = getattr(jaxik.presets, request.param)(), to_rig(clips.make_rig())
    for name in ("leg.allow_stretch", "foot.bend_toes", "probe.simple_in_flight"):
        ik = parameter_tree.with_option(ik, name, True)
    frames = wandering()
    orientation = 3.2 * jnp.sin(jnp.arange(FRAMES) / 9.0)
    frames = dataclasses.replace(frames, orientation=orientation)
    frames = dataclasses.replace(frames, restart=jnp.zeros(FRAMES, bool))
    rows = [frames, *at_the_ends(frames)]
    assert len(rows) == ROWS
    alone = dataclasses.replace(frames, restart=jnp.ones(FRAMES, bool))
    steps = np.linspace(0.0, 1.0, STEPS + 1)
    faint = [
        dataclasses.replace(alone, weight=jnp.tile(jnp.array([w, other + share * w]), (FRAMES, 1)))
        for other, share in OTHERS
        for w in steps
    ]
    run = jax.jit(jax.vmap(jaxik.run, (None, None, None, 0)), compiler_options=QUICK)
    return run(ik, rig, to_terrain(BROKEN), stacked([*rows, *map(jittered, rows), *faint]))


def test_a_jitter_of_all_that_goes_in_moves_nothing_by_more_than_its_share(result):
    for joint in ("hip", "knee", "ankle", "toe"):
        places = np.asarray(getattr(result.pose, joint).pos)
        apart = np.abs(places[ROWS : 2 * ROWS] - places[:ROWS]).max(axis=(2, 3))
        assert apart.max() < LARGEST, (joint, apart.max(axis=1), apart.argmax(axis=1))
    reached = np.asarray(result.reached)
    assert np.array_equal(reached[:ROWS], reached[ROWS : 2 * ROWS])


def test_part_of_a_switch_of_a_leg_moves_nothing_by_more_than_its_share_of_the_whole(result):
    """In each frame by itself: what is decided over time may be decided earlier."""
    for joint in ("hip", "knee", "ankle", "toe"):
        places = np.asarray(getattr(result.pose, joint).pos)[2 * ROWS :]
        places = places.reshape(len(OTHERS), STEPS + 1, *places.shape[1:])
        whole = np.linalg.norm(places[:, -1] - places[:, 0], axis=-1).max()
        steps = np.linalg.norm(np.diff(places, axis=1), axis=-1).max(axis=(2, 3))
        assert whole > 0.05 and steps.max() <= STEEPEST / STEPS * whole, (joint, whole, steps)


# No comparison asks whether floats are equal.


def equations(program: Any) -> Iterator[Any]:
    for equation in program.eqns:
        yield equation
        for inner in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
        ):
            if hasattr(inner, "eqns"):
                yield from equations(getattr(inner, "jaxpr", inner))


def float_equalities(function: Any, *inputs: Any) -> list[str]:
    """Where a program compares floats by `==` or `!=`, other than for NaN."""
    return [
        str(equation.source_info.traceback)
        for equation in equations(jax.make_jaxpr(function)(*inputs).jaxpr)
        if equation.primitive.name in ("eq", "ne")
        and jnp.issubdtype(equation.invars[0].aval.dtype, jnp.floating)
        and equation.invars[0] is not equation.invars[1]
    ]


@pytest.mark.parametrize(
    ("preset", "gate"),
    [
        ("record", jaxik.HARD),
        ("stride", jaxik.HARD),
        *(pytest.param(name, jaxik.HARD, marks=pytest.mark.slow) for name in GAMES),
        pytest.param("stride", jaxik.Smooth(1.0), marks=pytest.mark.slow),
    ],
    ids=["record", "stride", *GAMES, "stride, smooth"],
)
def test_no_program_asks_whether_floats_are_equal(preset: str, gate: Any):
    ik, rig, ground = getattr(jaxik.presets, preset)(), to_rig(clips.make_rig()), to_terrain(BROKEN)
    assert not float_equalities(jaxik.run, ik, rig, ground, wandering(), gate)
    assert float_equalities(lambda x: jnp.where(x == 0, 1.0, x), 0.5), "the check notices them"
