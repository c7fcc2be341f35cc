"""Between clips and the pipeline: a clip as frames to solve, and a clip of what was solved."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array
from scipy.spatial.transform import Rotation

import jaxik
from jaxik.world.frame import UP, Stride

from .clips import contacts
from .clips.clip import Clip
from .clips.recording import local_from_world

Direction = Sequence[float] | np.ndarray


def frames_from_clip(clip: Clip, *, floor: float = 0.0, up_ws: Direction = UP) -> jaxik.Frame:
    """The clip as the pipeline's input, its leaves leading with frames, in JAX's default precision.

    Foot IK has its whole weight, the ground does not move, and the character slides where the clip
    says so. Strides are told by the clip's contacts.

    Args:
        clip: with legs.
        floor: height of the floor on which the clip was animated, m; model space begins there.
        up_ws: that floor's normal, unit; another one for a clip on a wall.
    """
    world = clip.world_from_model(floor, up_ws)
    pose = _into(world, clip.leg_pose_ws())
    legs = len(clip.rig.joints)
    dtype = world.pos.dtype
    velocity, foot, toe = (
        _velocity(places, clip.fps)
        for places in (np.asarray(world.pos), clip.joints_ws(2), clip.joints_ws(3))
    )
    slide = np.zeros(clip.frame_count) if clip.slide is None else clip.slide

    def told(numbers: np.ndarray) -> Array:
        return jax.device_put(numbers.astype(dtype))  # in JAX the conversion would be a program

    upright = np.tile([1.0, 0.0, 0.0, 0.0], (clip.frame_count, 1))
    return jaxik.Frame(
        world_from_model=world,
        pose=pose,
        weight=told(np.ones((clip.frame_count, legs))),
        slide=told(slide),
        velocity_ws=told(velocity),
        foot_speed=told(np.linalg.norm(foot, axis=-1)),
        toe_speed=told(np.linalg.norm(toe, axis=-1)),
        stride=Stride(*map(told, _stride(clip))),
        dt=told(np.full(clip.frame_count, 1.0 / clip.fps)),
        platform=jaxik.Transform(told(np.zeros(world.pos.shape)), told(upright)),
    )


@jax.jit  # outside jit one program, not thirty
@jax.vmap
def _into(world: jaxik.Transform, pose_ws: jaxik.LegPose) -> jaxik.LegPose:
    """Legs of each frame in model space."""
    return pose_ws.transformed(world.inverse())


@jax.jit
@jax.vmap
def _out_of(
    world: jaxik.Transform, body: jaxik.Transform, pose: jaxik.LegPose
) -> tuple[jaxik.Transform, jaxik.LegPose]:
    """The body's move and the legs of each frame in world space."""
    return world @ body @ world.inverse(), pose.transformed(world)


def _velocity(places: np.ndarray, fps: float) -> np.ndarray:
    """Of points (frames, ..., 3) since the frame before, m/s; at first as at second."""
    steps = np.diff(places, axis=0) * fps
    return np.concatenate([steps[:1], steps]) if len(steps) else np.zeros(places.shape)


def _stride(clip: Clip) -> tuple[np.ndarray, ...]:
    """A `Stride`: where each foot stood last and will stand next, if it ever stands."""
    stance, balls = clip.stance_labels(), clip.joints_ws(3)
    known = np.broadcast_to(stance.any(axis=0), stance.shape)
    last_ws, next_ws, share = np.zeros(balls.shape), np.zeros(balls.shape), np.zeros(stance.shape)
    for leg in np.flatnonzero(known[0]):
        falls = contacts.footfalls(balls[:, leg], stance[:, leg])
        last_ws[:, leg], next_ws[:, leg] = falls.places_ws[falls.last], falls.places_ws[falls.next]
        share[:, leg] = falls.share
    return stance, last_ws, next_ws, share, known


def clip_from_result(
    clip: Clip, result: jaxik.Result, *, floor: float = 0.0, up_ws: Direction = UP
) -> Clip:
    """The clip as the pipeline left it.

    Hips, knees, ankles and toes are the solved ones; joints that hang on them keep their place on
    them; all other joints go with the body.

    Args:
        clip: the input, from which `frames_from_clip` made the frames.
        result: of all its frames.
        floor, up_ws: as given to `frames_from_clip`.
    """
    world = clip.world_from_model(floor, up_ws)
    body, solved = _out_of(world, result.body, result.pose)
    carry_rot, carry_pos = _rotation(body.rot), np.asarray(body.pos)

    places, turns = clip.positions_ws.copy(), clip.rotations_ws.copy()
    on_leg = {
        joint: (np.asarray(part.pos)[:, leg], np.asarray(part.rot)[:, leg])
        for leg, joints in enumerate(clip.rig.joints)
        for joint, part in zip(
            joints, (solved.hip, solved.knee, solved.ankle, solved.toe), strict=True
        )
    }
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    hanging: set[int] = set(on_leg)
    for joint, parent in enumerate(clip.parents):
        if joint in on_leg:
            places[:, joint], turns[:, joint] = on_leg[joint]
        elif parent in hanging:
            hanging.add(joint)
            holder = _rotation(turns[:, parent])
            places[:, joint] = places[:, parent] + holder.apply(positions_ls[:, joint])
            turns[:, joint] = _wxyz(holder * _rotation(rotations_ls[:, joint]))
        else:
            places[:, joint] = carry_pos + carry_rot.apply(places[:, joint])
            turns[:, joint] = _wxyz(carry_rot * _rotation(turns[:, joint]))
    return clip.with_motion(places, turns)


def _rotation(wxyz) -> Rotation:
    return Rotation.from_quat(np.asarray(wxyz, np.float64), scalar_first=True)


def _wxyz(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def positions_by_role(clip: Clip) -> dict[str, np.ndarray]:
    """World positions, m, as the blocks benchmark's scoring reads them.

    `pelvis` is (frames, 3); `hip`, `knee`, `ankle` and `ball` are (frames, legs, 3).
    """
    roles = ("hip", "knee", "ankle", "ball")
    named = {role: clip.joints_ws(index) for index, role in enumerate(roles)}
    return {"pelvis": clip.positions_ws[:, clip.rig.pelvis], **named}
