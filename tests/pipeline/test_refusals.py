"""What does not fit is refused by name: shapes by all calls, before anything is computed with
them, numbers by `jaxik.check`."""

import dataclasses
import functools
import operator
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxik
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Leaf, parameter
from jaxik.pipeline.preconditions import FRACTIONS, POSITIVE, SIGNED_FRACTIONS, SIZES, UNIT
from jaxik.stages.pelvis import AbstractPelvis, PelvisState
from jaxik.world.skeleton import Transform
from jaxik.world.terrain import LegTerrains, moving
from support.cases import stacked
from support.clips import at, make_rig, planes, to_frames, to_ik, to_rig, to_terrain, wandering

LEGS, FRAMES, CHARACTERS = 2, 3, 4
IK, RIG, GROUND = to_ik({}), to_rig(make_rig()), to_terrain(planes((0.06, 0.04, 0.1)))
CLIP = to_frames(wandering(make_rig(), np.random.default_rng(3), FRAMES))
CLIP = jax.tree.map(np.asarray, CLIP)
FRAME = at(CLIP, 0)
SYSTEMS = ("record", "ozz", "unreal", "mec", "stride", "by speed")
INPUTS = {"ik": IK, "rig": RIG, "terrain": GROUND, "frames": CLIP}


def crowd(tree: Any) -> Any:
    return stacked([tree] * CHARACTERS)


# Parameters.


def assert_right_shapes(ik: jaxik.FootIK) -> None:
    """Asserts that all a game reads from the result is as large as it should be."""
    result = jax.eval_shape(jaxik.run, ik, RIG, GROUND, CLIP)
    places = [leaf.shape for leaf in jax.tree.leaves((result.pose, result.body))]
    assert places == [(FRAMES, LEGS, 3), (FRAMES, LEGS, 4)] * 4 + [(FRAMES, 3), (FRAMES, 4)]
    of_legs, of_body = (FRAMES, LEGS, 4), (FRAMES, 4)
    wanted = dict.fromkeys(("hip", "knee", "ankle", "toe"), of_legs) | {"stretch": (FRAMES, LEGS)}
    wanted |= dict.fromkeys(("spine", "head", "twist"), of_body)
    corrections = {
        name: leaf.shape for name, leaf in vars(result.corrections).items() if leaf is not None
    }
    assert corrections == {name: wanted[name] for name in corrections}
    assert {"hip", "knee", "ankle"} <= corrections.keys()
    assert result.reached.shape == result.aimed.shape == (FRAMES, LEGS)


def with_one_a_leg(ik: jaxik.FootIK, *names: str) -> jaxik.FootIK:
    """The system with one value a leg for these parameters."""
    leaves = {name: parameter_tree.get(ik, name) for name in names}
    return parameter_tree.replace(ik, {name: [leaf] * LEGS for name, leaf in leaves.items()})


BODY = ("root.", "lean.", "pelvis.")
ONE_FOR_ALL = ("lock.hold_ball", "separation.distance", "effector.latch")
ONE_FOR_ALL += ("warp.max_angle", "warp.pelvis_share", "warp.half_life")
PER_LEG_IN_THE_PELVIS = (
    "pelvis.min_length", "pelvis.max_length", "pelvis.extension", "pelvis.min_extension",
)  # fmt: skip


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
        ("lean.half_life", [0.1], "shape (1,), wanted (), the same for all legs;"),
    ],
)
def test_every_way_in_names_the_parameter_and_what_it_may_be(name, value, message):
    ik, state = to_ik({name: value}), jaxik.init(IK, RIG)
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
    ik = dataclasses.replace(IK, pelvis=Sinking())
    assert_right_shapes(ik)
    with pytest.raises(ValueError, match=r"^pelvis.depth has shape \(2,\)"):
        jaxik.init(with_one_a_leg(ik, "pelvis.depth"), RIG)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("pelvis.limits", (3,), "no parameter named 'pelvis.limits'; nearest is 'pelvis.limit"),
        ("pelvis.limit", (2,), r"shape \(2,\), wanted \(3,\): 3 frames"),
        ("pelvis.limit", (3, 2), r"shape \(3, 2\), wanted \(3,\)"),
        ("foot.max_pitch", (3, 3), r"wanted \(3,\) or \(3, 2\)"),
        ("pelvis.limit", (), r"shape \(\), wanted \(3,\)"),
    ],
)
def test_a_wrong_track_is_refused(name, shape, message):
    with pytest.raises(ValueError, match=message):
        jaxik.run(**INPUTS, tracks={name: jnp.ones(shape)})


@pytest.mark.parametrize("block", [0, -3])
def test_a_block_without_frames_is_refused(block):
    with pytest.raises(ValueError, match=f"at least 1 frame.*got {block}"):
        jaxik.run(**INPUTS, block=block)


# Characters, frames, terrains and memory.


@pytest.mark.slow
def test_several_characters_without_vmap_are_told_of_it_and_pass_with_it():
    for argument, message in {
        "ik": r"^contact.ground_height has shape \(4,\), wanted \(\)",
        "rig": r"^rig.side has shape \(4, 2\), wanted \(legs,\)",
        "terrain": r"^terrain.up_ws has shape \(4, 3\), wanted \(3,\)",
        "frames": r"^frames.dt has shape \(4, 3\), wanted \(frames,\)",
    }.items():
        inputs = INPUTS | {argument: crowd(INPUTS[argument])}
        with pytest.raises(ValueError, match=f"{message}.*; many .* need jax.vmap or jaxik.lanes"):
            jaxik.run(**inputs)
    inputs = INPUTS | {"ik": jaxik.presets.unreal(faithful=True)}  # which is traced soonest
    for batched in (jax.vmap, functools.partial(jaxik.lanes, block=2)):
        many = batched(lambda inputs: jaxik.run(**inputs).reached)
        assert jax.eval_shape(many, crowd(inputs)).shape == (CHARACTERS, FRAMES, LEGS)


def test_a_frame_goes_to_step_and_a_clip_to_run():
    with pytest.raises(ValueError, match=r"^frames.dt has shape \(\).*single frame needs step"):
        jaxik.run(**INPUTS | {"frames": FRAME})
    with pytest.raises(ValueError, match=r"^frame.dt has shape \(3,\), wanted \(\); a clip needs"):
        jaxik.step(IK, RIG, GROUND, jaxik.init(IK, RIG), CLIP)


NO_PLATFORMS = Transform.none(jnp.zeros((3, 2)))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("frames.weight", np.ones((3, 4)), r"weight .*\(3, 4\), .*\(3, 2\): 2 legs"),
        ("frames.slide", np.ones(2), r"slide .*\(2,\), wanted \(3,\): 2 legs"),
        ("frames.pose.toe.rot", np.ones((3, 2, 3)), r"pose.toe.rot .*\(3, 2, 4\)"),
        ("frames.stride.known", np.ones((3, 1)), r"stride.known .*\(3, 1\)"),
        ("rig.side", np.ones(4), r"knee_axis_ls .*\(2, 3\), wanted \(4, 3\)"),
        ("rig.present", np.ones(3, bool), r"present .*\(3,\), wanted \(2,\): 2"),
        (
            "frames.platforms_before",
            NO_PLATFORMS,
            r"platforms_before.pos .*\(3, 2, 0, 3\), wanted \(3, 0, 3\): .* as many platf",
        ),
    ],
)
def test_arrays_that_disagree_on_legs_or_frames_are_named(name, value, message):
    argument, _, leaf = name.partition(".")
    part = eqx.tree_at(operator.attrgetter(leaf), INPUTS[argument], value)
    with pytest.raises(ValueError, match=rf"{argument}\.{message}"):
        jaxik.run(**INPUTS | {argument: part})


@pytest.mark.parametrize(
    ("ground", "message"),
    [
        (LegTerrains(GROUND, (GROUND,) * 3), "terrain.legs has 3 terrains, the rig 2 legs"),
        (LegTerrains(GROUND, (GROUND, crowd(GROUND))), r"terrain.legs\[1\].up_ws .* \(4, 3\)"),
        (moving(GROUND, 1), "^the terrain moves with platform 1, but platforms has 0 platforms, "),
    ],
)
def test_a_terrain_that_does_not_fit_is_refused(ground, message):
    with pytest.raises(ValueError, match=message):
        jaxik.run(**INPUTS | {"terrain": ground})


@pytest.mark.parametrize(
    ("system", "legs", "part"),
    [("ozz", 2, "root"), ("by speed", 2, "contact"), ("record", 3, "target")],
)
def test_memory_of_another_system_or_rig_is_refused(system, legs, part):
    state = jaxik.init(to_ik({}, system), to_rig(make_rig(legs=legs)))
    for call, frames in ((jaxik.step, FRAME), (jaxik.resume, CLIP)):
        with pytest.raises(ValueError, match=f"^state.{part} is the memory of another system"):
            call(IK, RIG, GROUND, state, frames)


# Numbers.


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
    for path in sorted((Path(__file__).parents[2] / "data" / "clips").glob("*.npz")):
        clip = fitting.load_clip(path)
        jaxik.check(fitting.frames_from_clip(clip), clip.rig, GROUND)
    for frames in (CLIP, FRAME, crowd(CLIP)):
        jaxik.check(frames, RIG, GROUND)
    jaxik.check(CLIP, RIG, LegTerrains(GROUND, (GROUND, GROUND)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(value: float):
    for name in arrays(CLIP):
        with pytest.raises(ValueError, match=rf"^frame\{name}\[2.* is .*(nan|inf)"):
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


def test_an_up_that_is_no_unit_vector_is_refused():
    for up in ((0.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, np.nan, 0.0)):
        wrong = dataclasses.replace(GROUND, up_ws=jnp.array(up))
        with pytest.raises(ValueError, match=r"^terrain\.up_ws is .*; wanted a length of 1"):
            jaxik.check(CLIP, RIG, wrong)
        with pytest.raises(ValueError, match=r"^terrain\.legs\[1\]\.up_ws is "):
            jaxik.check(CLIP, RIG, LegTerrains(GROUND, (GROUND, wrong)))


def test_the_count_of_wrong_places_is_told():
    wrong = dataclasses.replace(CLIP, weight=np.full_like(CLIP.weight, 2.0))
    with pytest.raises(ValueError, match=r"frame\.weight\[0, 0\] is 2\.0; .*; 5 more are wrong"):
        jaxik.check(wrong, RIG, GROUND)


def test_legs_that_are_not_there_may_hold_anything():
    rig = dataclasses.replace(RIG, present=jnp.array([True, False]))
    frames = spoilt(CLIP, ".pose.knee.pos", np.nan)
    jaxik.check(frames, rig, GROUND)
    with pytest.raises(ValueError, match="pose.knee.pos"):
        jaxik.check(frames, RIG, GROUND)


def test_inside_jit_it_says_where_to_call_it():
    with pytest.raises(TypeError, match="call it outside jit"):
        jax.jit(lambda frame: jaxik.check(frame, RIG, GROUND))(CLIP)
