"""What `jaxik.check` refuses, and that the pipeline's own examples pass."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxik
from jaxik.pipeline.preconditions import FRACTIONS, POSITIVE, SIGNED_FRACTIONS, SIZES, UNIT
from jaxik.world.terrain import LegTerrains
from support.clips import make_rig, planes, to_frames, to_rig, to_terrain, wandering

RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
CLIP = jax.tree.map(np.asarray, to_frames(wandering(make_rig(), np.random.default_rng(3), 6)))
SHIPPED = sorted((Path(__file__).parents[2] / "data" / "clips").glob("*.npz"))
WRONG = {
    **dict.fromkeys(UNIT, (1.5, "a length of 1")),
    **dict.fromkeys(FRACTIONS, (1.5, "0 to 1")),
    **dict.fromkeys(SIGNED_FRACTIONS, (-1.5, "-1 to 1")),
    **dict.fromkeys(SIZES, (-0.1, "0 or more, finite")),
    **dict.fromkeys(POSITIVE, (0.0, "more than 0, finite")),
}


def arrays(tree) -> list[str]:
    named = jax.tree_util.tree_leaves_with_path(tree)
    return [jax.tree_util.keystr(path) for path, x in named if x.size and x.dtype != bool]


def spoilt(tree, name: str, value: float):
    """The tree with the last number, or vector, of an array replaced."""

    def spoil(path, leaf):
        if jax.tree_util.keystr(path) == name:
            leaf = np.array(leaf)
            leaf[(-1,) * leaf.ndim] = value
        return leaf

    return jax.tree_util.tree_map_with_path(spoil, tree)


def test_sound_data_pass():
    for path in SHIPPED:
        clip = fitting.load_clip(path)
        jaxik.check(fitting.frames_from_clip(clip), clip.rig, GROUND)
    jaxik.check(CLIP, RIG, GROUND)
    jaxik.check(jax.tree.map(lambda x: x[0], CLIP), RIG, GROUND)
    jaxik.check(jax.tree.map(lambda x: np.stack([x, x]), CLIP), RIG, GROUND)
    jaxik.check(CLIP, RIG, LegTerrains(GROUND, (GROUND, GROUND)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(value: float):
    for name in arrays(CLIP):
        with pytest.raises(ValueError, match=rf"^frame\{name}\[5.* is .*(nan|inf)"):
            jaxik.check(spoilt(CLIP, name, value), RIG, GROUND)


@pytest.mark.parametrize("part", ["frame", "rig"])
def test_numbers_out_of_range_are_refused(part: str):
    sound = {"frame": CLIP, "rig": RIG}
    for name in arrays(sound[part]):
        if (field := name.rsplit(".", 1)[1]) in WRONG:
            value, wanted = WRONG[field]
            trees = sound | {part: spoilt(sound[part], name, value)}
            with pytest.raises(ValueError, match=rf"^{part}\{name}\[.*\] is .*; wanted {wanted}"):
                jaxik.check(trees["frame"], trees["rig"], GROUND)


@pytest.mark.parametrize("up", [(0.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, np.nan, 0.0)])
def test_an_up_that_is_no_unit_vector_is_refused(up: tuple):
    wrong = dataclasses.replace(GROUND, up_ws=jnp.array(up))
    with pytest.raises(ValueError, match=r"^terrain\.up_ws is .*; wanted a length of 1"):
        jaxik.check(CLIP, RIG, wrong)
    with pytest.raises(ValueError, match=r"^terrain\.legs\[1\]\.up_ws is "):
        jaxik.check(CLIP, RIG, LegTerrains(GROUND, (GROUND, wrong)))


def test_the_count_of_wrong_places_is_told():
    wrong = dataclasses.replace(CLIP, weight=jnp.full_like(CLIP.weight, 2.0))
    with pytest.raises(ValueError, match=r"frame\.weight\[0, 0\] is 2\.0; .*; 11 more are wrong"):
        jaxik.check(wrong, RIG, GROUND)


def test_legs_that_are_not_there_may_hold_anything():
    rig = dataclasses.replace(RIG, present=jnp.array([True, False]))
    jaxik.check(spoilt(CLIP, ".pose.knee.pos", np.nan), rig, GROUND)
    with pytest.raises(ValueError, match="pose.knee.pos"):
        jaxik.check(spoilt(CLIP, ".pose.knee.pos", np.nan), RIG, GROUND)


def test_inside_jit_it_says_where_to_call_it():
    with pytest.raises(TypeError, match="call it outside jit"):
        jax.jit(lambda frame: jaxik.check(frame, RIG, GROUND))(CLIP)
