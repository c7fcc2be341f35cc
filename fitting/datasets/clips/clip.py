"""A captured or made animation: joints in world space over frames, and what its legs are."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from jaxik.world.skeleton import LegPose, Rig, Skeleton, Transform

from . import contacts
from .joint_roles import find_roles
from .recording import continuous
from .rigs import lateral


@dataclass(frozen=True, eq=False)
class Clip:
    """An animation, metres, y up; NumPy float64, not to be written to."""

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]  # -1 at the root; parents before children
    offsets_ls: Float64[np.ndarray, "joints 3"]  # m, the rest pose, in the parents' spaces
    positions_ws: Float64[np.ndarray, "frames joints 3"]  # m
    rotations_ws: Float64[np.ndarray, "frames joints 4"]  # wxyz
    fps: float  # snapped to a usual rate
    raw_frame_time: float  # s, as the file has it
    source: str  # file name
    scale: float  # m per unit of the file
    up_axis: str  # of the file: y or z
    dialect: str | None  # how the legs were recognised
    measured: Rig | None  # float64; None where no leg was found
    stance: Bool[np.ndarray, "frames legs"] | None = None  # contact labels that came with the clip
    mask: Bool[np.ndarray, " frames"] | None = None  # False: not to be trusted, as a marker popped
    slide: Float64[np.ndarray, " frames"] | None = None  # 0..1, 1 while the character slides
    remarks: tuple[str, ...] = ()  # what was guessed or odd

    def __post_init__(self) -> None:
        for name in ("offsets_ls", "positions_ws", "rotations_ws", "stance", "mask", "slide"):
            if (array := getattr(self, name)) is not None:
                view = array.view()
                view.flags.writeable = False
                object.__setattr__(self, name, view)

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.positions_ws)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last."""
        return (self.frame_count - 1) / self.fps

    @cached_property
    def body_height(self) -> float:
        """Median over the frames of the highest joint over the lowest, m."""
        return float(np.median(np.ptp(self.positions_ws[..., 1], axis=1)))

    @property
    def rig(self) -> Rig:
        """The legs, in JAX's default precision; ValueError where none were found."""
        if self.measured is None:
            find_roles(self.joint_names, self.parents)  # says what is missing
            raise ValueError(f"{self.source} was loaded without legs; load it with joints=...")
        return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)), self.measured)

    @property
    def skeleton(self) -> Skeleton:
        """The tree of joints with its rest offsets, in JAX's default precision."""
        return Skeleton(jax.device_put(self.offsets_ls), self.joint_names, self.parents)

    def joints_ws(self, role: int) -> Float64[np.ndarray, "frames legs 3"]:
        """Where a joint of each leg is: `role` 0 hip, 1 knee, 2 ankle, 3 toe."""
        return self.positions_ws[:, [joints[role] for joints in self.rig.joints]]

    def stance_labels(self) -> Bool[np.ndarray, "frames legs"]:
        """The contact labels that came with the clip, or those found from its motion."""
        return (
            contacts.stance_labels(self.joints_ws(3), self.fps)
            if self.stance is None
            else self.stance
        )

    def leg_pose_ws(self) -> LegPose:
        """World transforms, (frames, legs), of the legs' joints, in JAX's default precision."""
        joints = np.array(self.rig.joints)
        return LegPose(
            *(
                Transform(
                    jax.device_put(self.positions_ws[:, column]),
                    jax.device_put(self.rotations_ws[:, column]),
                )
                for column in joints.T
            )
        )

    def left_ws(self) -> Float64[np.ndarray, "frames 3"]:
        """Unit vectors to the character's left."""
        rig = self.rig
        hips = [joints[0] for joints in rig.joints]
        side = np.asarray(rig.side, np.float64)
        return lateral(self.positions_ws, self.rotations_ws, rig.pelvis, hips, side)

    def world_from_model(
        self, floor: float = 0.0, up_ws: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0)
    ) -> Transform:
        """The character's root, (frames): on the floor under the pelvis, facing forward.

        Forward is at right angles, in the ground plane, to the character's left. While that points
        up or down the heading is carried over from the frames around.

        Args:
            floor: height of the floor along up, m.
            up_ws: unit; on a wall its normal, and the wall is the floor.
        """
        upright = _upright(np.asarray(up_ws, np.float64))
        yaw = self._heading(upright)
        pos = self.positions_ws[:, self.rig.pelvis] @ upright.as_matrix().T
        pos = upright.inv().apply(pos * [1.0, 0.0, 1.0] + [0.0, floor, 0.0])
        zero = np.zeros_like(yaw)
        rot = np.stack([np.cos(yaw / 2), zero, np.sin(yaw / 2), zero], axis=-1)
        turned = upright.inv() * Rotation.from_quat(rot, scalar_first=True)
        return Transform(*jax.device_put((pos, turned.as_quat(scalar_first=True))))

    def _heading(self, upright: Rotation) -> Float64[np.ndarray, " frames"]:
        """Yaw of the character, rad, without jumps; 0 looks along +z, pi/2 along +x (left)."""
        flat = upright.apply(self.left_ws())[:, [0, 2]]
        known = np.linalg.norm(flat, axis=-1) > 0.1
        if not known.any():
            return np.zeros(len(flat))
        frames = np.arange(len(flat))
        yaw = np.unwrap(np.arctan2(-flat[known, 1], flat[known, 0]))
        return np.interp(frames, frames[known], yaw)

    def with_motion(self, positions_ws: np.ndarray, rotations_ws: np.ndarray) -> "Clip":
        """The same joints moving otherwise, over as many frames."""
        return replace(self, positions_ws=positions_ws, rotations_ws=continuous(rotations_ws))

    def at(self, frames: np.ndarray | slice) -> "Clip":
        """The clip with only these frames."""
        return replace(
            self,
            positions_ws=self.positions_ws[frames],
            rotations_ws=self.rotations_ws[frames],
            stance=None if self.stance is None else self.stance[frames],
            mask=None if self.mask is None else self.mask[frames],
            slide=None if self.slide is None else self.slide[frames],
        )


def _upright(up_ws: Float64[np.ndarray, "3"]) -> Rotation:
    """The shortest turn that takes up to the y axis; a half turn about x for the opposite one."""
    quat = np.array([-up_ws[2], 0.0, up_ws[0], 1.0 + up_ws[1]])
    return Rotation.from_quat(quat if quat.any() else [1.0, 0.0, 0.0, 0.0])
