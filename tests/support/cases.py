"""Cases of what a parameter does: from one value to another, a measure rises or falls."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxik
from jaxik import HARD
from jaxik.maths import parameter_tree, quat, vec
from reference import characters, sample_poses
from support.clips import FRAMES, animate, make_rig, padded, planes, to_frames, to_ik, to_rig
from support.clips import to_terrain as to_ground
from support.strides import walk

RIG = make_rig()
QUICK: dict[str, Any] = {
    "xla_backend_optimization_level": 0
}  # compiling takes far longer than running
FORWARD, UP, LEFT = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)

# Measures: numbers that summarise a result, each over all frames.


def measures(result: jaxik.Result, frames: jaxik.Frame) -> dict[str, jax.Array]:
    """Means in m and rad; leans and foot rotations as the sine of their angle."""
    after = result.trace.advanced.state
    effector = result.trace.advanced.effector
    hip, knee, ankle = (getattr(result.pose, name).pos for name in ("hip", "knee", "ankle"))
    up = frames.pose.hip.pos * 0 + jnp.asarray(UP)
    foot_rot = quat.multiply(result.pose.ankle.rot, quat.conjugate(frames.pose.ankle.rot))
    toes = quat.rotate(foot_rot, up * 0 + jnp.asarray(FORWARD))
    edge = quat.rotate(foot_rot, up * 0 + jnp.asarray(LEFT))[..., 1]
    body = quat.rotate(result.body.rot, up[:, 0])
    thigh, shin = hip - knee, ankle - knee
    bend = vec.safe_arctan2(vec.length(vec.cross(thigh, shin)), vec.dot(thigh, shin))
    ankle_ws = jax.vmap(lambda w, a: w.apply(a))(frames.world_from_model, ankle)
    numbers = {
        "root height": result.trace.sensed.root_ws[..., 1],
        "target height": effector.target_ws[..., 1],
        "target left": effector.target_ws[..., 0],
        "target forward": effector.target_ws[..., 2],
        "pelvis height": after.pelvis.height,
        "pelvis forward": after.pelvis.offset_ws[..., 2],
        "half height": after.pelvis.half_height,
        "knee angle": bend,
        "knee left": knee[..., 0],
        "yaw": toes[..., 0],
        "pitch": toes[..., 1],
        "left pitch": toes[:, 0, 1],
        "roll": edge,
        "left roll": edge[:, 0],
        "lean forward": body[..., 2],
        "lean right": -body[..., 0],
        "contact": result.trace.sensed.contact.weight,
        "found": result.trace.sensed.foothold.found,
        "weight": effector.weight,
        "slip": vec.length(ankle_ws[1:] - ankle_ws[:-1]),
        "miss": vec.length(ankle_ws - effector.target_ws),
    }
    ball = jax.vmap(lambda w, a: w.apply(a))(frames.world_from_model, result.pose.toe.pos)
    standing = result.trace.sensed.contact.planted[1:]
    numbers["ball slip"] = standing * vec.length(ball[1:] - ball[:-1])
    if isinstance(after.lock, jaxik.stages.lock.LockState):
        numbers |= {"locked": after.lock.locked, "offset": vec.length(after.lock.offset)}
    means = {name: jnp.mean(number) for name, number in numbers.items()}
    return means | {"everything": total((result.pose, result.body, after))}


def total(tree: Any) -> jax.Array:
    """A sum of all floats of a tree with different weights."""
    leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))
    return sum(
        (jnp.sum(jnp.cos(jnp.arange(x.size) + 1.0) * x.ravel()) for x in leaves), jnp.zeros(())
    )


Inputs = tuple[jaxik.FootIK, jaxik.Frame, Any, jaxik.State]  # system, clip, terrain, memory


def read(
    floats: Any, rest: Any, gate: Any, rig: jaxik.Rig | None = None
) -> tuple[dict[str, jax.Array], jaxik.State]:
    """The measures of a clip, and the memory after it."""
    ik, frames, ground, state = eqx.combine(floats, rest)
    rig = to_rig(RIG) if rig is None else rig
    after, result = jaxik.resume(ik, rig, ground, state, frames, gate)
    return measures(result, frames), after


@functools.partial(jax.jit, compiler_options=QUICK)
def measured(inputs: Inputs, tangents: Any, gate: Any) -> tuple[dict, dict, jaxik.State]:
    """The measures, their derivatives along `tangents` (one per float), and the memory after."""
    floats, rest = eqx.partition(inputs, eqx.is_inexact_array)
    return jax.jvp(lambda x: read(x, rest, gate), (floats,), (tangents,), has_aux=True)


def still(inputs: Any) -> Any:
    """A tangent of zeros."""
    return jax.tree.map(jnp.zeros_like, eqx.filter(inputs, eqx.is_inexact_array))


# Situations of four seconds each.


def drifting(speed: float) -> Callable[[float], list[float]]:
    return lambda time: [speed * time, 0.0, 0.0]


def hovering(time: float) -> np.ndarray:
    return sample_poses.standing((0.13, 0.13))


def stepping_up(time: float) -> np.ndarray:
    return sample_poses.standing((0.08, 0.08) if time < 1.0 else (0.3, 0.3))


def limping(time: float) -> np.ndarray:
    """Feet of which one always requests more than the other."""
    lift = 0.02 * np.sin(2.9 * time)
    return np.array([[0.11, 0.123 + lift, 0.071], [-0.1, 0.141 - lift, -0.03]])


CLIPS: dict[str, dict[str, Any]] = {
    "standing": {},
    "sliding": {"slide": 1.0},
    "begins to slide": {"slide": lambda time: float(time > 1.0)},
    "ceases to slide": {"slide": lambda time: float(time < 1.0)},
    "toes up": {"foot": 0.3},
    "hovering": {"ankles": hovering},
    "lifts its feet": {"ankles": stepping_up},
    "goes forward": {"place": lambda time: [0.0, 0.0, 0.6 * time]},
    "slides forward": {"place": lambda time: [0.0, 0.0, 0.6 * time], "slide": 1.0},
    "limps": {"ankles": limping, "place": lambda time: [0.01, 0.0, 0.013 + 0.61 * time]},
    "limps on its toes": {
        "ankles": limping,
        "foot": -0.2,
        "place": lambda time: [0.05 * time, 0.0, 0.37],
    },
    "drifts": {"place": drifting(0.3)},
    "drifts slowly": {"place": drifting(0.05)},
    "sinks": {"place": drifting(0.02), "hip_height": lambda time: 0.9 - 0.1 * time},
    "stops": {"place": lambda time: [0.0, 0.0, 0.6 * min(time, 1.0)]},
}


def speeding_up(time: float) -> list[float]:
    return [0.0, 0.0, 0.1 * time**2]


def rising(time: float) -> np.ndarray:
    return sample_poses.standing((0.08 + 0.03 * time, 0.08 + 0.03 * time))


def swinging(fraction: float, known: bool = True) -> list[characters.Frame]:
    """Feet half way between two footholds, in plan, when `fraction` of the swing is over.

    With unknown footholds these are predicted from the speed of the character.
    """
    frame = animate(RIG, sample_poses.standing((0.15, 0.15)), count=1)[0]
    half_way = 0.4 * np.asarray(FORWARD)
    stride = characters.Stride(
        standing=np.zeros(2),
        last_ws=frame.toe.pos - half_way,
        next_ws=frame.toe.pos + half_way,
        fraction=np.full(2, fraction),
        known=np.full(2, float(known)),
    )
    velocity = 0.8 * np.asarray(FORWARD)
    return padded([dataclasses.replace(frame, stride=stride, velocity_ws=velocity)])


CLIPS |= {
    "speeds up": {"place": speeding_up},
    "lifts its feet slowly": {"ankles": rising},
    "turns": {"heading": lambda time: 0.2 * time},
}
STRIDES: dict[str, Callable[[], list[characters.Frame]]] = {
    "walks": lambda: walk(RIG, FRAMES),
    "lifts off": lambda: swinging(0.25),
    "comes down": lambda: swinging(0.75),
    "swings, footholds unknown": lambda: swinging(0.5, known=False),
}
ANKLE_DEEP = planes((0.2, 0.0, 0.3))
RAMP_UP, RAMP_DOWN = planes((0, 0, 0), (0.2, 0, -0.1)), planes((0, 0, 0), (-0.2, 0, 0.2))
DESCENT = planes((-0.1, 0, 0))
KINK = planes((0, 0, 0), (0.5, 0, -0.125))  # begins to rise 0.2 m ahead of the ankles


@functools.cache
def clip(name: str) -> jaxik.Frame:
    return to_frames(STRIDES[name]() if name in STRIDES else animate(RIG, **CLIPS[name]))


def posed(hip: Any, knee: Any, ankle: Any, count: int = 1) -> jaxik.Frame:
    """Two equal legs with joints at these positions, m, model space, and identity rotations."""
    frame = animate(RIG, count=1)[0]
    per_leg = lambda point: np.tile(np.asarray(point, float), (2, 1))  # noqa: E731
    frame = dataclasses.replace(
        frame,
        hip=frame.hip._replace(pos=per_leg(hip)),
        knee=frame.knee._replace(pos=per_leg(knee)),
        ankle=frame.ankle._replace(pos=per_leg(ankle)),
        toe=frame.toe._replace(pos=per_leg(ankle)),
    )
    return to_frames(padded([frame], count))


class Case(NamedTuple):
    """From the first value to the second, the measure changes in the direction of `sign`."""

    name: str
    clip: str
    ground: Any
    values: tuple[Any, Any]
    measure: str
    sign: int
    base: dict[str, Any] = {}
    slope: bool = True  # False where a ray hits or misses: that has no derivative
    before: dict[str, Any] | None = (
        None  # values in an earlier pass of the clip, whose memory is kept
    )

    @property
    def leaf(self) -> str:
        return self.name.split("[")[0]


def inputs_of(case: Case, value: Any, preset: str) -> Inputs:
    ik, frames = to_ik(case.base | {case.leaf: value}, preset), clip(case.clip)
    inputs = ik, frames, to_ground(case.ground), jaxik.init(ik, to_rig(RIG))
    if case.before is None:
        return inputs
    earlier = (to_ik(case.base | case.before, preset), *inputs[1:])
    return (*inputs[:3], measured(earlier, still(earlier), HARD)[2])


def run_case(
    case: Case, value: Any, preset: str, gate: Any = HARD, tangent: Any = None
) -> tuple[float, float]:
    """The case's measure at a value, and its derivative along a tangent of the leaf."""
    inputs = inputs_of(case, value, preset)
    tangents = still(inputs)
    if tangent is not None:
        tangents = (parameter_tree.replace(tangents[0], {case.leaf: tangent}), *tangents[1:])
    values, derivatives, _ = measured(inputs, tangents, gate)
    return float(values[case.measure]), float(derivatives[case.measure])


def assert_effect(case: Case, preset: str) -> None:
    """Asserts that the measure changes as the case says."""
    low, high = (run_case(case, value, preset)[0] for value in case.values)
    assert case.sign * (high - low) > 1e-4, (low, high)


def has_slope(case: Case, preset: str) -> bool:
    """Whether the case is about a number, not a switch."""
    return jnp.issubdtype(parameter_tree.get(to_ik({}, preset), case.leaf).dtype, jnp.inexact)


def assert_slope(case: Case, preset: str, gate: Any) -> None:
    """Asserts that the derivative at the middle is the difference quotient, with the case's sign.

    Hard decisions have no derivative, so those of thresholds are not compared there.
    """
    low, high = (np.asarray(value, float) for value in case.values)
    middle, tangent = (low + high) / 2 + 1e-3 * (high - low), (high - low)
    value, slope = run_case(case, middle, preset, gate, tangent)
    step = 1e-5
    ahead, behind = (run_case(case, middle + s * step * tangent, preset, gate)[0] for s in (1, -1))
    quotient = (ahead - behind) / (2 * step)
    assert np.isfinite([value, slope]).all()
    declared = parameter_tree.declarations(to_ik({}, preset)).get(case.leaf)
    decided = gate is HARD and declared is not None and declared.kind == "threshold"
    if not decided:
        np.testing.assert_allclose(slope, quotient, rtol=1e-4, atol=1e-8)
    if gate is not HARD and case.slope:
        assert case.sign * slope > 0
    if not case.slope:
        assert slope == 0
