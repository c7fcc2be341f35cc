"""Balls of feet that end at the ankle, as in files that leave out joints without motion.

The ball is put where that of a person's foot is. The two proportions are about the means of ten
feet of five captured people: in these the ball is 0.13 to 0.16 of the leg's length from the ankle,
and 0.16 to 0.44 of that distance below it while the foot lies flat.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import contacts
from fitting.datasets.clips.joint_roles import Roles
from fitting.datasets.clips.kinematics import world_from_local
from fitting.datasets.clips.recording import Recording
from fitting.datasets.clips.rigs import (
    USUAL_FOOT,
    flat_frames,
    foot_axes,
    left_directions,
    leg_motion,
    relative_size,
)

USUAL_DROP = 0.3  # of a foot's length, from ankle to ball, that the ball is below the ankle


def with_balls(
    recording: Recording, roles: Roles, fps: float
) -> tuple[Recording, Roles, tuple[str, ...]]:
    """The recording with a joint at the ball of each foot that ends at the ankle, and remarks.

    The joint is named as an end of a bone, `<ankle>_end`. While the foot stands, it points where
    the pelvis does.

    Args:
        recording: m, y up.
        roles: which joint is which.
        fps: frames per second.
    """
    legs, remarks = [], []
    for leg in roles.legs:
        if leg.ends_at_ankle:
            ball_ls, length = _ball(recording, roles, len(legs), fps)
            hip, knee, ankle, _ = leg.joints
            name = recording.names[ankle]
            leg = replace(leg, joints=(hip, knee, ankle, len(recording.names)))
            recording = _with_end(recording, ankle, ball_ls)
            remarks.append(
                f"the {leg.name} foot ends at {name}; its ball is taken to be {length:.3f} m from "
                f"it, {100 * USUAL_FOOT:.0f} % of the leg (people's are 13 to 16 %), where the "
                "pelvis points: a rough guess, so export the toe if there is one"
            )
        legs.append(leg)
    return recording, replace(roles, legs=tuple(legs)), tuple(remarks)


def _ball(recording: Recording, roles: Roles, index: int, fps: float) -> tuple[np.ndarray, float]:
    """Where the ball of a foot is, m, in the space of its ankle, and how far from it, m."""
    positions_ws, rotations_ws = world_from_local(
        recording.parents, recording.positions_ls, recording.rotations_ls
    )
    legs = [leg.joints for leg in roles.legs]
    left_ws = left_directions(
        positions_ws[:, [joints[0] for joints in legs]],
        np.array([leg.side for leg in roles.legs]),
        rotations_ws[:, roles.pelvis],
    )
    leg = leg_motion(roles.legs[index], left_ws, positions_ws, rotations_ws)
    size = relative_size(positions_ws, legs)
    stance = contacts.detect_stances(leg.ankle[:, None], fps, size)[:, 0]
    ankle_from_foot = foot_axes(leg, flat_frames(leg.ankle, leg.ankle, stance))
    bones = ((leg.hip, leg.knee), (leg.knee, leg.ankle))
    length = USUAL_FOOT * sum(
        float(np.median(np.linalg.norm(end - start, axis=-1))) for start, end in bones
    )
    ahead = [0.0, -USUAL_DROP, np.sqrt(1.0 - USUAL_DROP**2)]
    return length * Rotation.from_quat(ankle_from_foot, scalar_first=True).apply(ahead), length


def _with_end(recording: Recording, joint: int, offset_ls: np.ndarray) -> Recording:
    """The recording with one more joint, rigidly below another one."""
    name = f"{recording.names[joint]}_end"
    while name in recording.names:
        name += "_"
    frames, still = len(recording.positions_ls), [1.0, 0.0, 0.0, 0.0]
    rest, channels = recording.rest_rotations_ls, recording.channels
    return replace(
        recording,
        names=(*recording.names, name),
        parents=(*recording.parents, joint),
        offsets_ls=np.concatenate([recording.offsets_ls, [offset_ls]]),
        positions_ls=np.concatenate(
            [recording.positions_ls, np.tile(offset_ls, (frames, 1, 1))], axis=1
        ),
        rotations_ls=np.concatenate(
            [recording.rotations_ls, np.tile(still, (frames, 1, 1))], axis=1
        ),
        rest_rotations_ls=None if rest is None else np.concatenate([rest, [still]]),
        channels=None if channels is None else (*channels, ""),
    )
