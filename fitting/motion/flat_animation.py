"""Flat animations, as a game plays them on flat ground, derived from a clip on uneven ground.

Foot IK takes such an animation and the terrain, and should return the captured motion. To derive
it, the terrain is removed from under the feet: during a stance a foot is lowered by the height of
the ground below it and turned about its ball by the ground's slope, which foot IK adds again;
between two stances by a quintic smoothstep from one height to the next, and from one slope to a
foot as captured in mid-swing. A foot whose foothold the start of a clip cuts off swings at the
height of its next one: down stairs, through those that it comes from.

The pelvis follows its path in the ground plane at a constant height: its motion on uneven ground is
for foot IK to add. Where the ground is flat, there is nothing to add: the clip itself is such an
animation. Knees follow from the law of cosines, in the plane in which the captured leg bends.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import contacts, edit, load_clip
from fitting.clips.clip import Clip, local_from_world, world_from_local
from fitting.clips.formats.npz import holds_base, read_base
from fitting.clips.load import AS_FOUND, ClipOptions, with_contacts
from fitting.clips.rigs import Vectors, bone_rotation, knee_hinges, knee_positions, unit
from fitting.ground.coverage import FLAT, relief
from fitting.ground.ground_path import SKY, heights_under
from fitting.runtime.validation import error_context
from jaxik.world import body
from jaxik.world.terrain import Terrain

HeightFunction = Callable[[np.ndarray], np.ndarray]
"""Ground heights, m, (points,), below points (points, 3), m."""
NormalFunction = Callable[[np.ndarray], np.ndarray]
"""Unit normals of the ground, (points, 3), below points (points, 3), m."""

LENGTH_TOLERANCE = 1e-4  # m: a bone whose length varies by more is being stretched
UNEVEN = 0.05  # m, of an adult, between stances: a flat animation and its noise differ by less
MAX_REACH = 0.9995  # of a leg's length, to which it may be extended
STEEPEST = np.radians(40.0)  # ground on which feet stand; steeper is the side of a step


def flatten_clip(
    clip: Clip,
    height_under: HeightFunction,
    *,
    normal_under: NormalFunction | None = None,
    pelvis_height: float | Float64[np.ndarray, " frames"] | None = None,
) -> Clip:
    """The clip over a flat floor at y = 0.

    Balls keep their path in the ground plane, and feet their rotation against the ground. Where the
    pelvis is too high for a leg, its foot moves towards the hip until the leg reaches, so bones
    always keep their lengths. The body above the hips moves with the pelvis, as captured.

    Args:
        clip: captured motion over terrain. Its contact labels decide when a foot stands; if it has
            none, they are detected from its motion.
        height_under: the height of the terrain.
        normal_under: the normal of the terrain; None means level everywhere.
        pelvis_height: m; None leaves the captured heights on flat ground; on any other it is their
            mean above the ground under the standing feet.

    Raises:
        ValueError: a foot never stands, or the ground height under a stance is not finite.
    """
    rig = clip.rig
    stance = clip.stance_labels()
    ground = ground_heights(clip, stance, height_under)
    pelvis = clip.positions_ws[:, rig.pelvis]
    balls = clip.joints_ws(3)[stance]
    if pelvis_height is None and relief(balls[:, [0, 2]], ground[stance]) < FLAT * body.ratio(rig):
        pelvis_height = pelvis[:, 1] - ground.mean(axis=1)
    elif pelvis_height is None:
        any_foot = stance.any(axis=1)
        under = (ground * stance).sum(axis=1)[any_foot] / stance.sum(axis=1)[any_foot]
        pelvis_height = float(np.mean(pelvis[any_foot, 1] - under))
    lift = (pelvis_height - pelvis[:, 1])[:, None, None] * [0.0, 1.0, 0.0]
    tilt = np.zeros((*stance.shape, 3))
    if normal_under is not None:
        tilt = _ground_tilts(clip, stance, normal_under)
    flat = _rebuild_legs(
        clip.with_motion(clip.positions_ws + lift, clip.rotations_ws), clip, ground, tilt
    )
    return replace(flat, stance=stance)


def with_rigid_legs(clip: Clip) -> Clip:
    """The clip with thighs and shins of the rig's lengths in every frame.

    Where the animation stretches a leg, its foot moves towards the hip until the leg reaches. A
    clip whose bones keep their lengths is returned unchanged.
    """
    rig = clip.rig
    hip, knee, ankle = (clip.joints_ws(role) for role in range(3))
    errors = [
        np.abs(np.linalg.norm(top - bottom, axis=-1) - np.asarray(length)).max()
        for top, bottom, length in ((hip, knee, rig.thigh), (knee, ankle, rig.shin))
    ]
    if max(errors) < LENGTH_TOLERANCE:
        return clip
    level = np.zeros((clip.frame_count, len(rig.joints), 3))
    return _rebuild_legs(clip, clip, level[..., 0], level)


def load_flat_animation(path: Path, floor: float = 0.0, options: ClipOptions = AS_FOUND) -> Clip:
    """The animation in a file, ready for foot IK, with rigid legs.

    If the file holds a captured clip and its flat animation, it is the latter.

    Args:
        path: the file.
        floor: height of the floor on which it was animated, m; the rig's soles are measured there.
        options: how the file is read.

    Raises:
        ValueError: as `load_clip`, or the clip has no legs.
    """
    if holds_base(path):
        options.check_use([path], str(path))
        clip = with_contacts(read_base(path), path)
    else:
        clip = load_clip(path, **options.given)
    with error_context(path):
        return as_flat_animation(clip, floor, options.sole)


def as_flat_animation(clip: Clip, floor: float = 0.0, sole: float | None = None) -> Clip:
    """A clip that was animated for a flat floor, ready for foot IK; see `load_flat_animation`."""
    return edit.on_floor(with_rigid_legs(clip), floor, sole)


def with_remark_if_uneven(clip: Clip) -> Clip:
    """A clip that is meant to be flat, with a remark if its feet stand at different heights."""
    if (difference := stance_difference(clip)) <= UNEVEN * body.ratio(clip.rig):
        return clip
    remark = (
        f"its feet stand at heights {100 * difference:.0f} cm apart, as if captured on uneven "
        "ground, and not animated on a flat floor: foot IK would add the terrain a second time. "
        "Use the terrain of its capture with the root `auto` (`jaxik terrain` reconstructs it), "
        "or make the clip the reference of an experiment without a base"
    )
    return replace(clip, remarks=(*clip.remarks, remark))


def stance_difference(clip: Clip) -> float:
    """How far apart the heights are at which the ball of a foot stands, m: most of any foot.

    The heights are medians over the observed frames of each stance; the highest and lowest tenth
    of them are left out.
    """
    balls, stance = clip.joints_ws(3), clip.observed_stances()
    differences = [0.0]
    for leg in range(stance.shape[1]):
        heights = [
            np.median(balls[first : last + 1, leg, 1][clip.observed[first : last + 1]])
            for first, last in contacts.runs(stance[:, leg])
        ]
        if heights:
            low, high = np.quantile(heights, [0.1, 0.9])
            differences.append(float(high - low))
    return max(differences)


def ground_heights(
    clip: Clip, stance: np.ndarray, height_under: HeightFunction
) -> Float64[np.ndarray, "frames legs"]:
    """Height of the ground to remove from under each foot, m.

    During a stance it is the height below the median position of the ball, and between stances it
    changes smoothly. Before the first stance and after the last it is theirs.

    Raises:
        ValueError: a foot never stands, or a height is not finite.
    """
    balls = clip.joints_ws(3)
    ground = np.empty(stance.shape)
    for leg, name in enumerate(clip.rig.names):
        if not stance[:, leg].any():
            raise ValueError(f"{clip.source}: the {name} foot never stands, so no ground is known")
        falls = contacts.footfalls(balls[:, leg], stance[:, leg])
        points = falls.positions_ws
        heights = np.asarray(height_under(points), np.float64)
        if heights.shape != (len(points),):
            raise ValueError(f"wanted {len(points)} ground heights; got the shape {heights.shape}")
        missing = np.flatnonzero(~np.isfinite(heights))
        if missing.size:
            x, _, z = points[missing[0]]
            raise ValueError(
                f"{clip.source}: there is no ground under {missing.size} of the {len(points)} "
                f"stances of the {name} foot, first at x {x:.2f}, z {z:.2f} m; make the terrain "
                "larger, or cut the clip with start and end"
            )
        start, end = heights[falls.last], heights[falls.next]
        ground[:, leg] = start + (end - start) * _smoothstep(falls.swing_fraction)
    return ground


def _ground_tilts(
    clip: Clip, stance: np.ndarray, normal_under: NormalFunction
) -> Float64[np.ndarray, "frames legs 3"]:
    """Rotations from level ground to that under each foot, as rotation vectors, rad.

    They fade out until the middle of a swing, and then in; ground too steep to stand on counts as
    level.
    """
    balls = clip.joints_ws(3)
    tilts = np.zeros((*stance.shape, 3))
    for leg in range(stance.shape[1]):
        falls = contacts.footfalls(balls[:, leg], stance[:, leg])
        x, y, z = np.asarray(normal_under(falls.positions_ws), np.float64).T
        level = np.hypot(x, z)
        angle = np.arctan2(level, y)
        turn = np.where((level > 0) & (angle < STEEPEST), angle / np.where(level > 0, level, 1), 0)
        slopes = np.stack([z * turn, np.zeros_like(x), -x * turn], axis=-1)
        twice = 2 * falls.swing_fraction[:, None]
        tilts[:, leg] = slopes[falls.last] * (1 - _smoothstep(np.minimum(twice, 1)))
        tilts[:, leg] += slopes[falls.next] * _smoothstep(np.maximum(twice - 1, 0))
    return tilts


def _smoothstep(x: np.ndarray) -> np.ndarray:
    return x**3 * (10 - 15 * x + 6 * x**2)


def _rebuild_legs(moved: Clip, captured: Clip, ground: np.ndarray, tilt: np.ndarray) -> Clip:
    """The clip `moved` with legs that reach the captured feet, lowered and turned back.

    Args:
        moved: the captured clip, its body lifted.
        captured: the captured clip.
        ground: m, (frames, legs), by which feet are lowered.
        tilt: rad, (frames, legs, 3), rotation vectors by whose inverse they turn about their balls.
    """
    rig, left_ws = captured.rig, captured.left_ws()
    positions_ws, rotations_ws = moved.positions_ws.copy(), captured.rotations_ws.copy()
    for leg, joints in enumerate(rig.joints):
        before = [captured.positions_ws[:, joint] for joint in joints]
        hip = positions_ws[:, joints[0]]
        bones = float(rig.thigh[leg]), float(rig.shin[leg])
        back = Rotation.from_rotvec(-tilt[:, leg])
        foot = back.apply(before[3] - before[2])
        ankle = before[3] - foot - ground[:, leg, None] * [0.0, 1.0, 0.0]
        distance = np.linalg.norm(ankle - hip, axis=-1, keepdims=True)
        ankle = hip + (ankle - hip) * np.minimum(1.0, MAX_REACH * sum(bones) / distance)
        pole = _carried_pole(before, ankle - hip, left_ws)
        knee = knee_positions(hip, ankle, pole, bones)
        after = [hip, knee, ankle, ankle + foot]
        for joint, pos in zip(joints, after, strict=True):
            positions_ws[:, joint] = pos
        for bone in (0, 1):
            change = _bone_axes(after, bone, left_ws) * _bone_axes(before, bone, left_ws).inv()
            old = Rotation.from_quat(captured.rotations_ws[:, joints[bone]], scalar_first=True)
            rotations_ws[:, joints[bone]] = (change * old).as_quat(scalar_first=True)
        for joint in joints[2:]:
            old = Rotation.from_quat(captured.rotations_ws[:, joint], scalar_first=True)
            rotations_ws[:, joint] = (back * old).as_quat(scalar_first=True)
    return captured.with_motion(*_attach_children(captured, positions_ws, rotations_ws))


def _carried_pole(leg: list[Vectors], hip_to_ankle: Vectors, left_ws: Vectors) -> Vectors:
    """Where the knee of a leg points after the leg is rotated to a new line from hip to ankle.

    The rotation is the shortest one from the old line to the new.

    Args:
        leg: hip, knee and ankle (and more) before, m.
        hip_to_ankle: the new line, m.
        left_ws: unit; the hinge of a leg that is straight.
    """
    before, along = unit(leg[2] - leg[0]), unit(hip_to_ankle)
    pole = unit(np.cross(before, knee_hinges(leg[0], leg[1], leg[2], left_ws)))
    axis = np.cross(before, along)  # Rodrigues' formula; the axis is as long as the sine
    cos = np.sum(before * along, axis=-1, keepdims=True)
    return (
        pole * cos
        + np.cross(axis, pole)
        + axis * (np.sum(axis * pole, axis=-1, keepdims=True) / (1.0 + cos))
    )


def _bone_axes(leg: list[Vectors], bone: int, left_ws: Vectors) -> Rotation:
    """Axes of a thigh (0) or shin (1)."""
    return bone_rotation(leg[bone], leg[bone + 1], knee_hinges(leg[0], leg[1], leg[2], left_ws))


def _attach_children(
    clip: Clip, positions_ws: np.ndarray, rotations_ws: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World transforms with joints below the legs (end sites, helpers) rigid on their parents."""
    leg_joints = {joint for leg in clip.rig.joints for joint in leg}
    old_pos, old_rot = local_from_world(clip.parents, clip.positions_ws, clip.rotations_ws)
    new_pos, new_rot = local_from_world(clip.parents, positions_ws, rotations_ws)
    attached: set[int] = set()
    for joint, parent in enumerate(clip.parents):
        if joint not in leg_joints and (parent in leg_joints or parent in attached):
            attached.add(joint)
            new_pos[:, joint], new_rot[:, joint] = old_pos[:, joint], old_rot[:, joint]
    return world_from_local(clip.parents, new_pos, new_rot)


def with_cut_off_swings(frames: jaxik.Frame, clip: Clip, terrain: Terrain) -> jaxik.Frame:
    """The frames with the footholds that feet have left before the clip or a piece of it begins.

    Each is as far behind the next one as the foot's first whole swing goes, on the line over the
    ball in the first frame, if the ground there is higher than at the next one. Lower ground does
    not count: where ground was made of a clip's footholds, it is not known there.
    """
    stance, balls_ws = clip.stance_labels(), clip.joints_ws(3)
    last_ws, fraction = np.array(frames.stride.last_ws), np.array(frames.stride.fraction)
    swings = [
        (slice(piece.start, piece.start + len(swing.fraction)), leg, swing)
        for piece in clip.pieces
        for leg in range(stance.shape[1])
        if (swing := contacts.cut_off_swing(balls_ws[piece], stance[piece], leg)) is not None
    ]
    if not swings:
        return frames
    ends_ws = np.array([[swing.last_ws, swing.next_ws] for _, _, swing in swings])
    for (before, leg, swing), (last, following) in zip(
        swings, heights_under(terrain, ends_ws, SKY), strict=True
    ):
        if last > following:
            last_ws[before, leg], fraction[before, leg] = swing.last_ws, swing.fraction
    stride = replace(
        frames.stride, last_ws=jax.device_put(last_ws), fraction=jax.device_put(fraction)
    )
    return replace(frames, stride=stride)
