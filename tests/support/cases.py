"""Cases of what a parameter does: from one value to another, a measure rises or falls.

All cases of a system are rows of one batch, with either gate, so that a system is one program.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxik
from jaxik import HARD, Smooth
from jaxik.maths import parameter_tree, quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.stages import contact, foot, lean, pelvis
from jaxik.world import terrain
from reference import characters, sample_poses
from support.clips import animate, make_rig, padded, planes, to_frames, to_ik, to_rig, to_terrain
from support.strides import walk

RIG = make_rig()
QUICK: dict[str, Any] = {
    "xla_backend_optimization_level": 0
}  # compiling takes far longer than running
FORWARD, UP, LEFT = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)


class Either(AbstractGate):
    """`HARD`, or `Smooth(1.0)` where `blurred`, which may differ between the rows of a batch."""

    blurred: jax.Array
    soft: Smooth = eqx.field(default_factory=lambda: Smooth(1.0))

    def _of_both(self, method: str, *operands: jax.Array, **band: float) -> jax.Array:
        sharp, soft = (getattr(gate, method)(*operands, **band) for gate in (HARD, self.soft))
        return jnp.where(self.blurred, soft, sharp)

    def below(self, x: jax.Array, threshold: jax.Array, *, band: float) -> jax.Array:
        return self._of_both("below", x, threshold, band=band)

    def choose(self, weight: jax.Array, yes: jax.Array, no: jax.Array) -> jax.Array:
        return self._of_both("choose", weight, yes, no)

    def clip(self, x: jax.Array, low: jax.Array, high: jax.Array, *, band: float) -> jax.Array:
        return self._of_both("clip", x, low, high, band=band)

    def minimum(self, x: jax.Array, *, band: float) -> jax.Array:
        return self._of_both("minimum", x, band=band)


def stacked(trees: Sequence[Any]) -> Any:
    """The trees as rows of one, by NumPy: JAX would compile a program for each shape."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


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
    ankle_ws, ball_ws = (
        jax.vmap(jaxik.Transform.apply)(frames.world_from_model, joint.pos)
        for joint in (result.pose.ankle, result.pose.toe)
    )
    standing = result.trace.sensed.contact.planted[1:]
    numbers = {
        "root height": result.trace.sensed.root_ws[..., 1],
        "target height": effector.target_ws[..., 1],
        "target left": effector.target_ws[..., 0],
        "target forward": effector.target_ws[..., 2],
        "pelvis height": after.pelvis.height,
        "pelvis forward": after.pelvis.offset_ws[..., 2],
        "half height": after.pelvis.half_height,
        "knee angle": vec.safe_arctan2(vec.length(vec.cross(thigh, shin)), vec.dot(thigh, shin)),
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
        "ball slip": standing * vec.length(ball_ws[1:] - ball_ws[:-1]),
        "miss": vec.length(ankle_ws - effector.target_ws),
    }
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


# Situations of four seconds each.

COUNT, HZ = 80, 20.0


def drifting(speed: float) -> Callable[[float], list[float]]:
    return lambda time: [speed * time, 0.0, 0.0]


def ankles_at(height: Callable[[float], float]) -> Callable[[float], np.ndarray]:
    return lambda time: sample_poses.standing((height(time), height(time)))


CLIPS: dict[str, dict[str, Any]] = {
    "standing": {},
    "sliding": {"slide": 1.0},
    "begins to slide": {"slide": lambda time: float(time > 1.0)},
    "ceases to slide": {"slide": lambda time: float(time < 1.0)},
    "toes up": {"foot": 0.3},
    "hovering": {"ankles": ankles_at(lambda time: 0.13)},
    "lifts its feet": {"ankles": ankles_at(lambda time: 0.08 if time < 1.0 else 0.3)},
    "rises slowly": {"ankles": ankles_at(lambda time: 0.08 + 0.03 * time)},
    "goes forward": {"place": lambda time: [0.0, 0.0, 0.6 * time]},
    "slides forward": {"place": lambda time: [0.0, 0.0, 0.6 * time], "slide": 1.0},
    "speeds up": {"place": lambda time: [0.0, 0.0, 0.1 * time**2]},
    "stops": {"place": lambda time: [0.0, 0.0, 0.6 * min(time, 1.0)]},
    "turns": {"heading": lambda time: 0.2 * time},
    "drifts": {"place": drifting(0.3)},
    "drifts slowly": {"place": drifting(0.05)},
    "sinks": {"place": drifting(0.02), "hip_height": lambda time: 0.9 - 0.1 * time},
}


def swinging(fraction: float, known: bool = True) -> characters.Frame:
    """Feet half way between two footholds, in plan, when `fraction` of the swing is over.

    With unknown footholds these are predicted from the speed of the character.
    """
    frame = animate(RIG, sample_poses.standing((0.15, 0.15)), count=1, hz=HZ)[0]
    half_way = 0.4 * np.asarray(FORWARD)
    stride = characters.Stride(
        standing=np.zeros(2),
        last_ws=frame.toe.pos - half_way,
        next_ws=frame.toe.pos + half_way,
        fraction=np.full(2, fraction),
        known=np.full(2, float(known)),
    )
    return dataclasses.replace(frame, stride=stride, velocity_ws=0.8 * np.asarray(FORWARD))


STRIDES: dict[str, Callable[[], list[characters.Frame]]] = {
    "walks": lambda: walk(RIG, COUNT, hz=HZ),
    "lifts off": lambda: padded([swinging(0.25)], COUNT),
    "comes down": lambda: padded([swinging(0.75)], COUNT),
    "swings, footholds unknown": lambda: padded([swinging(0.5, known=False)], COUNT),
}


@functools.cache
def tilted(*tilts: tuple[float, float, float]) -> terrain.Terrain:
    """Planes with these slopes forward and to the left, and heights, m."""
    return to_terrain(planes(*tilts))


FLAT, DESCENT, ANKLE_DEEP = tilted((0, 0, 0)), tilted((-0.1, 0, 0)), tilted((0.2, 0, 0.3))
RAMP_UP, RAMP_DOWN = tilted((0, 0, 0), (0.2, 0, -0.1)), tilted((0, 0, 0), (-0.2, 0, 0.2))
KINK = tilted((0, 0, 0), (0.5, 0, -0.125))  # begins to rise 0.2 m ahead of the ankles


@functools.cache
def clip(name: str) -> jaxik.Frame:
    if name in STRIDES:
        return to_frames(STRIDES[name]())
    return to_frames(animate(RIG, count=COUNT, hz=HZ, **CLIPS[name]))


# Cases.

NONE, ALL = 0xFFFFFFFE, 0xFFFFFFFF  # masks without and with the layer of the planes
STEP = 1e-5  # of the way from one value to the other
ROWS = 128  # of a batch
FAR_LIMITS = {  # of a probe that may refuse ground, but does so only in cases about that
    "probe.limited": True,
    "probe.max_step_up": 9.0,
    "probe.max_step_down": 9.0,
    "probe.max_slope": 3.0,
}


class Case(NamedTuple):
    """From the first value to the second, a measure rises (+), falls (-) or stays (=)."""

    name: str
    values: tuple[Any, Any]
    change: str  # such as "+ target height"
    ground: terrain.Terrain = FLAT
    base: dict[str, Any] = {}
    clip: str = "standing"
    slope: bool = True  # False where a ray hits or misses: that has no derivative
    started: bool = False  # with an empty memory that counts as that of an earlier frame

    @property
    def leaf(self) -> str:
        return self.name.split("[")[0]

    @property
    def sign(self) -> int:
        return {"+": 1, "-": -1, "=": 0}[self.change[0]]

    def is_sloped(self, ik: jaxik.FootIK) -> bool:
        """Whether it is about a number, not a switch, and one that changes something."""
        number = jnp.issubdtype(parameter_tree.get(ik, self.leaf).dtype, jnp.inexact)
        return bool(self.sign and number)

    def rows(self, ik: jaxik.FootIK) -> list[tuple[Any, Any, bool]]:
        """Values, ways in which to differentiate, and whether decisions are blurred.

        After both values these are points near the middle, for either gate: there, ahead, behind.
        Right in the middle something else might happen.
        """
        low, high = self.values
        rows = [(low, 0.0, False), (high, 0.0, False)]
        if not self.is_sloped(ik):
            return rows + rows[:1] * 6
        way = np.subtract(high, low, dtype=float)
        points = [low + (0.501 + step) * way for step in (0.0, STEP, -STEP)]
        return rows + [(point, way, blurred) for blurred in (False, True) for point in points]


Inputs = tuple[jaxik.FootIK, terrain.Terrain, jaxik.Frame]


def read(inputs: Inputs, started: jax.Array, gate: AbstractGate) -> dict[str, jax.Array]:
    """The measures of a clip on its ground."""
    ik, ground, frames = inputs
    state = dataclasses.replace(jaxik.init(ik, to_rig(RIG)), started=started)
    result = jaxik.resume(ik, to_rig(RIG), ground, state, frames, gate)[1]
    return measures(result, frames)


@functools.partial(jax.jit, compiler_options=QUICK)
@jax.vmap
def valued(inputs: Inputs, started: jax.Array) -> dict[str, jax.Array]:
    return read(inputs, started, HARD)


@functools.partial(jax.jit, compiler_options=QUICK)
@jax.vmap
def measured(
    inputs: Inputs, ways: Any, started: jax.Array, blurred: jax.Array
) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    """The measures of a clip on its ground, and their derivatives along `ways`."""
    floats, rest = eqx.partition(inputs, eqx.is_inexact_array)
    return jax.jvp(
        lambda floats: read(eqx.combine(floats, rest), started, Either(blurred)),
        (floats,),
        (eqx.filter(ways, eqx.is_inexact_array),),
    )


def with_columns(rows: Sequence[dict[str, Any]], ik: jaxik.FootIK) -> jaxik.FootIK:
    """The system once for each row, with the row's values."""
    leaves = {name: np.asarray(parameter_tree.get(ik, name)) for row in rows for name in row}
    columns = [
        np.stack([np.broadcast_to(row.get(name, leaf), leaf.shape) for row in rows]).astype(
            leaf.dtype
        )
        for name, leaf in leaves.items()
    ]
    repeated = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], len(rows), axis=0), ik)
    return eqx.tree_at(
        lambda tree: [parameter_tree.get(tree, name) for name in leaves], repeated, columns
    )


def zeros_like(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.zeros_like(np.asarray(leaf)), tree)


class Outcomes(NamedTuple):
    """What comes of the cases of a system, and their derivatives: (cases, rows of each)."""

    ik: jaxik.FootIK
    cases: Sequence[Case]
    measures: np.ndarray
    slopes: np.ndarray  # none where only values were asked for

    def without_effect(self) -> list[Any]:
        """The cases whose measure does not change as they say."""
        low, high = self.measures[:, :2].T
        sign = np.array([case.sign for case in self.cases])
        right = np.where(sign == 0, np.abs(high - low) <= 1e-9, sign * (high - low) > 1e-4)
        rows = zip(right, self.cases, low, high, strict=True)
        return [(case.name, case.change, *both) for right, case, *both in rows if not right]

    def with_wrong_slope(self) -> list[Any]:
        """The cases whose derivative is not the difference quotient, or has another sign.

        Hard decisions have no derivative, so those of thresholds are not compared there.
        """
        declared = parameter_tree.declarations(self.ik)
        wrong = []
        for case, measures, slopes in zip(self.cases, self.measures, self.slopes, strict=True):
            threshold = case.leaf in declared and declared[case.leaf].kind == "threshold"
            for gate, first in {"hard": 2, "smooth": 5}.items() if case.is_sloped(self.ik) else ():
                slope = slopes[first]
                quotient = (measures[first + 1] - measures[first + 2]) / (2 * STEP)
                right = np.isfinite(slope)
                if gate == "smooth" or not threshold:
                    right &= abs(slope - quotient) <= 1e-8 + 1e-4 * abs(quotient)
                if not case.slope:
                    right &= abs(slope) < 1e-6  # of rounding, and of tails of blurred decisions
                elif gate == "smooth":
                    right &= case.sign * slope > 0
                if not right:
                    wrong.append((case.name, gate, slope, quotient))
        return wrong


def outcomes_of(cases: Sequence[Case], ik: jaxik.FootIK, sloped: bool = True) -> Outcomes:
    """What comes of all cases, some at once; without derivatives in a third of the time."""
    each = 8 if sloped else 2  # rows of a case
    numbers = []
    for start in range(0, len(cases), ROWS // each):
        some = [cases[min(start + index, len(cases) - 1)] for index in range(ROWS // each)]
        rows = [(case, *row) for case in some for row in case.rows(ik)[:each]]
        clips = stacked([(case.ground, clip(case.clip)) for case, *_ in rows])
        systems = with_columns([case.base | {case.leaf: value} for case, value, *_ in rows], ik)
        ways = with_columns([{case.leaf: way} for case, _, way, _ in rows], zeros_like(ik))
        started = np.array([case.started for case, *_ in rows])
        blurred = np.array([blurred for *_, blurred in rows])
        inputs = (systems, *clips)
        if sloped:
            tables = jax.device_get(measured(inputs, (ways, *zeros_like(clips)), started, blurred))
        else:
            tables = jax.device_get((valued(inputs, started),))
        numbers += [
            [table[case.change[2:]][index] for table in tables]
            for index, (case, *_) in enumerate(rows)
        ]
    table = np.reshape(numbers, (-1, each, len(numbers[0])))[: len(cases)].transpose(2, 0, 1)
    return Outcomes(ik, cases, table[0], table[-1] if sloped else np.empty(0))


def system(name: str) -> jaxik.FootIK:
    """A preset, or what it lacks of contact and pelvis in a system that compiles soon."""
    if name != "by speed":
        return to_ik(FAR_LIMITS if name in ("ozz", "unreal", "mec") else {}, name)
    rules = {"contact": contact.SpeedContact(), "pelvis": pelvis.SupportPelvis()}
    return dataclasses.replace(to_ik({}), lean=lean.NoLean(), foot=foot.KeepFoot(), **rules)
