"""Frames where formulas are singular: values and derivatives stay finite.

Each frame is repeated for a clip, which includes memory. All are rows of one batch.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxik
from jaxik.maths import parameter_tree
from jaxik.world import terrain
from reference import sample_poses
from support import cases
from support.cases import COUNT, FLAT, RIG, ROWS, swinging, tilted
from support.clips import animate, padded, to_frames

STEP = 1e-6
STRAIGHT = ([0, 0.9, 0], [0, 0.45, 0], [0, 0.02, 0])
AT_LENGTH = ([0, 0.88, 0], [0, sample_poses.SHIN, 0], [0, 0, 0])
FOLDED = ([0, 0.5, 0], [0, 0.05, 0], [0, 0.48, 0])
# Sums and differences without rounding: on the edge of a decision it would decide, and another way
# in each program.
BENT = ([0, 0.75, 0], [0, 0.375, 0.25], [0, 0, 0])
UPHILL, WALL, BESIDE = tilted((0.4, 0, 0)), tilted((1e6, 0, 0)), tilted((0, 0.9, 0))
UNEVEN = tilted((0.05, 0.11, 0.0), (0.21, -0.1, -0.1))
STIFF = {"pelvis.enabled": False, "pelvis.limit": 0.0}
BAREFOOT = {"target.foot_height": 0.0}  # ankles go to ground height
REACHES_UP = {"root.enabled": False, "probe.ray_up": 2.0, "target.max_ankle_height": 2.0}
ON_HIP = STIFF | BAREFOOT | REACHES_UP
FULL_LENGTH = BAREFOOT | {"leg.soften": 1.0, "leg.max_knee_angle": np.pi}
ANY_KNEE = {"leg.min_knee_angle": 0.0}
UNSEEN = {"probe.layers": 0, "root.layers": 0}
HALF_LIVES = [f"{of}.{way}_half_life" for of in ("target", "pelvis") for way in ("rise", "fall")]
ON = ("lock.enabled", "target.spring", "pelvis.spring")
AT_WORK = dict.fromkeys(HALF_LIVES, 0.1) | dict.fromkeys(ON, True)  # off by default in `stride`
ZERO = ("pelvis.speed", "effector.speed", "effector.latch", "effector.transition_time")
AT_ONCE = {"pelvis.half_life": 1.0, "pelvis.limit": np.inf, "lock.plant_speed": np.inf}
AT_ONCE |= dict.fromkeys([*ZERO, *HALF_LIVES], 0.0)
NEVER = {"pelvis.half_life": 0.0, "pelvis.limit": 0.0, "effector.latch_distance": 0.0}
NEVER |= {"contact.idle_speed": np.inf, "lock.plant_speed": 0.0, "lock.plant_weight": 0.0}
NEVER |= dict.fromkeys(HALF_LIVES, np.inf)
SHAPES = ("foot.weight", "probe.foot_length", "probe.half_width", "foot.max_tilt")
NO_FOOT = BAREFOOT | dict.fromkeys(SHAPES, 0.0)
NO_GAP = {"contact.planted_height": 0.1, "contact.raised_height": 0.1}
NO_RISE = {"probe.rise_start": 0.5, "probe.rise_end": 0.5}


class Situation(NamedTuple):
    """A clip on its ground, values of what a system has of them, and the legs that are there."""

    frames: jaxik.Frame
    ground: terrain.Terrain = FLAT
    values: dict[str, Any] = {}
    present: tuple[bool, ...] = (True, True)


class Row(NamedTuple):
    """System, ground and clip, a tangent for each of their floats, the gate, and the legs."""

    name: str
    inputs: tuple[jaxik.FootIK, terrain.Terrain, jaxik.Frame]
    tangents: Any
    blurred: bool
    present: tuple[bool, ...] = (True, True)

    def __str__(self) -> str:
        return f"{self.name}, {'smooth' if self.blurred else 'hard'}"


def standing(**changes: Any) -> jaxik.Frame:
    return to_frames(padded(animate(RIG, count=1, **changes), COUNT))


def held(*joints: Any) -> jaxik.Frame:
    """Two equal legs with hips, knees and ankles there, m, model space, and no rotations."""
    hip, knee, ankle = (np.tile(np.asarray(joint, float), (COUNT, 2, 1)) for joint in joints)
    frames, places = standing(), {"hip": hip, "knee": knee, "ankle": ankle, "toe": ankle}
    moved = {
        name: jaxik.Transform(jnp.asarray(pos), getattr(frames.pose, name).rot)
        for name, pos in places.items()
    }
    return dataclasses.replace(frames, pose=jaxik.LegPose(**moved))


def rotated_root(*rot: float) -> jaxik.Frame:
    """A character with this rotation of its root, wxyz."""
    frames = standing()
    root = jaxik.Transform(
        frames.world_from_model.pos, jnp.tile(jnp.asarray(rot, float), (COUNT, 1))
    )
    return dataclasses.replace(frames, world_from_model=root)


def stride(fraction: float, **changes: Any) -> jaxik.Frame:
    """Feet half way of their stride in plan, after this fraction of its time."""
    frames = to_frames(padded([swinging(fraction)], COUNT))
    return dataclasses.replace(frames, stride=dataclasses.replace(frames.stride, **changes))


def predicted(speed: float) -> jaxik.Frame:
    """Feet half way of a stride predicted from the character's forward speed, m/s."""
    frames = to_frames(padded([swinging(0.5, known=False)], COUNT))
    return dataclasses.replace(frames, velocity_ws=frames.velocity_ws * (speed / 0.8))


def without_legs(present: tuple[bool, ...]) -> jaxik.Frame:
    """Feet in a stride, of which those that are not there have no numbers."""
    here, frames = np.array(present, float), stride(0.5)
    names = ("pose", "stride", "foot_speed", "toe_speed")
    kept = {
        name: jax.tree.map(
            lambda leaf: np.asarray(leaf) * (here[:, None] if leaf.ndim == 3 else here),
            getattr(frames, name),
        )
        for name in names
    }
    return dataclasses.replace(frames, **kept)


def limping(foot: float, sideways: float) -> jaxik.Frame:
    """Feet of which one always requests more than the other."""

    def ankles(time: float) -> np.ndarray:
        lift = 0.02 * np.sin(2.9 * time)
        return np.array([[0.11, 0.123 + lift, 0.071], [-0.1, 0.141 - lift, -0.03]])

    def place(time: float) -> list[float]:
        return [0.01 + sideways * time, 0.0, 0.013 + 0.61 * time]

    return to_frames(animate(RIG, ankles, count=COUNT, hz=20.0, foot=foot, place=place))


def hint(below: float) -> dict[str, Any]:
    """The offset that puts the hint of a standing left leg that far below its hip, m."""
    pose = standing().pose
    hip, knee, ankle = (np.asarray(joint.pos[0, 0]) for joint in (pose.hip, pose.knee, pose.ankle))
    toe = ankle + np.array([0.0, -sample_poses.ANKLE, 0.20])
    down = (ankle - hip) / np.linalg.norm(ankle - hip)
    return STIFF | {"leg.hint_offset": hip + below * down - toe - (knee - ankle)}


def situations() -> dict[str, Situation]:
    still = standing()
    no_time = dataclasses.replace(still, dt=np.zeros(COUNT))
    nowhere = stride(0.5, next_ws=stride(0.5).stride.last_ws)
    one, none = (True, False), (False, False)
    return {
        "straight": Situation(held(*STRAIGHT)),
        "straight and too far": Situation(held(*STRAIGHT), tilted((0, 0, -0.3)), STIFF),
        "straight and at its length": Situation(held(*AT_LENGTH), values=STIFF | FULL_LENGTH),
        "folded": Situation(held(*FOLDED)),
        "folded and too near": Situation(held(*FOLDED), tilted((0, 0, 0.02)), ON_HIP | ANY_KNEE),
        "target on the hip": Situation(held(*BENT), tilted((0, 0, 0.75)), ON_HIP),
        "target above the hip": Situation(held(*BENT), tilted((0, 0, 1.25)), ON_HIP),
        "no bones": Situation(held([0, 0.5, 0], [0, 0.5, 0], [0, 0.5, 0])),
        "no thigh": Situation(held([0, 0.5, 0], [0, 0.5, 0], [0, 0.1, 0])),
        "no shin": Situation(held([0, 0.5, 0], [0, 0.1, 0], [0, 0.1, 0])),
        "toes at the ankle": Situation(held([0, 0.9, 0], [0, 0.5, 0.1], [0, 0.1, 0]), BESIDE),
        "misses": Situation(still, values=UNSEEN),
        "on the surface": Situation(held(*BENT)),
        "no time": Situation(no_time, UPHILL),
        "no weight": Situation(standing(weight=0.0), UPHILL),
        "half weight": Situation(standing(weight=0.5), UPHILL),
        "looks straight up": Situation(rotated_root(0.5**0.5, -(0.5**0.5), 0, 0), UPHILL),
        "stands on its head": Situation(rotated_root(0, 0, 0, 1)),
        "plane on edge": Situation(still, WALL),
        "feet point along up": Situation(standing(foot=np.pi / 2)),
        "feet upside down": Situation(standing(foot=np.pi)),
        "at once": Situation(still, UPHILL, AT_ONCE),
        "never": Situation(still, tilted((0, 0, 0.1)), NEVER),
        "no foot": Situation(still, UPHILL, NO_FOOT),
        "no gap between planted and raised": Situation(still, values=NO_GAP),
        "aims from beyond its target": Situation(still, values={"foot.offset": [3.0, 0, 0]}),
        "aims from beside its target": Situation(still, values={"foot.offset": [1.0, 0, 0]}),
        "hint on the hip": Situation(still, values=hint(0.0)),
        "hint along the leg": Situation(still, values=hint(0.4)),
        "fraction 0": Situation(stride(0.0), UPHILL),
        "fraction 1": Situation(stride(1.0), UPHILL),
        "at the end of the rise": Situation(stride(0.75), UPHILL, {"probe.rise_end": 0.75}),
        "no time to rise": Situation(stride(0.5), UPHILL, NO_RISE),
        "last is next": Situation(nowhere, UPHILL),
        "no velocity": Situation(predicted(0.0), UPHILL),
        "hardly any velocity": Situation(predicted(1e-12), UPHILL),
        "no ground ahead": Situation(stride(0.5), values=UNSEEN),
        "no ground ahead, predicted": Situation(predicted(0.8), values=UNSEEN),
        "ground out of reach": Situation(stride(0.5), tilted((0, 0, -0.9))),
        "one leg out of reach": Situation(still, tilted((0, 4.0, 0))),
        "a wall": Situation(stride(0.5), WALL),
        "no clearance": Situation(still, values={"probe.clearance": 0.0}),
        "no rise of the heel": Situation(still, BESIDE, {"effector.max_lift": 0.0}),
        "one leg": Situation(without_legs(one), UPHILL, present=one),
        "no leg": Situation(without_legs(none), UPHILL, present=none),
    }


# Rows.


def inputs_of(system: str, situation: Situation) -> Any:
    ik = cases.system(system)
    names = {slot.name for slot in parameter_tree.slots(ik)}
    values = (AT_WORK if system == "stride" else {}) | situation.values
    ik = parameter_tree.replace(ik, {name: values[name] for name in names & set(values)})
    return ik, situation.ground, situation.frames


def singular_rows(system: str) -> Iterator[Row]:
    rng = np.random.default_rng(0)
    for name, situation in situations().items():
        inputs = inputs_of(system, situation)
        floats = eqx.filter(inputs, eqx.is_inexact_array)
        tangents = jax.tree.map(lambda x: rng.normal(size=x.shape), floats)
        for blurred in (False, True):
            yield Row(name, inputs, tangents, blurred, situation.present)


def moving_parts(inputs: Any) -> list[Any]:
    _, ground, frames = inputs
    joints = (frames.pose.hip, frames.pose.ankle, frames.pose.toe, frames.world_from_model)
    return [plane.point_ws for plane in ground.surfaces] + [joint.pos for joint in joints]


def limping_rows(system: str) -> Iterator[Row]:
    """In threes, on a way on which animation and terrain change: at a point, ahead and behind."""
    rng = np.random.default_rng(0)
    for name, frames in {"limps": limping(0.0, 0.0), "on its toes": limping(-0.2, 0.05)}.items():
        inputs = inputs_of(system, Situation(frames, UNEVEN))
        floats, rest = eqx.partition(inputs, eqx.is_inexact_array)
        moved = [0.1 * rng.normal(size=x.shape) for x in moving_parts(floats)]
        tangents = eqx.tree_at(moving_parts, cases.zeros_like(floats), moved)
        for blurred in (False, True):
            for step in (0.0, STEP, -STEP):
                there = jax.tree.map(lambda x, t, s=step: x + s * t, floats, tangents)
                yield Row(name, eqx.combine(there, rest), tangents, blurred)


def assert_sound(system: str, limps: bool = False) -> None:
    """Asserts that all numbers are finite, and on a limp derivatives difference quotients."""
    rows = [*(limping_rows(system) if limps else ()), *singular_rows(system)]
    rows = [row for row in rows if all(row.present)]
    rows += rows[-1:] * (ROWS - len(rows))
    tangents = [eqx.combine(row.tangents, cases.zeros_like(row.inputs)) for row in rows]
    batch = cases.stacked([row.inputs for row in rows]), cases.stacked(tangents)
    blurred = np.array([row.blurred for row in rows])
    results = jax.device_get(cases.measured(*batch, np.zeros(ROWS, bool), blurred))
    values, slopes = (np.stack(list(table.values()), axis=1) for table in results)
    sound = np.asarray(np.isfinite(values).all(axis=1) & np.isfinite(slopes).all(axis=1))
    assert sound.all(), {str(rows[index]) for index in np.flatnonzero(~sound)}
    for index in range(0, 12 if limps else 0, 3):
        assert np.abs(slopes[index]).max() > 1e-2
        quotients = (values[index + 1] - values[index + 2]) / (2 * STEP)
        np.testing.assert_allclose(slopes[index], quotients, 1e-4, 1e-6, err_msg=str(rows[index]))
