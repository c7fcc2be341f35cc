"""What is said to be missing in a clip: motion that shows it determines the parameter.

Every phrase is checked on made motion of known systems: without what it asks for, the parameter is
not bounded on both sides; with it, it is. All other parameters stay at their truth.
"""

import dataclasses
import functools
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.clips import Clip
from fitting.experiment.problems import ClipData, make_scene
from fitting.inference.profiles.profile import Profile, make_profile
from fitting.motion.evidence import AT_LIMITS, EVENTS, describe_missing_motion, find_evidence
from fitting.motion.playback import play_all
from fitting.problem.problem import Problem, rho
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene, legs_ws, pelvis_ws
from fitting.problem.shared_world import run_scenes
from fitting.problem.space import free_parameter, from_fractions, make_space, present_value
from fitting.runtime.precision import with_floats
from fitting.synthetic import actions, walker
from fitting.synthetic.walker import Slip, WalkStyle
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.stages.probe import FootProbe
from jaxik.world import terrain
from jaxik.world.skeleton import Transform

SECONDS, FPS = 3.0, 30.0
FRAMES = round(SECONDS * FPS)
SPACING, HALF_WIDTH, BEHIND, AHEAD = 0.05, 1.0, 1.5, 7.0  # m, of all grounds: one program
POSITION, ROTATION = 0.002, 0.0087  # m and rad, sigmas
POSITIONS, ROTATIONS = ("ankle", "knee", "pelvis"), ("foot", "body")
SIGMAS: dict[str, float] = dict.fromkeys(POSITIONS, POSITION) | dict.fromkeys(ROTATIONS, ROTATION)
PLACES = np.linspace(0.01, 0.99, 31)  # of a parameter's range, on its scale

TRUTH = {  # limits that people reach
    "record": {
        "foot.max_pitch": 0.35, "foot.min_pitch": -0.4, "foot.max_roll": 0.15,
        "foot.min_roll": -0.15, "pelvis.limit": 0.15, "leg.min_knee_angle": 1.45,
        "lock.release_distance": 0.1, "lock.max_speed": 0.8,
        "target.rise_half_life": 0.03, "target.fall_half_life": 0.03,
        "probe.max_step_up": 0.35, "probe.max_step_down": 0.35, "probe.max_slope": 0.55,
    },
    "mec": {"pelvis.min_length": 0.6, "pelvis.max_length": 0.85, "foot.max_tilt": 0.2},
}  # fmt: skip


@functools.cache
def clip_of(name: str) -> Clip:
    """A walk, one whose feet slip, a body that stands, a run or a crouch."""
    style = WalkStyle(bend=0.0, knees=1.0)
    walk = walker.walk(SECONDS, FPS, 0, (), style)
    match name:
        case "walks":
            return walk
        case "slips":
            return walker.walk(SECONDS, FPS, 0, (Slip(0.2, 2.8, 0.25),), style)
        case "stands":
            return walk.select(np.full(FRAMES, 6))
    action = {"runs": actions.run, "crouches": actions.crouch}[name]
    return action(SECONDS, FPS).select(slice(0, FRAMES))


SHAPES: dict[str, Callable] = {  # heights by degrees or metres, and by x and z
    "ramp": lambda degrees, x, z: np.tan(np.radians(degrees)) * (np.clip(z, 0.7, 2.5) - 0.7),
    "across": lambda degrees, x, z: np.tan(np.radians(degrees)) * x,
    "step": lambda height, x, z: height * (z > 1.5),
    "level": lambda height, x, z: height,
}


@functools.cache
def ground_of(name: str) -> terrain.Terrain:
    """The ground of a name such as `ramp 20`."""
    shape, _, figure = name.partition(" ")
    x = np.arange(-HALF_WIDTH, HALF_WIDTH + SPACING / 2, SPACING)
    z = np.arange(-BEHIND, AHEAD + SPACING / 2, SPACING)
    heights = np.broadcast_to(SHAPES[shape](float(figure), x, z[:, None]), (len(z), len(x)))
    return terrain.heightfield(heights, SPACING, origin=(-HALF_WIDTH, 0.0, -BEHIND))


def system_of(name: str) -> jaxik.FootIK:
    """An original system, for the record with the limits of its probe."""
    ik = presets.mec(faithful=True)
    if name == "record":
        ik = dataclasses.replace(presets.record(faithful=True), probe=FootProbe())
    return with_floats(parameter_tree.replace(ik, TRUTH[name]), np.float64)


@functools.cache
def scene_of(clip: str, ground: str) -> Scene:
    """A clip on a ground, with itself as its reference."""
    return make_scene(ClipData(clip_of(clip), clip_of(clip), ground_of(ground)), SIGMAS)


@jax.jit
def motions(iks: jaxik.FootIK, scene: Scene) -> tuple[Transform, jax.Array, Transform]:
    """Pelvis, knees and ankles in the world, by each system of a batch."""

    def motion(ik: jaxik.FootIK) -> tuple[Transform, jax.Array, Transform]:
        (result,) = run_scenes(ik, (scene,))
        legs = legs_ws(scene, result)
        return pelvis_ws(scene, result), legs.knee.pos, legs.ankle

    return jax.vmap(motion)(iks)


def cost(pelvis: Any, knee: np.ndarray, ankle: Any) -> np.ndarray:
    """Half the squared distance from the last, the truth; an angle is twice its quaternions'."""
    rotations = np.concatenate([pelvis.rot[:, :, None], ankle.rot], axis=2)
    apart = [((rotations - sign * rotations[-1]) ** 2).sum(axis=-1) for sign in (1, -1)]
    positions = np.concatenate([pelvis.pos[:, :, None], knee, ankle.pos], axis=2)
    distances = ((positions - positions[-1]) ** 2).sum(axis=(1, 2, 3))
    angles = 4.0 * np.minimum(*apart).sum(axis=(1, 2))
    return 0.5 * (distances / POSITION**2 + angles / ROTATION**2)


@functools.cache
def moved(system: str, name: str, clip: str, ground: str) -> tuple[np.ndarray, Any]:
    """Values of a parameter, the last of them true, and what systems with these make of a clip."""
    ik = system_of(system)
    own = from_fractions(free_parameter(ik, name), PLACES)
    own = np.append(own, present_value(ik, name))
    iks = [parameter_tree.replace(ik, {name: x}) for x in own]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *iks)
    return own, jax.tree.map(np.asarray, motions(stacked, scene_of(clip, ground)))


def profile_of(
    system: str, name: str, clip: str, ground: str, cost: Callable[..., np.ndarray] = cost
) -> Profile:
    """The profile of a parameter with all others at their truth, and without a prior."""
    own, motion = moved(system, name, clip, ground)
    parameter, costs = free_parameter(system_of(system), name), cost(*motion)
    return make_profile(parameter, own[:, None], own, costs, np.zeros_like(costs))


FLAT, CROSS = "step 0", "across 5"
RECORD = {  # clip and ground without the motion, what is said, and with it
    "foot.max_pitch": ("walks", FLAT, "a foot turned toes up against", "walks", "ramp 15"),
    "foot.min_pitch": ("walks", "ramp -3", "toes down beyond 1.°", "walks", "ramp -25"),
    "foot.max_roll": ("walks", CROSS, "outer edge up beyond [456]°", "walks", "across 12"),
    "foot.min_roll": ("walks", CROSS, "outer edge down beyond [456]°", "walks", "across 12"),
    "pelvis.limit": ("walks", "step 0.1", r"by more than 0.1\d* m", "walks", "step 0.25"),
    "leg.max_knee_angle": ("crouches", FLAT, "end of a stride", "walks", FLAT),
    "leg.min_knee_angle": ("walks", FLAT, "a knee bent", "walks", "step 0.3"),
    "lock.release_distance": ("walks", FLAT, "by more than 0.0", "slips", FLAT),
    "lock.max_speed": ("stands", FLAT, "a foot that comes down", "walks", FLAT),
    "pelvis.airborne_half_life": ("walks", "level -0.1", "a run", "runs", "level -0.1"),
    "lock.lock_half_life": ("stands", FLAT, "still move", "walks", FLAT),
    "lock.unlock_half_life": ("stands", FLAT, "released", "walks", FLAT),
    "target.rise_half_life": ("walks", "step -0.1", "slopes up", "walks", "step 0.1"),
    "target.fall_half_life": ("walks", "step 0.1", "slopes down", "walks", "step -0.1"),
    "lean.forward_rate": ("walks", CROSS, "along the way", "walks", "ramp 5"),
    "lean.side_rate": ("walks", "ramp 5", "across the way", "walks", CROSS),
    "contact.planted_height": ("stands", FLAT, "come down", "walks", "step 0.1"),
    "contact.raised_height": ("stands", FLAT, "leave the ground", "walks", "step 0.1"),
    "probe.max_step_up": ("walks", "step 0.1", "steps up", "walks", "step 0.4"),
    "probe.max_step_down": ("walks", "step -0.1", "steps down", "walks", "step -0.4"),
    "probe.max_slope": ("walks", CROSS, "slopes", "walks", "across 35"),
}
MEC = {
    "foot.max_tilt": ("walks", CROSS, "steeper than [567]°", "walks", "across 15"),
    "pelvis.max_length": ("crouches", FLAT, "a leg stretched", "walks", "step -0.2"),
    "pelvis.min_length": ("walks", FLAT, "a leg shortened", "crouches", FLAT),
}
CASES = {"record": RECORD, "mec": MEC}


def test_every_phrase_is_checked():
    assert {name for cases in CASES.values() for name in cases} == {*AT_LIMITS, *EVENTS}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "name"), [(system, name) for system, cases in CASES.items() for name in cases]
)
def test_motion_that_is_said_to_be_missing_determines_the_parameter(system, name):
    clip, ground, said, other_clip, other_ground = CASES[system][name]
    ik, profile = system_of(system), profile_of(system, name, clip, ground)
    assert profile.verdict in ("flat", "at least", "at most")
    unit, doc = parameter_tree.declarations(ik)[name].unit, parameter_tree.docs(ik)[name]
    parameter = free_parameter(ik, name)
    assert re.search(said, describe_missing_motion(parameter, unit, doc, profile, 0.1))
    found = profile_of(system, name, other_clip, other_ground)
    assert found.verdict == "two-sided"
    low, high = found.interval
    assert low <= present_value(ik, name) <= high


@pytest.mark.slow
def test_the_evidence_of_a_limit_is_the_second_in_which_it_acts():
    """A step up 1.5 m ahead; the rises are those of the loss, with the tails of the fit."""
    clip, ground, tails = "walks", "step 0.25", 2.0

    def student(pelvis: Any, knee: np.ndarray, ankle: Any) -> np.ndarray:
        positions = np.concatenate([pelvis.pos[:, :, None], knee, ankle.pos], axis=2)
        distances = (positions - positions[-1]) / POSITION
        losses = np.asarray(rho(distances**2, "student", tails))
        return 0.5 * losses.sum(axis=(1, 2, 3))

    profile = profile_of("record", "pelvis.limit", clip, ground, student)
    ik, scene = system_of("record"), scene_of(clip, ground)
    _, motion = moved("record", "pelvis.limit", clip, ground)
    pelvis, knee_ws, ankle = jax.tree.map(lambda x: jnp.asarray(x[-1]), motion)
    exact = dataclasses.replace(scene.reference, pelvis=pelvis, knee_ws=knee_ws, ankle=ankle)
    none = jnp.asarray(jnp.inf)
    sigmas = dataclasses.replace(scene.sigmas, foot=none, body=none)
    scene = dataclasses.replace(scene, reference=exact, sigmas=sigmas)
    space = make_space(ik, [free_parameter(ik, "pelvis.limit")])
    problem = Problem(space, (scene,), residuals_of_scenes, "student", tails=jnp.asarray(tails))
    below, above = find_evidence(problem, play_all(ik, problem.data), profile)
    assert (below.side, above.side) == ("below", "above")
    assert below.value < profile.interval[0] and above.value > profile.interval[1]
    rises = dict(zip(profile.values, profile.data_rises, strict=True))
    forward = np.asarray(pelvis.pos[:, 2])
    for evidence in (below, above):
        first = round(evidence.start * FPS)
        assert forward[first : first + round(FPS)].max() > 1.5
        assert evidence.kind in ("pelvis", "knee") and evidence.clip == 0
        assert 0.3 < evidence.share <= 1.0
        assert sum(evidence.rises) == pytest.approx(rises[evidence.value], rel=0.01)
