"""What a motion file says, before anything is understood: a tree of joints and its local motion.

Forward kinematics of files is SciPy's `Rotation`, one loop over the joints. The jitted
`jaxik.world.skeleton.forward_kinematics` takes minutes to compile for a tree of 44 joints, and run
eagerly it compiles its operations again for every new number of frames (1.5 s on two cores, against
0.05 s here). A test holds the two equal.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z up to y up


@dataclass(frozen=True, eq=False)
class Recording:
    """Joint motion in the units and axes of the file; angles are already quaternions, wxyz."""

    names: tuple[str, ...]
    parents: tuple[int, ...]  # -1 at the root; parents before children
    offsets_ls: Float64[np.ndarray, "joints 3"]  # file units, in the parent's space
    positions_ls: Float64[np.ndarray, "frames joints 3"]  # file units
    rotations_ls: Float64[np.ndarray, "frames joints 4"]
    frame_time: float  # s, as written
    metres_per_unit: float | None = None  # where the file says it
    remarks: tuple[str, ...] = ()

    def scaled(self, factor: float) -> "Recording":
        """The same motion with every length times `factor`."""
        return replace(
            self, offsets_ls=self.offsets_ls * factor, positions_ls=self.positions_ls * factor
        )

    def turned(self, matrix: Float64[np.ndarray, "3 3"]) -> "Recording":
        """The same motion in other axes; the joints' own axes turn with the world's.

        A rotation `R` becomes `M R M⁻¹`, so that a rest pose without rotations stays one.
        """
        turn = Rotation.from_matrix(matrix)
        flat = Rotation.from_quat(self.rotations_ls.reshape(-1, 4), scalar_first=True)
        turned = (turn * flat * turn.inv()).as_quat(scalar_first=True)
        return replace(
            self,
            offsets_ls=self.offsets_ls @ matrix.T,
            positions_ls=self.positions_ls @ matrix.T,
            rotations_ls=turned.reshape(self.rotations_ls.shape),
        )


def place(
    parents: tuple[int, ...],
    positions_ls: Float64[np.ndarray, "frames joints 3"],
    rotations_ls: Float64[np.ndarray, "frames joints 4"],
) -> tuple[Float64[np.ndarray, "frames joints 3"], Float64[np.ndarray, "frames joints 4"]]:
    """Forward kinematics: world positions and rotations, the latter without jumps of sign."""
    positions_ws, rotations_ws = np.empty_like(positions_ls), np.empty_like(rotations_ls)
    turns: list[Rotation] = []
    for joint, parent in enumerate(parents):
        turn = Rotation.from_quat(rotations_ls[:, joint], scalar_first=True)
        pos = positions_ls[:, joint]
        if parent >= 0:
            turn, pos = turns[parent] * turn, positions_ws[:, parent] + turns[parent].apply(pos)
        turns.append(turn)
        positions_ws[:, joint] = pos
        rotations_ws[:, joint] = turn.as_quat(scalar_first=True)
    return positions_ws, continuous(rotations_ws)


def local_from_world(
    parents: tuple[int, ...],
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
) -> tuple[Float64[np.ndarray, "frames joints 3"], Float64[np.ndarray, "frames joints 4"]]:
    """Positions and rotations in the parents' spaces; the inverse of `place`."""
    positions_ls, rotations_ls = positions_ws.copy(), rotations_ws.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            back = Rotation.from_quat(rotations_ws[:, parent], scalar_first=True).inv()
            own = Rotation.from_quat(rotations_ws[:, joint], scalar_first=True)
            positions_ls[:, joint] = back.apply(positions_ws[:, joint] - positions_ws[:, parent])
            rotations_ls[:, joint] = (back * own).as_quat(scalar_first=True)
    return positions_ls, continuous(rotations_ls)


def continuous(rotations: Float64[np.ndarray, "frames *b 4"]) -> np.ndarray:
    """The same rotations with the sign of each quaternion next to that of the frame before."""
    flips = np.sum(rotations[1:] * rotations[:-1], axis=-1) < 0
    signs = np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    return np.concatenate([rotations[:1], rotations[1:] * signs[..., None]])
