"""Systems with randomly chosen rules: any rules of different stages work together."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.stages import target
from jaxik.world.skeleton import bone_lengths
from reference import sample_poses
from support.cases import QUICK, RIG
from support.clips import BROKEN, FLAT, animate, at, to_frames, to_rig, to_terrain, wandering

COUNT = 60  # frames
DRAWN = 5
WEIGHTS = jnp.array([1.0, 0.7])
TWISTS = jnp.array([0.0, 0.2])


def rules_of(stage: type) -> list[type]:
    """The rules of a stage: its subclasses that have no subclasses themselves."""
    children = [child for child in stage.__subclasses__() if child.__module__.startswith("jaxik.")]
    return [rule for child in children for rule in rules_of(child)] or [stage]


STAGES: dict[str, list[type]] = {
    field.name: rules_of(field.type)  # type: ignore[arg-type]
    for field in dataclasses.fields(jaxik.FootIK)
}


def draw() -> dict[str, jaxik.FootIK]:
    """Systems with the rules of each stage in random order, so that each rule occurs."""
    rng = np.random.default_rng(3)
    orders = {stage: rng.permutation(len(rules)) for stage, rules in STAGES.items()}
    return {
        f"drawn {index}": jaxik.FootIK(
            **{stage: rules[orders[stage][index % len(rules)]]() for stage, rules in STAGES.items()}
        )
        for index in range(DRAWN)
    }


BLENDS = draw()


@functools.partial(jax.jit, compiler_options=QUICK)
def run(iks: jaxik.FootIK, ground: Any, frames: jaxik.Frame) -> jaxik.Result:
    """The clip as a whole, for each system of a batch."""
    return jax.vmap(lambda ik: jaxik.run(ik, to_rig(RIG), ground, frames))(iks)


def batch(name: str) -> jaxik.FootIK:
    """The blend itself, and one with twisted legs that get only a part of foot IK."""
    iks = [
        parameter_tree.replace(BLENDS[name], {"leg.weight": weight, "leg.twist": twist})
        for weight, twist in zip(WEIGHTS, TWISTS, strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *iks)


@functools.cache
def clip() -> jaxik.Frame:
    return to_frames(wandering(RIG, np.random.default_rng(1), COUNT))


@functools.cache
def results(name: str) -> jaxik.Result:
    return run(batch(name), to_terrain(BROKEN), clip())


def test_all_rules_of_all_stages_occur_in_the_random_systems():
    for stage, rules in STAGES.items():
        assert len(rules) > 1
        used = {type(getattr(blend, stage)) for blend in BLENDS.values()}
        assert used == set(rules), stage


@pytest.mark.slow
@pytest.mark.parametrize("name", BLENDS)
def test_a_blend_is_finite_and_its_bones_keep_their_lengths(name: str):
    result = results(name)
    first, second = np.asarray(result.pose.knee.pos)
    assert np.abs(first - second).max() > 1e-3, "members of a batch keep their own parameters"
    for path, leaf in jax.tree_util.tree_leaves_with_path(result):
        name = jax.tree_util.keystr(path)
        may_be_infinite = ".rays." in name
        assert (np.isfinite(leaf) | (may_be_infinite & ~np.isnan(leaf))).all(), name
    for actual, expected in zip(bone_lengths(result.pose), bone_lengths(clip().pose), strict=True):
        np.testing.assert_allclose(actual, np.broadcast_to(expected, actual.shape), atol=1e-9)
    for joint in ("hip", "knee", "ankle", "toe"):
        size = np.linalg.norm(getattr(result.pose, joint).rot, axis=-1)
        np.testing.assert_allclose(size, 1.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", BLENDS)
def test_standing_on_flat_ground_moves_hips_and_ankles_no_more_than_sole_heights_differ(name: str):
    """Ankles are 0.08 m above their soles in the clip, which the target rule may see otherwise.

    Knees of nearly straight legs move further than that.
    """
    frames = to_frames(animate(RIG, count=COUNT))
    result = at(run(batch(name), to_terrain(FLAT), frames), 0)
    rule = BLENDS[name].target
    sole = 0.0
    if isinstance(rule, target.SoleTarget | target.ContactTarget):
        sole = abs(float(rule.foot_height) - sample_poses.ANKLE)
    for joint in ("hip", "ankle"):
        moved = getattr(result.pose, joint).pos - getattr(frames.pose, joint).pos
        assert np.linalg.norm(moved, axis=-1).max() < sole + 1e-9, joint
    cosine = np.abs(np.sum(result.pose.ankle.rot * frames.pose.ankle.rot, axis=-1))
    np.testing.assert_allclose(cosine, 1.0, atol=1e-9)
