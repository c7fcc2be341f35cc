"""Arrays of the wrong shape are refused by name, before anything is computed with them."""

import dataclasses
import functools
import operator
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Leaf, parameter
from jaxik.stages.pelvis import AbstractPelvis, PelvisState
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import LegTerrains, moving
from support.clips import animate, make_rig, planes, to_frames, to_ik, to_rig, to_terrain

LEGS, FRAMES, CHARACTERS = 2, 3, 4
RIG, GROUND = to_rig(make_rig()), to_terrain(planes((0.1, 0.0, 0.05)))
CLIP = to_frames(animate(make_rig(), count=FRAMES))
FRAME = jax.tree.map(lambda leaf: leaf[0], CLIP)
SYSTEMS = ("record", "ozz", "unreal", "mec", "stride", "by speed")


def crowd(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * CHARACTERS), tree)


def assert_right_shapes(ik: jaxik.FootIK) -> None:
    """Asserts that all a game reads from the result is as large as it should be."""
    result = jax.eval_shape(jaxik.run, ik, RIG, GROUND, CLIP)
    places = [leaf.shape for leaf in jax.tree.leaves((result.pose, result.body))]
    assert places == [(FRAMES, LEGS, 3), (FRAMES, LEGS, 4)] * 4 + [(FRAMES, 3), (FRAMES, 4)]
    turns = [(FRAMES, LEGS, 4)] * 3 + [(FRAMES, 4)] * 2
    corrections = [leaf.shape for leaf in jax.tree.leaves(result.corrections)]
    assert corrections == turns[: len(corrections)]
    assert result.reached.shape == result.aimed.shape == (FRAMES, LEGS)


def with_one_a_leg(ik: jaxik.FootIK, *names: str) -> jaxik.FootIK:
    """The system with one value a leg for these parameters."""
    leaves = {name: parameter_tree.get(ik, name) for name in names}
    return parameter_tree.replace(ik, {name: [leaf] * LEGS for name, leaf in leaves.items()})


BODY = ("root.", "lean.", "pelvis.")
ONE_FOR_ALL = ("lock.hold_ball", "separation.distance", "effector.latch")
PER_LEG_IN_THE_PELVIS = ("pelvis.min_length", "pelvis.max_length", "pelvis.extension")


@pytest.mark.parametrize("system", SYSTEMS)
def test_each_parameter_is_refused_per_leg_or_gives_results_of_the_right_shapes(system):
    ik = to_ik({}, system)
    per_leg = []
    for name in (slot.name for slot in parameter_tree.slots(ik)):
        moves_body = name.startswith(BODY) and name not in PER_LEG_IN_THE_PELVIS
        if moves_body or name in ONE_FOR_ALL:
            message = rf"^{name} has shape \(2,\), wanted \(\), the same for all legs; .*jax.vmap"
            with pytest.raises(ValueError, match=message):
                jaxik.init(with_one_a_leg(ik, name), RIG)
        else:
            per_leg.append(name)
    assert_right_shapes(with_one_a_leg(ik, *per_leg))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("probe.ray_up", [0.1, 0.2, 0.3], "shape (3,), wanted (), the same for all legs, or (2,)"),
        ("probe.toe_ls", [0.1, 0.2], "shape (2,), wanted (3,), the same for all legs, or (2, 3)"),
        ("lock.enabled", [[True, False]], "shape (1, 2), wanted ()"),
        ("lean.tick_hz", [30.0], "shape (1,), wanted (), the same for all legs;"),
    ],
)
def test_every_way_in_names_the_parameter_and_what_it_may_be(name, value, message):
    ik, state = to_ik({name: value}), jaxik.init(to_ik({}), RIG)
    for call in (
        lambda: jaxik.init(ik, RIG),
        lambda: jaxik.step(ik, RIG, GROUND, state, FRAME),
        lambda: jaxik.resume(ik, RIG, GROUND, state, CLIP),
        lambda: jaxik.run(ik, RIG, GROUND, CLIP),
    ):
        with pytest.raises(ValueError, match=f"^{name} has {re.escape(message)}"):
            call()


class Sinking(AbstractPelvis):
    """A rule of a user's own, which says nothing of legs."""

    depth: Leaf = parameter(0.1, unit="m", low=0.0, high=0.3, doc="How far the body sinks.")

    def advance(self, now, target, state):
        return PelvisState.at(-self.depth, -self.depth, now.sensed.up_ws)


def test_a_rule_of_ones_own_is_checked_too():
    ik = dataclasses.replace(to_ik({}), pelvis=Sinking())
    assert_right_shapes(ik)
    with pytest.raises(ValueError, match=r"^pelvis.depth has shape \(2,\)"):
        jaxik.init(with_one_a_leg(ik, "pelvis.depth"), RIG)


INPUTS = {"ik": to_ik({}), "rig": RIG, "terrain": GROUND, "frames": CLIP}


MANY = {
    "ik": r"^contact.ground_height has shape \(4,\), wanted \(\)",
    "rig": r"^rig.side has shape \(4, 2\), wanted \(legs,\)",
    "terrain": r"^terrain.up_ws has shape \(4, 3\), wanted \(3,\)",
    "frames": r"^frames.dt has shape \(4, 3\), wanted \(frames,\)",
}


def test_several_characters_without_vmap_are_told_of_it_and_pass_with_it():
    for argument, message in MANY.items():
        inputs = INPUTS | {argument: crowd(INPUTS[argument])}
        with pytest.raises(ValueError, match=f"{message}.*; many .* need jax.vmap or jaxik.lanes"):
            jaxik.run(**inputs)
    for batched in (jax.vmap, functools.partial(jaxik.lanes, block=2)):
        many = batched(lambda inputs: jaxik.run(**inputs).reached)
        assert jax.eval_shape(many, crowd(INPUTS)).shape == (CHARACTERS, FRAMES, LEGS)


def test_a_frame_goes_to_step_and_a_clip_to_run():
    state = jaxik.init(to_ik({}), RIG)
    with pytest.raises(ValueError, match=r"^frames.dt has shape \(\).*single frame needs step"):
        jaxik.run(to_ik({}), RIG, GROUND, FRAME)
    with pytest.raises(ValueError, match=r"^frame.dt has shape \(3,\), wanted \(\); a clip needs"):
        jaxik.step(to_ik({}), RIG, GROUND, state, CLIP)


@pytest.mark.parametrize(
    ("argument", "name", "value", "message"),
    [
        ("frames", "weight", jnp.ones((3, 4)), r"weight .*\(3, 4\), .*\(3, 2\): 2 legs"),
        ("frames", "slide", jnp.ones(2), r"slide .*\(2,\), wanted \(3,\): 2 legs"),
        ("frames", "pose.toe.rot", jnp.ones((3, 2, 3)), r"pose.toe.rot .*\(3, 2, 4\)"),
        ("frames", "stride.known", jnp.ones((3, 1)), r"stride.known .*\(3, 1\)"),
        ("rig", "side", jnp.ones(4), r"knee_axis_ls .*\(2, 3\), wanted \(4, 3\)"),
        ("rig", "present", jnp.ones(3, bool), r"present .*\(3,\), wanted \(2,\): 2"),
        (
            "frames",
            "platforms_before",
            Transform.none(jnp.zeros((3, 2))),
            r"platforms_before.pos .*\(3, 2, 0, 3\), wanted \(3, 0, 3\): .* as many platf",
        ),
    ],
)
def test_arrays_that_disagree_on_legs_or_frames_are_named(argument, name, value, message):
    part = eqx.tree_at(operator.attrgetter(name), INPUTS[argument], value)
    with pytest.raises(ValueError, match=rf"{argument}\.{message}"):
        jaxik.run(**INPUTS | {argument: part})


@pytest.mark.parametrize(
    ("ground", "message"),
    [
        (LegTerrains(GROUND, (GROUND,) * 3), "terrain.legs has 3 terrains, the rig 2 legs"),
        (
            LegTerrains(GROUND, (GROUND, crowd(GROUND))),
            r"terrain.legs\[1\].up_ws has shape \(4, 3\)",
        ),
        (
            moving(GROUND, 1),
            "^the terrain moves with platform 1, but platforms has 0 platforms, numbered from 0",
        ),
    ],
)
def test_a_terrain_that_does_not_fit_is_refused(ground, message):
    with pytest.raises(ValueError, match=message):
        jaxik.run(**INPUTS | {"terrain": ground})


@pytest.mark.parametrize(
    ("ik", "rig", "part"),
    [
        (to_ik({}, "ozz"), RIG, "root"),
        (to_ik({}, "by speed"), RIG, "contact"),
        (to_ik({}), to_rig(make_rig(legs=3)), "target"),
    ],
)
def test_memory_of_another_system_or_rig_is_refused(ik, rig, part):
    state = jaxik.init(ik, rig)
    for call in (
        lambda: jaxik.step(to_ik({}), RIG, GROUND, state, FRAME),
        lambda: jaxik.resume(to_ik({}), RIG, GROUND, state, CLIP),
    ):
        with pytest.raises(ValueError, match=f"^state.{part} is the memory of another system"):
            call()
