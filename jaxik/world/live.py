"""Frames from what an engine has in each of its own: joints, the root, and the time between."""

# pyright: reportArgumentType=false, reportReturnType=false, reportOperatorIssue=false

import numpy as np
from jaxtyping import ArrayLike

from jaxik.maths import quat

from .frame import Frame, Stride
from .skeleton import LegPose, Transform


class FrameBuilder:
    """Frames of one character, whose speeds come from the frame before.

    All feet have foot IK in full, on the ground, with footholds that nobody foretells. Change what
    is otherwise with `dataclasses.replace`.
    """

    def __init__(self) -> None:
        self._places_ws: np.ndarray | None = None  # of the root, the ankles and the toes
        self._platforms: Transform | None = None

    def build(
        self,
        world_from_model: Transform,
        pose: LegPose,
        dt: float,
        platforms: Transform | None = None,
        platform: int = -1,
        *,
        restart: bool = False,
    ) -> Frame:
        """The next frame, as NumPy arrays with the type of the pose.

        Args:
            world_from_model: the root: position (3), m, and rotation (4).
            pose: hips, knees, ankles and toes: positions (legs, 3), m, and rotations (legs, 4), in
                model space.
            dt: s, since the frame before; 0 or less is a pause.
            platforms: `world_from_platform` (platforms) of all that move, now; None for none.
            platform: number of the one that carries the character, over which speeds are; -1 for
                none.
            restart: whether nothing leads here from the frame before, as after a teleport. The
                first frame restarts anyway.

        Raises:
            ValueError: if `platform` is not the number of one.
        """
        floats = np.asarray(pose.hip.pos).dtype

        def arrays(transform: Transform) -> Transform:
            return Transform(np.asarray(transform.pos, floats), np.asarray(transform.rot, floats))

        world_from_model = arrays(world_from_model)
        pose = LegPose(*map(arrays, (pose.hip, pose.knee, pose.ankle, pose.toe)))
        legs = len(pose.hip.pos)
        now = arrays(platforms or Transform(np.zeros((0, 3)), np.zeros((0, 4))))
        if not -1 <= platform < len(now.pos):
            raise ValueError(
                f"platform is {platform}; there are {len(now.pos)} platforms, numbered from 0, "
                "and -1 is none"
            )
        feet = np.concatenate([pose.ankle.pos, pose.toe.pos])
        places_ws = np.concatenate([world_from_model.pos[None], _apply(world_from_model, feet)])
        before, places = self._platforms, self._places_ws
        if restart or before is None or places is None or before.pos.shape != now.pos.shape:
            before, places = now, places_ws
        if platform >= 0:
            places = _apply(_at(now, platform), _unapply(_at(before, platform), places))
        velocity_ws = (places_ws - places) / dt if dt > 0 else 0.0 * places_ws
        speeds = np.linalg.norm(velocity_ws, axis=-1)
        self._places_ws, self._platforms = places_ws, now
        ones, whole = np.ones(legs, floats), np.ones((), floats)
        return Frame(
            world_from_model=world_from_model,
            pose=pose,
            weight=ones,
            grounded=whole,
            slide=0 * whole,
            velocity_ws=velocity_ws[0].astype(floats),
            foot_speed=speeds[1 : legs + 1].astype(floats),
            toe_speed=speeds[legs + 1 :].astype(floats),
            stride=Stride.unknown(ones),
            dt=np.asarray(dt, floats),
            platforms=now,
            platforms_before=before,
            restart=np.asarray(restart),
        )


def _apply(transform: Transform, points: ArrayLike) -> np.ndarray:
    return np.asarray(transform.apply(points))


def _unapply(transform: Transform, points: ArrayLike) -> np.ndarray:
    return np.asarray(quat.unrotate(transform.rot, points - transform.pos))


def _at(platforms: Transform, number: int) -> Transform:
    return Transform(platforms.pos[number], platforms.rot[number])
