"""Forward kinematics of motion files, and its inverse, with SciPy's `Rotation`.

`jaxik.world.skeleton.forward_kinematics` computes the same on JAX arrays, and a test holds the two
equal. It is not used here because it takes minutes to compile for a skeleton of 44 joints, and run
eagerly it compiles its operations again for every new number of frames: 1.5 s on two cores, against
0.05 s for the loop below.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

Positions = Float64[np.ndarray, "frames joints 3"]
Rotations = Float64[np.ndarray, "frames joints 4"]  # wxyz
JUMP = 0.5  # of a leg's length
JUMP_RATIO = 4.0  # a runner filmed at 5 Hz moves as far in each frame, but evenly


def world_from_local(
    parents: tuple[int, ...], positions_ls: Positions, rotations_ls: Rotations
) -> tuple[Positions, Rotations]:
    """World positions and rotations of joints given in their parents' spaces.

    Args:
        parents: index of each joint's parent, -1 at the root; parents come before children.
        positions_ls: in the parents' spaces, any unit of length.
        rotations_ls: relative to the parents, wxyz.

    Returns:
        Positions in the same unit, and rotations that are continuous over the frames.
    """
    positions_ws, rotations_ws = np.empty_like(positions_ls), np.empty_like(rotations_ls)
    world_rotations: list[Rotation] = []
    for joint, parent in enumerate(parents):
        rot = Rotation.from_quat(rotations_ls[:, joint], scalar_first=True)
        pos = positions_ls[:, joint]
        if parent >= 0:
            parent_rot = world_rotations[parent]
            rot, pos = parent_rot * rot, positions_ws[:, parent] + parent_rot.apply(pos)
        world_rotations.append(rot)
        positions_ws[:, joint] = pos
        rotations_ws[:, joint] = rot.as_quat(scalar_first=True)
    return positions_ws, continuous(rotations_ws)


def local_from_world(
    parents: tuple[int, ...], positions_ws: Positions, rotations_ws: Rotations
) -> tuple[Positions, Rotations]:
    """Positions and rotations in the parents' spaces: the inverse of `world_from_local`."""
    positions_ls, rotations_ls = positions_ws.copy(), rotations_ws.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            parent_from_world = Rotation.from_quat(rotations_ws[:, parent], scalar_first=True).inv()
            rot = Rotation.from_quat(rotations_ws[:, joint], scalar_first=True)
            offset_ws = positions_ws[:, joint] - positions_ws[:, parent]
            positions_ls[:, joint] = parent_from_world.apply(offset_ws)
            rotations_ls[:, joint] = (parent_from_world * rot).as_quat(scalar_first=True)
    return positions_ls, continuous(rotations_ls)


def cuts(root_ws: Float64[np.ndarray, "frames 3"], leg: float) -> tuple[int, ...]:
    """Frames to which the root has not moved but jumped, as in a teleport.

    It jumps by more than half a leg, and by several times what it moves in the frames beside.

    Args:
        root_ws: its positions, m.
        leg: length of a leg, m.
    """
    steps = np.linalg.norm(np.diff(root_ws, axis=0), axis=-1)
    beside = np.concatenate([[0.0], steps, [0.0]])
    beside = np.maximum(beside[:-2], beside[2:])
    jumps = (steps > JUMP * leg) & (steps > JUMP_RATIO * beside)
    return tuple((np.flatnonzero(jumps) + 1).tolist())


def continuous(rotations: Float64[np.ndarray, "frames *b 4"]) -> np.ndarray:
    """The same rotations, each quaternion with the sign nearer to that of the previous frame.

    q and -q are the same rotation; without sign flips they can be interpolated and compared.
    """
    flips = np.sum(rotations[1:] * rotations[:-1], axis=-1) < 0
    signs = np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    return np.concatenate([rotations[:1], rotations[1:] * signs[..., None]])
