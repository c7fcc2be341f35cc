"""What is said to be missing in a clip: motion that shows it determines the parameter.

Every phrase is checked on made motion of known systems: without what it asks for, the parameter is
not bounded on both sides; with it, it is. All other parameters stay at their truth.
"""

import dataclasses
import functools
import re
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.analysis.evidence import find_evidence
from fitting.analysis.missing_motion import AT_LIMITS, EVENTS, describe_missing_motion
from fitting.datasets.clips import Clip
from fitting.datasets.synthetic import actions, walker
from fitting.datasets.synthetic.speed_profile import Slip
from fitting.datasets.synthetic.walker import WalkStyle
from fitting.experiments.problems import ClipData, make_scene
from fitting.inference.profiles.profile import Profile, make_profile
from fitting.problem.free_parameters import free_parameter
from fitting.problem.problem import Problem
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.simulation import _motion
from fitting.problem.space import from_fractions, make_space
from fitting.runtime.precision import in_float64, with_floats
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.world import terrain

pytestmark = pytest.mark.slow

SECONDS, FPS = 3.0, 30.0
FRAMES = round(SECONDS * FPS)
SPACING, HALF_WIDTH, BEHIND, AHEAD = 0.05, 1.0, 1.5, 7.0  # m, of all grounds: one program
SIGMAS = {"ankle": 0.002, "knee": 0.002, "pelvis": 0.002, "foot": 0.0087, "body": 0.0087}
PLACES = np.linspace(0.01, 0.99, 31)  # of a parameter's range, on its scale

SYSTEMS = {  # the original systems, with limits that people reach
    "record": functools.partial(presets.record, faithful=True),
    "mec": functools.partial(presets.mec, faithful=True),
    "ozz": presets.ozz,
}
TRUTH = {
    "record": {
        "foot.max_pitch": 0.35, "foot.min_pitch": -0.4, "foot.max_roll": 0.15,
        "foot.min_roll": -0.15, "pelvis.limit": 0.15, "leg.min_knee_angle": 1.45,
        "lock.release_distance": 0.1, "lock.max_speed": 0.8,
        "target.rise_half_life": 0.03, "target.fall_half_life": 0.03,
    },
    "mec": {"pelvis.min_length": 0.6, "pelvis.max_length": 0.85, "foot.max_tilt": 0.2},
    "ozz": {
        "root.enabled": False, "probe.max_step_up": 0.2, "probe.max_step_down": 0.2,
        "probe.max_slope": 0.3,
    },
}  # fmt: skip


@functools.cache
def clip_of(name: str) -> Clip:
    """A walk, one whose feet slip, a body that stands, a jump or a crouch."""
    style = WalkStyle(bend=0.0, knees=1.0)
    walk = walker.walk(SECONDS, FPS, 0, (), style)
    match name:
        case "walks":
            return walk
        case "slips":
            return walker.walk(SECONDS, FPS, 0, (Slip(0.2, 2.8, 0.25),), style)
        case "stands":
            return walk.select(np.full(FRAMES, 6))
        case "jumps":
            return actions.jump(SECONDS, FPS).select(slice(0, FRAMES))
        case _:
            return actions.crouch(SECONDS, FPS).select(slice(0, FRAMES))


def ramp(degrees: float) -> Callable:
    return lambda x, z: np.tan(np.radians(degrees)) * (np.clip(z, 0.7, 2.5) - 0.7)


def across(degrees: float) -> Callable:
    return lambda x, z: np.tan(np.radians(degrees)) * x + 0 * z


def step(height: float) -> Callable:
    return lambda x, z: height * (z > 1.5) + 0 * x


@functools.cache
def ground_of(name: str) -> terrain.Terrain:
    """The ground of a name such as `ramp 20`."""
    shape, _, figure = name.partition(" ")
    height = {"ramp": ramp, "across": across, "step": step}[shape](float(figure or 0))
    x = np.arange(-HALF_WIDTH, HALF_WIDTH + SPACING / 2, SPACING)
    z = np.arange(-BEHIND, AHEAD + SPACING / 2, SPACING)
    heights = np.broadcast_to(height(x, z[:, None]), (len(z), len(x)))
    return terrain.heightfield(heights, SPACING, origin=(-HALF_WIDTH, 0.0, -BEHIND))


@functools.cache
@in_float64
def problem_of(system: str, clip: str, ground: str) -> Problem:
    """The motion of a system on a clip and a ground, exactly, as its own reference."""
    ik = with_floats(parameter_tree.replace(SYSTEMS[system](), TRUTH[system]), np.float64)
    data = ClipData(clip_of(clip), clip_of(clip), ik.probe.prepare(ground_of(ground)))
    scene = make_scene(data, SIGMAS)
    pelvis, knee_ws, ankle, _ = _motion(ik, scene)
    reference = dataclasses.replace(scene.reference, pelvis=pelvis, knee_ws=knee_ws, ankle=ankle)
    scene = eqx.tree_at(lambda scene: scene.reference, scene, reference)
    space = make_space(ik, [free_parameter(ik, name) for name in CASES[system]])
    return Problem(space, (scene,), residuals_of_scenes)


@eqx.filter_jit
def cost(problem: Problem, u: jax.Array) -> jax.Array:
    """Of the data alone."""
    return 0.5 * jnp.sum(problem.residuals(u)[: -problem.space.size] ** 2)


@in_float64
def profile_of(problem: Problem, name: str) -> Profile:
    """The profile of a parameter with all others at their truth, and without a prior."""
    space = problem.space
    index = space.names.index(name)
    parameter, truth = space.parameters[index], np.asarray(space.values(space.pack({})))
    own = np.append(from_fractions(parameter, PLACES), truth[index])
    path = np.tile(truth, (len(own), 1))
    path[:, index] = own
    rows = [space.pack(dict(zip(space.names, row, strict=True))) for row in path]
    costs = np.array([float(cost(problem, u)) for u in rows])
    return make_profile(parameter, path, own, costs, np.zeros_like(costs))


def words(problem: Problem, name: str, profile: Profile) -> str:
    """What the report says is missing."""
    ik = problem.space.system
    parameter = problem.space.parameters[problem.space.names.index(name)]
    unit = parameter_tree.declarations(ik)[name].unit
    return describe_missing_motion(parameter, unit, parameter_tree.docs(ik)[name], profile, 0.1)


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
    "pelvis.off_gain": ("walks", "step 0.1", "a jump", "jumps", "step 0.1"),
    "lock.lock_half_life": ("stands", FLAT, "still move", "walks", FLAT),
    "lock.unlock_half_life": ("stands", FLAT, "released", "walks", FLAT),
    "target.rise_half_life": ("walks", "step -0.1", "slopes up", "walks", "step 0.1"),
    "target.fall_half_life": ("walks", "step 0.1", "slopes down", "walks", "step -0.1"),
    "lean.forward_rate": ("walks", CROSS, "along the way", "walks", "ramp 5"),
    "lean.side_rate": ("walks", "ramp 5", "across the way", "walks", CROSS),
    "contact.planted_height": ("stands", FLAT, "come down", "walks", "step 0.1"),
    "contact.raised_height": ("stands", FLAT, "leave the ground", "walks", "step 0.1"),
}
MEC = {
    "foot.max_tilt": ("walks", CROSS, "steeper than [567]°", "walks", "across 15"),
    "pelvis.max_length": ("crouches", FLAT, "a leg stretched", "walks", "step -0.2"),
    "pelvis.min_length": ("walks", FLAT, "a leg shortened", "crouches", FLAT),
}
OZZ = {
    "probe.max_step_up": ("walks", "step 0.1", "steps up", "walks", "step 0.25"),
    "probe.max_step_down": ("walks", "step -0.1", "steps down", "walks", "step -0.25"),
    "probe.max_slope": ("walks", CROSS, "slopes", "walks", "across 20"),
}
CASES = {"record": RECORD, "mec": MEC, "ozz": OZZ}


def test_every_phrase_is_checked():
    assert {name for cases in CASES.values() for name in cases} == {*AT_LIMITS, *EVENTS}


@pytest.mark.parametrize(
    ("system", "name"), [(system, name) for system, cases in CASES.items() for name in cases]
)
def test_motion_that_is_said_to_be_missing_determines_the_parameter(system, name):
    clip, ground, said, other_clip, other_ground = CASES[system][name]
    without = problem_of(system, clip, ground)
    profile = profile_of(without, name)
    assert profile.verdict in ("flat", "at least", "at most")
    assert re.search(said, words(without, name, profile))
    found = profile_of(problem_of(system, other_clip, other_ground), name)
    assert found.verdict == "two-sided"
    low, high = found.interval
    assert low <= float(parameter_tree.get(without.space.system, name).mean()) <= high


def test_the_evidence_of_a_limit_is_the_second_in_which_it_acts():
    """The slope begins after 0.7 m; a foot is on it until it ends after 2.5 m."""
    problem = problem_of("record", "walks", "ramp 15")
    profile = profile_of(problem, "foot.max_pitch")
    below, above = find_evidence(problem, np.asarray(problem.space.pack({})), profile)
    assert (below.side, above.side) == ("below", "above")
    assert below.value < profile.interval[0] and above.value > profile.interval[1]
    ankles = problem.data[0].reference.ankle.pos
    for evidence in (below, above):
        first = round(evidence.start * FPS)
        ahead = np.asarray(ankles[first : first + round(FPS), :, 2])
        assert ahead.max() > 0.7 and ahead.min() < 2.5
        assert evidence.kind == "foot" and evidence.clip == 0 and 0.5 < evidence.share <= 1.0
    rises = dict(zip(profile.values, profile.data_rises, strict=True))
    for evidence in (below, above):
        assert sum(evidence.rises) == pytest.approx(rises[evidence.value], rel=1e-6)


def test_evidence_has_the_tails_of_the_fit():
    """Heavier tails take less of a residual for evidence."""
    problem = problem_of("record", "walks", "ramp 15")
    profile = profile_of(problem, "foot.max_pitch")
    heavy, light = (
        find_evidence(
            dataclasses.replace(problem, loss="student", tails=jnp.asarray(tails)),
            np.asarray(problem.space.pack({})),
            profile,
        )[0]
        for tails in (2.0, 50.0)
    )
    assert sum(heavy.rises) < sum(light.rises)
