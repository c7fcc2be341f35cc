"""Measures a `Rig` (bone lengths, knee axes, foot axes) from the motion of its two-bone legs.

All arrays are float64 in world space with frames leading, (frames, 3) unless said otherwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float64
from scipy.spatial.transform import Rotation

from jaxik.world.body import LEG
from jaxik.world.skeleton import Rig

from . import contacts
from .joint_maps import Leg, Roles

Vectors = Float64[np.ndarray, "frames 3"]

BENT = np.sin(np.radians(3.0))  # sine of the flexion from which thigh and shin span a plane

Rotations = Float64[np.ndarray, "frames 4"]  # wxyz

UP = np.array([0.0, 1.0, 0.0])
KNEE_MOTION = np.radians(3.0)  # RMS knee rotation below which the motion shows no axis
FLAT_FRACTION = 0.25  # of a stance's frames, in which the foot is flat at least
FLAT_RISE = 0.05  # of a foot's length, by which the ankle of a flat foot rises and falls
LEVEL = 0.4  # of a foot's length, in which the heights of its ball lie on a level floor
HIGHEST_BALL = 0.6  # of a foot's length, its ball's height over the sole; captured: 0.2 to 0.55
USUAL_BALL = 0.45  # the same height of the feet of people
USUAL_ERROR = 0.02  # m, by which captured clips of adults differ from it
USUAL_FOOT = 0.15  # of a leg's length, ankle to ball; for a foot that is a single point

TOPIC = "sole"  # a word in each of these remarks, and in no others
OFFSET = 0.015  # m, from which feet count as off their floor


def unit(v: Float64[np.ndarray, "*b 3"]) -> np.ndarray:
    """`v` scaled to length one; zero stays zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 0)


def reject(v: Vectors, axis: Vectors) -> Vectors:
    """The part of `v` perpendicular to the unit vector `axis`."""
    return v - axis * np.sum(v * axis, axis=-1, keepdims=True)


def rotation(wxyz: ArrayLike) -> Rotation:
    """Quaternions as rotations, those of several joints one after another."""
    quats = np.asarray(wxyz, np.float64)
    return Rotation.from_quat(quats.reshape(-1, 4) if quats.ndim > 2 else quats, scalar_first=True)


def knee_hinges(hip: Vectors, knee: Vectors, ankle: Vectors, left_ws: Vectors) -> Vectors:
    """Unit axes about which a positive rotation of the shin flexes the knee.

    They are perpendicular to thigh and shin. A straight leg spans no plane: as the leg straightens,
    the axis fades smoothly to `left_ws`, made perpendicular to the leg.
    """
    thigh, shin, leg = unit(knee - hip), unit(ankle - knee), unit(ankle - hip)
    normal = np.cross(thigh, shin)  # its length is the sine of the flexion; a knee bends forward
    bend = np.clip(np.linalg.norm(normal, axis=-1, keepdims=True) / (3 * BENT), 0.0, 1.0)
    fade = 1.0 - bend**2 * (3.0 - 2.0 * bend)
    return unit(normal + 6 * BENT * fade * unit(reject(left_ws, leg)))


def knee_positions(
    hip: Vectors, ankle: Vectors, pole: Vectors, bones: tuple[float, float]
) -> Vectors:
    """Knees between hips and ankles by the law of cosines, m.

    Args:
        hip: m.
        ankle: m; a leg whose ankle is out of reach is straight.
        pole: unit, perpendicular to the line from hip to ankle; where the knee points.
        bones: length of the thigh and of the shin, m.
    """
    thigh, shin = bones
    distance = np.linalg.norm(ankle - hip, axis=-1, keepdims=True)
    along = unit(ankle - hip)
    forth = (thigh**2 - shin**2 + distance**2) / (2.0 * distance)
    return hip + along * forth + pole * np.sqrt(np.maximum(thigh**2 - forth**2, 0.0))


def bone_rotation(top: Vectors, bottom: Vectors, hinge: Vectors) -> Rotation:
    """Axes of a bone: y from its lower end up to its upper one, x along the hinge, z forward."""
    y = unit(top - bottom)
    x = unit(reject(hinge, y))
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def leg_rotations(
    hip: Vectors, knee: Vectors, ankle: Vectors, left_ws: Vectors
) -> list[Float64[np.ndarray, "frames 4"]]:
    """World rotations, wxyz, of thigh and shin known only by their end points.

    Axes as in `bone_rotation`, so a positive rotation about x flexes the knee.
    """
    hinge = knee_hinges(hip, knee, ankle, left_ws)
    bones = ((hip, knee), (knee, ankle))
    return [bone_rotation(*bone, hinge).as_quat(scalar_first=True) for bone in bones]


@dataclass(frozen=True)
class LegMotion:
    """World transforms of one leg's joints over the frames."""

    hip: Vectors
    """Metres."""
    knee: Vectors
    ankle: Vectors
    toe: Vectors
    hip_rot: Rotations
    """Unit quaternions, wxyz."""
    knee_rot: Rotations
    ankle_rot: Rotations
    left_ws: Vectors
    """Unit, to the character's left."""


class SoleHeights(NamedTuple):
    """Heights of joints above the sole of a foot that stands flat, one for each leg."""

    ankle: Float64[np.ndarray, " legs"]
    """Metres."""
    ball: Float64[np.ndarray, " legs"]
    """Metres."""
    measured: Bool[np.ndarray, " legs"]
    """False where the clip shows no foot flat on a level floor: a guess from the foot's length."""
    standing: Float64[np.ndarray, " legs"]
    """m, of the ball over the floor while the foot stands; NaN where it does at no one height."""


class LegMeasurement(NamedTuple):
    """What a rig needs to know of one leg."""

    knee_axis_ls: Float64[np.ndarray, "3"]
    """Unit, knee space."""
    ankle_from_foot: Float64[np.ndarray, "4"]
    """Unit quaternions, wxyz."""
    lengths: Float64[np.ndarray, "3"]
    """m, thigh, shin and foot."""


def measure_rig(
    roles: Roles,
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
    stance: Bool[np.ndarray, "frames legs"],
) -> Rig:
    """The rig of a clip, in float64 regardless of JAX's default precision.

    Bone lengths are medians over the frames. The knee axis is the principal axis of the knee's
    rotations; if the knee hardly moves, it is perpendicular to thigh and shin. Foot axes are those
    of a flat foot: up is the world's, forward points from ankle to ball. Heights over the sole are
    those of `measure_soles` over a floor at y = 0.

    Args:
        roles: which joint is which.
        positions_ws: m, y up.
        rotations_ws: wxyz.
        stance: when each foot stands.
    """
    hips = [leg.joints[0] for leg in roles.legs]
    side = np.array([leg.side for leg in roles.legs])
    left_ws = left_directions(positions_ws[:, hips], side, rotations_ws[:, roles.pelvis])
    legs = [
        _measure_leg(leg_motion(leg, left_ws, positions_ws, rotations_ws), stance[:, index])
        for index, leg in enumerate(roles.legs)
    ]
    axes, feet, lengths = (np.stack(part) for part in zip(*legs, strict=True))
    # Numbers also inside a trace, as soles are measured from them by NumPy.
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        rig = Rig(
            knee_axis_ls=jnp.asarray(axes),
            ankle_from_foot=jnp.asarray(feet),
            thigh=jnp.asarray(lengths[:, 0]),
            shin=jnp.asarray(lengths[:, 1]),
            foot=jnp.asarray(lengths[:, 2]),
            ankle_height=jnp.zeros(len(legs)),
            ball_height=jnp.zeros(len(legs)),
            side=jnp.asarray(side),
            present=jnp.ones(len(legs), bool),
            names=tuple(leg.name for leg in roles.legs),
            joints=tuple(leg.joints for leg in roles.legs),
            pelvis=roles.pelvis,
        )
    return with_soles(rig, positions_ws, rotations_ws, stance)


def with_soles(
    rig: Rig,
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
    stance: Bool[np.ndarray, "frames legs"],
    floor: float = 0.0,
) -> Rig:
    """The rig with the heights over the sole that `measure_soles` finds."""
    soles = measure_soles(rig, positions_ws, rotations_ws, stance, floor)
    with jax.enable_x64(True):
        heights = {"ankle_height": jnp.asarray(soles.ankle), "ball_height": jnp.asarray(soles.ball)}
    return replace(rig, **heights)


def measure_soles(
    rig: Rig,
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
    stance: Bool[np.ndarray, "frames legs"],
    floor: float = 0.0,
) -> SoleHeights:
    """How far ankle and ball of each foot are above its sole while it stands flat.

    These are medians over stances of their heights above the floor, both moved by half of what they
    differ from the height of the ankle over the ball along the foot's own up axis: then a foot that
    lies flat is on the floor with both. Where balls stand at different heights, or nowhere near the
    floor, the clip shows no floor for that foot. Its ball is then as high as that of a person's
    foot of its length.

    Args:
        rig: the legs; their heights over the sole are not read.
        positions_ws: m, y up.
        rotations_ws: wxyz.
        stance: when each foot stands.
        floor: height of the floor, m.
    """
    heights, measured, standing = [], [], []
    for leg, (hip, knee, ankle, toe) in enumerate(rig.joints):
        bones = np.diff(positions_ws[:, [hip, knee, ankle, toe]], axis=1)
        thigh, shin, foot = np.median(np.linalg.norm(bones, axis=-1), axis=0)
        foot = foot if foot > 0 else USUAL_FOOT * (thigh + shin)
        flat = flat_frames(positions_ws[:, ankle], positions_ws[:, toe], stance[:, leg])
        spans = contacts.runs(stance[:, leg]) or [(0, len(flat) - 1)]
        stances = (np.flatnonzero(flat[a : b + 1]) + a for a, b in spans)
        heights_ws = positions_ws[:, [ankle, toe], 1]
        above = [np.median(heights_ws[frames], axis=0) for frames in stances if len(frames)]
        above = np.array(above) - floor
        (ankle_height, ball_height), balls = np.median(above, axis=0), above[:, 1]
        axes = rotation(np.asarray(rig.ankle_from_foot)[leg : leg + 1])
        foot_rot = rotation(rotations_ws[:, ankle]) * axes
        bone = foot_rot.inv().apply(positions_ws[:, ankle] - positions_ws[:, toe])
        rise = np.median(bone[:, 1])  # of the ankle over the ball of a flat foot
        level = np.quantile(balls, 0.9) - np.quantile(balls, 0.1) <= LEVEL * foot
        on_floor = -LEVEL * foot <= ball_height <= HIGHEST_BALL * foot
        measured.append(bool(stance[:, leg].any() and level and on_floor))
        standing.append(ball_height if stance[:, leg].any() and level else np.nan)
        if not measured[-1]:
            ball_height = USUAL_BALL * foot
            ankle_height = ball_height + max(rise, 0.0)
        else:
            middle = (ankle_height + ball_height) / 2
            ankle_height, ball_height = middle + rise / 2, middle - rise / 2
        sunk = max(-ball_height, 0.0)  # of a foot that stands in the floor
        heights.append([max(ankle_height + sunk, 0.0), ball_height + sunk])
    ankle, ball = np.array(heights).T
    return SoleHeights(ankle, ball, np.array(measured), np.array(standing))


def with_sole(rig: Rig, sole: float) -> Rig:
    """The rig with the balls of all feet at this height over their soles, m, when they are flat."""
    with jax.enable_x64(True):
        ball = jnp.full(len(rig.names), float(sole))
        ankle = jnp.maximum(ball + rig.ankle_height - rig.ball_height, 0.0)
    return replace(rig, ankle_height=ankle, ball_height=ball)


def relative_size(
    positions_ws: Float64[np.ndarray, "frames joints 3"], legs: Sequence[tuple[int, int, int, int]]
) -> float:
    """Mean length of the legs (thigh and shin) relative to an adult's; 1 for legs without length.

    Args:
        positions_ws: m.
        legs: indices of hip, knee, ankle and ball of each leg.
    """
    bones = np.diff(positions_ws[:, np.array(legs)[:, :3]], axis=2)
    length = np.median(np.linalg.norm(bones, axis=-1), axis=0).sum(axis=-1).mean()
    return float(length) / LEG if length > 0 else 1.0


def left_directions(
    hips_ws: Float64[np.ndarray, "frames legs 3"],
    side: Float64[np.ndarray, " legs"],
    pelvis_rotations_ws: Rotations,
) -> Vectors:
    """Unit vectors to the character's left, world space.

    They point from the right hips to the left ones. With legs on one side only, they are the
    pelvis' own x axis.

    Args:
        hips_ws: m.
        side: 1 for a left leg, -1 for a right one.
        pelvis_rotations_ws: wxyz.
    """
    if (side > 0).any() and (side < 0).any():
        return unit(hips_ws[:, side > 0].mean(axis=1) - hips_ws[:, side < 0].mean(axis=1))
    return rotation(pelvis_rotations_ws).apply([1.0, 0.0, 0.0])


def leg_motion(
    leg: Leg, left_ws: Vectors, positions_ws: np.ndarray, rotations_ws: np.ndarray
) -> LegMotion:
    """The motion of a leg among that of all joints, m and wxyz; see `left_directions`."""
    hip, knee, ankle, toe = (positions_ws[:, joint] for joint in leg.joints)
    hip_rot, knee_rot, ankle_rot = (rotations_ws[:, joint] for joint in leg.joints[:3])
    return LegMotion(hip, knee, ankle, toe, hip_rot, knee_rot, ankle_rot, left_ws)


def _measure_leg(leg: LegMotion, stance: Bool[np.ndarray, " frames"]) -> LegMeasurement:
    bones = ((leg.hip, leg.knee), (leg.knee, leg.ankle), (leg.ankle, leg.toe))
    lengths = [np.median(np.linalg.norm(end - start, axis=-1)) for start, end in bones]
    flat = flat_frames(leg.ankle, leg.toe, stance)
    return LegMeasurement(knee_axis(leg), foot_axes(leg, flat), np.array(lengths))


def knee_axis(leg: LegMotion) -> Float64[np.ndarray, "3"]:
    """Unit axis in knee space about which a positive rotation opens the knee."""
    hinges_ws = knee_hinges(leg.hip, leg.knee, leg.ankle, leg.left_ws)
    knee_rot = rotation(leg.knee_rot)
    flexing_ls = np.mean(knee_rot.inv().apply(hinges_ws), axis=0)
    if knee_motion(leg) < KNEE_MOTION:
        return -flexing_ls / np.linalg.norm(flexing_ls)
    axis = np.linalg.svd(_knee_rotations(leg), full_matrices=False)[2][0]
    return -axis if axis @ flexing_ls > 0 else axis


def knee_motion(leg: LegMotion) -> float:
    """Root mean square rotation of the knee about its mean, rad."""
    return float(np.sqrt(np.mean(np.sum(_knee_rotations(leg) ** 2, axis=-1))))


def _knee_rotations(leg: LegMotion) -> Vectors:
    """Rotations of the knee from its mean, relative to the thigh, as rotation vectors, rad."""
    local = rotation(leg.hip_rot).inv() * rotation(leg.knee_rot)
    return (local.mean().inv() * local).as_rotvec()


def knee_remarks(
    roles: Roles,
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
) -> tuple[str, ...]:
    """A remark for each knee that moves too little to show its axis."""
    left_ws = np.zeros((len(positions_ws), 3))  # which is not read
    motions = (leg_motion(leg, left_ws, positions_ws, rotations_ws) for leg in roles.legs)
    return tuple(
        f"the {leg.name} knee hardly moves, so its axis is a guess: use a clip in which it bends, "
        "or do not trust where this knee points"
        for leg, motion in zip(roles.legs, motions, strict=True)
        if knee_motion(motion) < KNEE_MOTION
    )


def flat_frames(
    ankle: Vectors, toe: Vectors, stance: Bool[np.ndarray, " frames"]
) -> Bool[np.ndarray, " frames"]:
    """True in frames in which a foot lies flat.

    In each stance these are, of the frames in which its heel is lowest, those in which its ankle is
    slowest: a foot may also stand still on its toes. Where most stances agree on how high the ankle
    is over the ball, the others are left out. Without any stance, the frames in which the ball of
    the foot is lowest.

    Args:
        ankle: m, y up.
        toe: the ball of the foot, m.
        stance: when the foot stands.
    """
    if not stance.any():
        return toe[:, 1] <= np.quantile(toe[:, 1], FLAT_FRACTION)
    steps = np.linalg.norm(np.gradient(ankle, axis=0), axis=-1) if len(ankle) > 1 else np.zeros(1)
    rise = (ankle - toe)[:, 1]
    slack = FLAT_RISE * float(np.median(np.linalg.norm(ankle - toe, axis=-1)))
    stances = []
    for first, last in contacts.runs(stance):
        frames = np.arange(first, last + 1)
        frames = frames[rise[frames] <= np.quantile(rise[frames], FLAT_FRACTION) + slack]
        stances.append(frames[steps[frames] <= np.quantile(steps[frames], FLAT_FRACTION)])
    rises = np.array([np.median(rise[frames]) for frames in stances])
    usual = np.abs(rises - np.quantile(rises, 0.5, method="nearest")) <= slack
    if usual.mean() <= 0.5:
        usual[:] = True
    flat = np.zeros(len(stance), bool)
    flat[np.concatenate([stances[index] for index in np.flatnonzero(usual)])] = True
    return flat


def foot_axes(leg: LegMotion, flat: Bool[np.ndarray, " frames"]) -> Float64[np.ndarray, "4"]:
    """`ankle_from_foot`, wxyz: x left, y up and z forward of a flat foot, averaged over `flat`.

    A foot without length points where the pelvis does; along z if that points straight up or down.
    """
    foot = leg.toe[flat] - leg.ankle[flat]
    has_length = np.linalg.norm(foot[:, [0, 2]], axis=-1, keepdims=True) > 1e-3
    forward = unit(np.where(has_length, foot, np.cross(leg.left_ws[flat], UP)) * [1.0, 0.0, 1.0])
    forward = np.where(forward.any(axis=-1, keepdims=True), forward, [0.0, 0.0, 1.0])
    up = np.broadcast_to(UP, forward.shape)
    axes = np.stack([np.cross(up, forward), up, forward], axis=-1)
    mean = (rotation(leg.ankle_rot[flat]).inv() * Rotation.from_matrix(axes)).mean()
    return mean.as_quat(canonical=True, scalar_first=True)


def remarks(
    rig: Rig,
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
    stance: Bool[np.ndarray, "frames legs"],
    floor: float = 0.0,
) -> tuple[str, ...]:
    """Feet that stand over or in their floor, or else those whose heights are a guess.

    Args:
        rig: with heights over the sole, however they became known.
        positions_ws: m, y up.
        rotations_ws: wxyz.
        stance: when each foot stands.
        floor: its height, m.
    """
    soles = measure_soles(rig, positions_ws, rotations_ws, stance, floor)
    balls = np.asarray(rig.ball_height, np.float64)
    over = soles.standing - balls
    if (over > OFFSET).all() or (over < -OFFSET).all():
        height, ball, standing = float(over.mean()), float(balls.mean()), soles.standing.mean()
        remedy = f"--floor {floor + height:.3f}"
        if standing > 0:
            remedy += f", or --sole {standing:.3f} (sole=... in Python) if they are that thick"
        place = "over" if height > 0 else "in"
        return (
            f"standing feet are {100 * abs(height):.1f} cm {place} the floor at height {floor:g} m "
            f"in all stances, if their balls are {100 * ball:.1f} cm over their soles: a floor "
            f"offset? Then give {remedy}",
        )
    guessed = ~soles.measured & np.isclose(balls, soles.ball)
    return tuple(
        f"the {name} foot never stands flat on a level floor at height {floor:g}; its ankle is "
        f"assumed to be {height:.3f} m over its sole, from the foot's length"
        for name, height, is_guess in zip(rig.names, rig.ankle_height, guessed, strict=True)
        if is_guess
    )
