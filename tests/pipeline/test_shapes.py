"""Arrays of the wrong shape are refused by name, before anything is computed with them."""

import dataclasses
import functools
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


def shapes_of(ik: jaxik.FootIK) -> list[tuple[int, ...]]:
    """Shapes of everything that a game reads from the result."""
    result = jax.eval_shape(jaxik.run, ik, RIG, GROUND, CLIP)
    outputs = result.pose, result.body, result.corrections, result.reached, result.aimed
    return [leaf.shape for leaf in jax.tree.leaves(outputs)]


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
    assert shapes_of(with_one_a_leg(ik, *per_leg)) == shapes_of(ik)


@pytest.mark.parametrize("call", ["init", "step", "resume", "run"])
@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("probe.ray_up", [0.1, 0.2, 0.3], "shape (3,), wanted (), the same for all legs, or (2,)"),
        ("probe.toe_ls", [0.1, 0.2], "shape (2,), wanted (3,), the same for all legs, or (2, 3)"),
        ("lock.enabled", [[True, False]], "shape (1, 2), wanted ()"),
        ("lean.tick_hz", [30.0], "shape (1,), wanted (), the same for all legs;"),
    ],
)
def test_every_way_in_names_the_parameter_and_what_it_may_be(call, name, value, message):
    ik = to_ik({name: value})
    state = jaxik.init(to_ik({}), RIG)
    calls = {
        "init": lambda: jaxik.init(ik, RIG),
        "step": lambda: jaxik.step(ik, RIG, GROUND, state, FRAME),
        "resume": lambda: jaxik.resume(ik, RIG, GROUND, state, CLIP),
        "run": lambda: jaxik.run(ik, RIG, GROUND, CLIP),
    }
    with pytest.raises(ValueError, match=f"^{name} has {re.escape(message)}"):
        calls[call]()


class Sinking(AbstractPelvis):
    """A rule of a user's own, which says nothing of legs."""

    depth: Leaf = parameter(0.1, unit="m", low=0.0, high=0.3, doc="How far the body sinks.")

    def advance(self, now, target, state):
        return PelvisState.at(-self.depth, -self.depth, now.sensed.up_ws)


def test_a_rule_of_ones_own_is_checked_too():
    ik = dataclasses.replace(to_ik({}), pelvis=Sinking())
    assert shapes_of(ik) == shapes_of(to_ik({}))
    with pytest.raises(ValueError, match=r"^pelvis.depth has shape \(2,\)"):
        shapes_of(with_one_a_leg(ik, "pelvis.depth"))


INPUTS = {"ik": to_ik({}), "rig": RIG, "terrain": GROUND, "frames": CLIP}


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("ik", r"^contact.ground_height has shape \(4,\), wanted \(\)"),
        ("rig", r"^rig.side has shape \(4, 2\), wanted \(legs,\)"),
        ("terrain", r"^terrain.up_ws has shape \(4, 3\), wanted \(3,\)"),
        ("frames", r"^frames.dt has shape \(4, 3\), wanted \(frames,\)"),
    ],
)
def test_several_characters_without_vmap_are_told_of_it_and_pass_with_it(argument, message):
    inputs = INPUTS | {argument: crowd(INPUTS[argument])}
    with pytest.raises(ValueError, match=f"{message}.*; many .* need jax.vmap or jaxik.lanes"):
        jax.eval_shape(lambda inputs: jaxik.run(**inputs), inputs)
    axes = {name: 0 if name == argument else None for name in INPUTS}
    # Tracing with lanes takes long, and which argument is batched is all the same to it.
    ways = [jax.vmap, *([functools.partial(jaxik.lanes, block=2)] if argument == "ik" else [])]
    for batched in ways:
        many = batched(lambda inputs: jaxik.run(**inputs).reached, in_axes=(axes,))
        assert jax.eval_shape(many, inputs).shape == (CHARACTERS, FRAMES, LEGS)


def test_a_frame_goes_to_step_and_a_clip_to_run():
    state = jaxik.init(to_ik({}), RIG)
    with pytest.raises(ValueError, match=r"^frames.dt has shape \(\).*single frame needs step"):
        jaxik.run(to_ik({}), RIG, GROUND, FRAME)
    with pytest.raises(ValueError, match=r"^frame.dt has shape \(3,\), wanted \(\); a clip needs"):
        jaxik.step(to_ik({}), RIG, GROUND, state, CLIP)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (
            lambda i: i["frames"].weight,
            jnp.ones((3, 4)),
            r"frames.weight .*\(3, 4\), .*\(3, 2\): 2 legs",
        ),
        (lambda i: i["frames"].slide, jnp.ones(2), r"frames.slide .*\(2,\), wanted \(3,\): 2 legs"),
        (lambda i: i["frames"].pose.toe.rot, jnp.ones((3, 2, 3)), r"pose.toe.rot .*\(3, 2, 4\)"),
        (lambda i: i["frames"].stride.known, jnp.ones((3, 1)), r"frames.stride.known .*\(3, 1\)"),
        (lambda i: i["rig"].side, jnp.ones(4), r"rig.knee_axis_ls .*\(2, 3\), wanted \(4, 3\)"),
        (lambda i: i["rig"].present, jnp.ones(3, bool), r"rig.present .*\(3,\), wanted \(2,\): 2"),
        (
            lambda i: i["terrain"],
            LegTerrains(GROUND, (GROUND,) * 3),
            r"terrain.legs has 3 terrains, the rig 2 legs",
        ),
        (
            lambda i: i["terrain"],
            LegTerrains(GROUND, (GROUND, crowd(GROUND))),
            r"terrain.legs\[1\].up_ws has shape \(4, 3\)",
        ),
        (
            lambda i: i["frames"].platforms_before,
            Transform.none(jnp.zeros((3, 2))),
            r"frames.platforms_before.pos .*\(3, 2, 0, 3\), wanted \(3, 0, 3\): .* as many platf",
        ),
        (
            lambda i: i["terrain"],
            moving(GROUND, 1),
            "^the terrain moves with platform 1, but platforms has 0 platforms, numbered from 0",
        ),
    ],
)
def test_arrays_that_disagree_on_legs_or_frames_are_named(where, value, message):
    wrong = eqx.tree_at(where, INPUTS, value)
    with pytest.raises(ValueError, match=message):
        jaxik.run(**wrong)


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
