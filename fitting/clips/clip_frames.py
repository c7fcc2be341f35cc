"""Conversion between clips and the foot IK pipeline: `Clip` to `Frame`, and `Result` to `Clip`."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Array, Bool, Float64
from scipy.spatial.transform import Rotation

import jaxik
from jaxik.world.frame import FORWARD, UP, Stride

from . import contacts
from .clip import Clip
from .flight import grounded_track
from .joint_maps import find_trunk
from .rigs import rotation

Direction = Sequence[float] | np.ndarray


def frames_from_clip(
    clip: Clip,
    *,
    floor: float = 0.0,
    up_ws: Direction = UP,
    rise: Float64[np.ndarray, " frames"] | None = None,
    stride_scale: float | None = None,
    orientation: float | None = None,
) -> jaxik.Frame:
    """The clip as the pipeline's input: one `Frame` whose leaves have a leading frames axis.

    Foot IK is at full weight, there are no platforms, and the character slides where the clip
    says so. Strides follow from the clip's contact labels. After a teleport (`Clip.cuts`) memory,
    speeds and strides start anew. Numbers are in JAX's default precision.

    Args:
        clip: with legs.
        floor: height of the floor on which the clip was animated, m; the origin of model space.
        up_ws: unit normal of that floor; for a climber, the wall's.
        rise: how far the character is raised along it in each frame, m; see `ground_path`. Speeds
            stay those of the animation on its floor.
        stride_scale: by which strides are to be scaled, where the clip's root is as much faster
            than its feet step (`clips.edit.at_speed`); None leaves them as animated.
        orientation: rad, from the direction in which the clip's feet step to that in which its root
            moves (`clips.edit.in_direction`), positive to the left; None leaves them as animated.

    Raises:
        ValueError: the clip has no legs.
    """
    world = clip.world_from_model(floor, up_ws)
    pose = _model_from_world(world, clip.leg_pose_ws())
    legs = len(clip.rig.joints)
    dtype = world.pos.dtype
    root_ws = np.asarray(world.pos)
    ankles, balls = (
        _turned(clip.joints_ws(index), root_ws, up_ws, orientation or 0.0) for index in (2, 3)
    )
    ahead = _feet_ahead(clip, up_ws, orientation or 0.0)
    moved = _scaled_strides(root_ws, balls, up_ws, stride_scale)
    root_velocity, ankle_velocity, toe_velocity = (
        np.concatenate([_velocity(positions[piece], clip.fps) for piece in clip.pieces])
        for positions in (root_ws, ankles + moved, balls + moved)
    )
    slide = np.zeros(clip.frame_count) if clip.slide is None else clip.slide
    weight = np.ones((clip.frame_count, legs)) if clip.weight is None else clip.weight

    def array(values: np.ndarray) -> Array:
        return jax.device_put(values.astype(dtype))  # a conversion in JAX would compile a program

    def everywhere(value: float | None) -> Array | None:
        return None if value is None else array(np.full(clip.frame_count, float(value)))

    labels = clip.stance_labels()
    strides = [_stride(labels[at], (balls + moved)[at], ahead[at], up_ws) for at in clip.pieces]
    none = jaxik.Transform(*(array(np.zeros((clip.frame_count, 0, size))) for size in (3, 4)))
    frames = jaxik.Frame(
        world_from_model=world,
        pose=pose,
        weight=array(weight),
        grounded=array(grounded_track(clip)),
        slide=array(slide),
        velocity_ws=array(root_velocity),
        foot_speed=array(np.linalg.norm(ankle_velocity, axis=-1)),
        toe_speed=array(np.linalg.norm(toe_velocity, axis=-1)),
        stride=Stride(*(array(np.concatenate(parts)) for parts in zip(*strides, strict=True))),
        dt=array(np.full(clip.frame_count, 1.0 / clip.fps)),
        platforms=none,
        platforms_before=none,
        stride_scale=everywhere(stride_scale),
        orientation=everywhere(orientation),
        restart=jax.device_put(np.isin(np.arange(clip.frame_count), clip.cuts))
        if clip.cuts
        else None,
    )
    return frames if rise is None else frames.translated(array(_along(up_ws, rise)))


def raised(clip: Clip, rise: Float64[np.ndarray, " frames"] | None, up_ws: Direction = UP) -> Clip:
    """The clip with the whole character moved along `up_ws` by `rise`, m, in each frame.

    Its contact labels stay those that it has on its floor. None returns the same clip.
    """
    if rise is None:
        return clip
    moved = clip.with_motion(clip.positions_ws + _along(up_ws, rise)[:, None], clip.rotations_ws)
    return replace(moved, stance=clip.stance_labels())


def _along(up_ws: Direction, distance: np.ndarray) -> Float64[np.ndarray, "frames 3"]:
    return distance[:, None] * np.asarray(up_ws, np.float64)


@jax.jit  # as one program; without it thirty operations are compiled
@jax.vmap
def _model_from_world(world: jaxik.Transform, pose_ws: jaxik.LegPose) -> jaxik.LegPose:
    """Leg poses of each frame in model space."""
    return pose_ws.transformed(world.inverse())


@jax.jit
@jax.vmap
def _world_from_model(
    world: jaxik.Transform, body: jaxik.Transform, pose: jaxik.LegPose
) -> tuple[jaxik.Transform, jaxik.LegPose]:
    """The body's displacement and the leg poses of each frame in world space."""
    return world @ body @ world.inverse(), pose.transformed(world)


def _velocity(positions: np.ndarray, fps: float) -> np.ndarray:
    """Velocity of points (frames, ..., 3) since the previous frame, m/s; the first repeats."""
    steps = np.diff(positions, axis=0) * fps
    return np.concatenate([steps[:1], steps]) if len(steps) else np.zeros(positions.shape)


def _turned(
    points_ws: np.ndarray, root_ws: np.ndarray, up_ws: Direction, angle: float
) -> Float64[np.ndarray, "frames legs 3"]:
    """Points of the feet turned about the root's up by an angle, rad."""
    if angle == 0.0:
        return points_ws
    turn = Rotation.from_rotvec(angle * np.asarray(up_ws, np.float64))
    arms = points_ws - root_ws[:, None]
    return root_ws[:, None] + turn.apply(arms.reshape(-1, 3)).reshape(arms.shape)


def _feet_ahead(clip: Clip, up_ws: Direction, angle: float) -> Float64[np.ndarray, "frames legs 3"]:
    """Where the feet point, unit, turned about `up_ws` by an angle, rad."""
    ankles = np.array(clip.rig.joints)[:, 2]
    turn = Rotation.from_rotvec(angle * np.asarray(up_ws, np.float64))
    axes = rotation(np.asarray(clip.rig.ankle_from_foot, np.float64)).apply(FORWARD)
    feet = [
        (turn * rotation(clip.rotations_ws[:, ankle])).apply(axis)
        for ankle, axis in zip(ankles, axes, strict=True)
    ]
    return np.stack(feet, axis=1)


def _scaled_strides(
    root_ws: np.ndarray, balls_ws: np.ndarray, up_ws: Direction, scale: float | None
) -> Float64[np.ndarray, "frames legs 3"] | float:
    """How far scaled strides move each foot, m: see `jaxik.stages.warp.StrideWarp`."""
    if scale is None:
        return 0.0
    offset = balls_ws - root_ws[:, None]
    up = np.asarray(up_ws, np.float64)
    return (scale - 1.0) * (offset - (offset @ up)[..., None] * up)


def _stride(
    stance: Bool[np.ndarray, "frames legs"],
    balls: Float64[np.ndarray, "frames legs 3"],
    ahead: Float64[np.ndarray, "frames legs 3"],
    up_ws: Direction,
) -> tuple[np.ndarray, ...]:
    """The fields of a `Stride`, in order; unknown where a foot will not stand any more.

    A swing that the end cuts off goes as far as a whole one before it, and takes as long.
    """
    known = np.cumsum(stance[::-1], axis=0)[::-1] > 0
    last_ws, next_ws, aside_ws, last_ahead, next_ahead = (np.zeros(balls.shape) for _ in range(5))
    fraction = np.zeros(stance.shape)
    for leg in map(int, np.flatnonzero(stance.any(axis=0))):
        falls = contacts.footfalls(balls[:, leg], stance[:, leg], up_ws)
        last_ws[:, leg] = falls.positions_ws[falls.last]
        next_ws[:, leg] = falls.positions_ws[falls.next]
        fraction[:, leg] = falls.swing_fraction
        aside_ws[:, leg] = falls.aside_ws[falls.last]
        spans = contacts.runs(stance[:, leg])
        ways = np.array([ahead[first : last + 1, leg].mean(axis=0) for first, last in spans])
        last_ahead[:, leg], next_ahead[:, leg] = ways[falls.last], ways[falls.next]
        backward = contacts.cut_off_swing(balls[::-1], stance[::-1], leg, up_ws)
        if backward is not None:
            landed = spans[-1][0]
            next_ws[landed:, leg] = backward.last_ws
            fraction[-len(backward.fraction) :, leg] = 1.0 - backward.fraction[::-1]
            known[:, leg] = True
    return stance, last_ws, next_ws, fraction, known, aside_ws, last_ahead, next_ahead


def clip_from_result(
    clip: Clip,
    result: jaxik.Result,
    *,
    floor: float = 0.0,
    up_ws: Direction = UP,
    rise: Float64[np.ndarray, " frames"] | None = None,
) -> Clip:
    """The clip with the motion that the pipeline returned.

    Hips, knees, ankles and toes are the solved ones. Joints below them stay rigid on their parents,
    and all others move with the body. Where the system bends the spine, its base and the head turn,
    as far as the skeleton has these joints (`joint_maps.find_trunk`), and the joints of the spine
    share the twist against a turned pelvis.

    Args:
        clip: the clip from which `frames_from_clip` made the frames.
        result: of all its frames.
        floor: as passed to `frames_from_clip`.
        up_ws: as passed to `frames_from_clip`.
        rise: as passed to `frames_from_clip`.

    Raises:
        ValueError: the poses are not finite.
    """
    for transform in (result.body, *vars(result.pose).values()):
        size = np.linalg.norm(transform.rot, axis=-1)  # 0 after a turn by an infinite angle
        if not (np.isfinite(transform.pos).all() and np.isfinite(size).all() and size.all()):
            raise ValueError("these parameters give poses that are not finite")
    world = clip.world_from_model(floor, up_ws)
    if rise is not None:
        world = jaxik.Transform(world.pos + _along(up_ws, rise), world.rot)
        clip = raised(clip, rise, up_ws)
    body, solved = _world_from_model(world, result.body, result.pose)

    positions_ws, rotations_ws = clip.positions_ws.copy(), clip.rotations_ws.copy()
    solved_joints = {
        joint: (np.asarray(transform.pos)[:, leg], np.asarray(transform.rot)[:, leg])
        for leg, joints in enumerate(clip.rig.joints)
        # A foot that ends at its ankle has that for its toe, which does not bend it.
        for joint, transform in zip(
            joints[::-1], (solved.toe, solved.ankle, solved.knee, solved.hip), strict=True
        )
    }
    on_legs = with_descendants(solved_joints, clip.parents)
    for joint in on_legs:
        if joint in solved_joints:
            positions_ws[:, joint], rotations_ws[:, joint] = solved_joints[joint]
        else:
            parent = clip.parents[joint]
            turn_ws = (
                rotation(rotations_ws[:, parent]) * rotation(clip.rotations_ws[:, parent]).inv()
            )
            offset_ws = clip.positions_ws[:, joint] - clip.positions_ws[:, parent]
            positions_ws[:, joint] = positions_ws[:, parent] + turn_ws.apply(offset_ws)
            rotations_ws[:, joint] = _wxyz(turn_ws * rotation(rotations_ws[:, joint]))
    others = [joint for joint in range(len(clip.parents)) if joint not in on_legs]
    _turn(rotation(body.rot), positions_ws, rotations_ws, others, np.zeros_like(body.pos))
    positions_ws[:, others] += np.asarray(body.pos)[:, None]
    trunk = find_trunk(clip.joint_names, clip.parents, clip.rig.pelvis)
    corrections, upright = result.corrections, rotation(world.rot)
    turns = [(joint, corrections.twist, 1.0 / len(trunk.twisted)) for joint in trunk.twisted]
    if trunk.spine is not None:
        turns += [(trunk.spine, corrections.spine, 1.0), (trunk.head, corrections.head, 1.0)]
    for joint, turn_ms, share in turns:
        if joint is not None and turn_ms is not None:
            turn_ws = upright * rotation(turn_ms) ** share * upright.inv()
            above = with_descendants([joint], clip.parents)
            _turn(turn_ws, positions_ws, rotations_ws, above, positions_ws[:, joint])
    return clip.with_motion(positions_ws, rotations_ws)


def with_descendants(roots: Iterable[int], parents: Sequence[int]) -> list[int]:
    """Joints and all below them in the tree, the joints themselves first."""
    joints = list(roots)
    for child, parent in enumerate(parents):
        if parent in joints and child not in joints:
            joints.append(child)
    return joints


def _turn(
    turn_ws: Rotation,
    positions_ws: np.ndarray,
    rotations_ws: np.ndarray,
    joints: Sequence[int],
    pivot_ws: Float64[np.ndarray, "frames 3"],
) -> None:
    """Turns these joints about a point, in place, as one body in each frame."""
    turns = Rotation.from_quat(np.repeat(turn_ws.as_quat(), len(joints), axis=0))
    arms = positions_ws[:, joints] - pivot_ws[:, None]
    positions_ws[:, joints] = pivot_ws[:, None] + turns.apply(arms.reshape(-1, 3)).reshape(
        arms.shape
    )
    turned = _wxyz(turns * rotation(rotations_ws[:, joints]))
    rotations_ws[:, joints] = turned.reshape(*arms.shape[:2], 4)


def positions_by_role(clip: Clip) -> dict[str, np.ndarray]:
    """World positions, m, under the names of an archive of positions.

    `pelvis` is (frames, 3); `hip`, `knee`, `ankle` and `ball` are (frames, legs, 3).
    """
    roles = ("hip", "knee", "ankle", "ball")
    positions = {role: clip.joints_ws(index) for index, role in enumerate(roles)}
    return {"pelvis": clip.positions_ws[:, clip.rig.pelvis], **positions}


def _wxyz(turn: Rotation) -> np.ndarray:
    return turn.as_quat(scalar_first=True)
