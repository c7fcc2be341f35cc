"""`Recording`: what every motion file reader returns, in the file's own units and axes."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

INCH = 0.0254  # m
Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


FURTHEST = 1e6  # m, of any joint from the origin
SHORTEST, LONGEST = 1e-4, 100.0  # m, of a bone of a leg
SLOWEST, FASTEST = 1e-3, 1e5  # frames per second


@dataclass(frozen=True, eq=False)
class Recording:
    """A skeleton and its motion as a file states them, before anything is guessed or converted.

    A reader fills this in and decides nothing: lengths stay in the file's unit and vectors in the
    file's axes. `assemble.clip_from_recording` finds the legs later, and what the file
    leaves open: scale and up axis.
    Only two things are converted: angles become quaternions, and the end of a bone without child
    (BVH's `End Site`) becomes a joint of its own, named `<parent>_end`.

    `positions_ls` repeats `offsets_ls` in every frame, except for joints whose position is animated
    (at least the root, as a rule).
    """

    names: tuple[str, ...]
    """Unique joint names, spelled as in the file."""
    parents: tuple[int, ...]
    """Index of each joint's parent, -1 at the root; parents come before children."""
    offsets_ls: Float64[np.ndarray, "joints 3"]
    """Rest position of each joint in its parent's space, file units."""
    positions_ls: Float64[np.ndarray, "frames joints 3"]
    """Position of each joint in its parent's space, file units; the root's is in the world."""
    rotations_ls: Float64[np.ndarray, "frames joints 4"]
    """Rotation of each joint relative to its parent, unit quaternions, wxyz."""
    frame_time: float
    """Seconds per frame, as written in the file."""
    metres_per_unit: float | None = None
    """Scale, where the file states it; None lets the loader guess it from the legs' length."""
    up_axis: str | None = None
    """Axis that points up, "y" or "z", where the file states it; None lets the loader guess it."""
    rest_rotations_ls: Float64[np.ndarray, "joints 4"] | None = None
    """Rotation of each joint in the rest pose, wxyz, relative to its parent; None: unrotated."""
    channels: tuple[str, ...] | None = None
    """For each joint the channels of a BVH file, in its order and spelling, with blanks between."""
    mask: Bool[np.ndarray, " frames"] | None = None
    """False where the joints are a guess, as a marker was not seen; None where no frame is."""
    remarks: tuple[str, ...] = ()
    """Sentences for the user about anything missing or odd in the file."""

    def __post_init__(self) -> None:
        if self.up_axis not in (None, "y", "z"):
            raise ValueError(f"up_axis is {self.up_axis!r}; wanted 'y', 'z' or None")

    def scaled(self, factor: float) -> "Recording":
        """The same motion with every length multiplied by `factor`."""
        with np.errstate(all="ignore"):  # the loader says which joint is too far away
            offsets_ls, positions_ls = self.offsets_ls * factor, self.positions_ls * factor
        return replace(self, offsets_ls=offsets_ls, positions_ls=positions_ls)

    def rotated(self, matrix: Float64[np.ndarray, "3 3"]) -> "Recording":
        """The same motion in other axes: vectors v become M v, rotations R become M R M⁻¹.

        The joints' own axes change with the world's, so a rest pose without rotations stays one.
        """
        change = Rotation.from_matrix(matrix)

        def turned(rotations: np.ndarray) -> np.ndarray:
            old = Rotation.from_quat(rotations.reshape(-1, 4), scalar_first=True)
            new = (change * old * change.inv()).as_quat(scalar_first=True)
            return new.reshape(rotations.shape)

        rest = self.rest_rotations_ls
        return replace(
            self,
            offsets_ls=self.offsets_ls @ matrix.T,
            positions_ls=self.positions_ls @ matrix.T,
            rotations_ls=turned(self.rotations_ls),
            rest_rotations_ls=None if rest is None else turned(rest),
        )
