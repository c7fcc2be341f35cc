"""`Clip`: an animation as joints in world space over frames, with its legs identified.

Forward kinematics of motion files, and its inverse, use SciPy's `Rotation`. A test holds them equal
to `jaxik.world.skeleton.forward_kinematics`, which takes minutes to compile for 44 joints; run
eagerly, it compiles anew for every number of frames: 1.5 s on two cores, against 0.05 s here.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from jaxik.world import body
from jaxik.world.skeleton import LegPose, Rig, Skeleton, Transform

from . import contacts, skating
from .joint_maps import ADVICE, find_roles
from .rigs import left_directions, rotation
from .skating import Skating

# Optional fields with frames.
TRACKS = ("stance", "mask", "slide", "grounded", "weight", "probability", "left_out")

INCH = 0.0254  # m
Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

FURTHEST = 1e6  # m, of any joint from the origin
SHORTEST, LONGEST = 1e-4, 100.0  # m, of a bone of a leg
SLOWEST, FASTEST = 1e-3, 1e5  # frames per second

Positions = Float64[np.ndarray, "frames joints 3"]
Rotations = Float64[np.ndarray, "frames joints 4"]  # wxyz
JUMP = 0.5  # of a leg's length
JUMP_RATIO = 4.0  # a runner filmed at 5 Hz moves as far in each frame, but evenly


@dataclass(frozen=True, eq=False)
class Model:
    """A glTF file with a skinned mesh, whose animation can be replaced.

    No node of its skeleton is scaled differently along its axes.
    """

    header: Mapping[str, Any]
    """Its JSON; all buffers are one, the binary part."""
    binary: bytes
    nodes: Mapping[str, int]
    """Number of the node of each joint, by the joint's name."""
    scales: Mapping[str, float]
    """Of each joint in the world, m for each unit of length in its space."""
    above: Float64[np.ndarray, "4 4"]
    """From the space in which the skeleton's root is placed to the world."""


@dataclass(frozen=True, eq=False)
class Clip:
    """An animation in metres with y up. Arrays are NumPy float64 and read-only.

    `load_clip` makes one from a file, `synthetic` makes them from parameters, and the functions in
    `edit` return changed copies.
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    """Index of each joint's parent, -1 at the root; parents come first."""
    offsets_ls: Float64[np.ndarray, "joints 3"]
    """m, rest pose, in the parents' spaces."""
    positions_ws: Float64[np.ndarray, "frames joints 3"]
    """Metres."""
    rotations_ws: Float64[np.ndarray, "frames joints 4"]
    """Unit quaternions, wxyz."""
    fps: float
    """Frames per second, rounded to a common rate."""
    raw_frame_time: float
    """s, as written in the file."""
    source: str
    """File name."""
    scale: float
    """Metres per unit of the file."""
    up_axis: str
    """Of the file: y or z."""
    dialect: str | None
    """Naming convention by which the legs were recognised."""
    measured_rig: Rig | None
    """Float64; None where no leg was recognised."""
    stance: Bool[np.ndarray, "frames legs"] | None = None
    """Contact labels stored with the clip."""
    mask: Bool[np.ndarray, " frames"] | None = None
    """False where a frame must not be trusted."""
    slide: Float64[np.ndarray, " frames"] | None = None
    """0..1, 1 while the character slides."""
    grounded: Float64[np.ndarray, " frames"] | None = None
    """0..1, 0 in the air, on a seat or on a ladder."""
    weight: Float64[np.ndarray, "frames legs"] | None = None
    """0..1, how much foot IK each leg gets."""
    probability: Float64[np.ndarray, "frames legs"] | None = None
    """0..1, of stances by a contacts file: the program's, 0 for one by hand; 0 in swings."""
    left_out: Bool[np.ndarray, "frames legs"] | None = None
    """True in stances around which the fit leaves the leg out."""
    start: float = 0.0
    """s, of the first frame in the clip's file."""
    remarks: tuple[str, ...] = ()
    """Guesses and oddities, for the user."""
    rest_rotations_ls: Float64[np.ndarray, "joints 4"] | None = None
    """Rest pose, wxyz, relative to the parents; None where no joint is rotated in it."""
    channels: tuple[str, ...] | None = None
    """Of a BVH file, for each joint in the file's order and spelling, with blanks between."""
    model: Model | None = None
    """Of a glTF file with a skinned mesh: what else is in it."""

    def __post_init__(self) -> None:
        for name in ("offsets_ls", "positions_ws", "rotations_ws", "rest_rotations_ls", *TRACKS):
            if (array := getattr(self, name)) is not None:
                view = array.view()
                view.flags.writeable = False
                object.__setattr__(self, name, view)

    @property
    def tracks(self) -> dict[str, np.ndarray]:
        """What the clip has beside its motion, one entry a frame, by field."""
        tracks = {name: getattr(self, name) for name in TRACKS}
        return {name: track for name, track in tracks.items() if track is not None}

    @property
    def observed(self) -> Bool[np.ndarray, " frames"]:
        """True where a frame may be trusted: by the mask, or in all."""
        return np.ones(self.frame_count, bool) if self.mask is None else self.mask

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.positions_ws)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last, s."""
        return (self.frame_count - 1) / self.fps

    @cached_property
    def body_height(self) -> float:
        """Median height of the highest joint above the lowest, m."""
        return float(np.median(np.ptp(self.positions_ws[..., 1], axis=1)))

    @cached_property
    def cuts(self) -> tuple[int, ...]:
        """Frames at which the motion starts anew, as after a teleport; see `cuts`."""
        if self.measured_rig is None:
            return ()
        leg = float(np.mean(np.asarray(self.measured_rig.thigh + self.measured_rig.shin)))
        return cuts(self.positions_ws[:, self.measured_rig.pelvis], leg)

    @property
    def pieces(self) -> list[slice]:
        """The frames between cuts."""
        edges = [0, *self.cuts, self.frame_count]
        return [slice(first, end) for first, end in itertools.pairwise(edges)]

    @property
    def rig(self) -> Rig:
        """The legs in JAX's default precision.

        Raises:
            ValueError: no legs were recognised.
        """
        if self.measured_rig is None:
            find_roles(self.joint_names, self.parents)  # its error says what is missing
            raise ValueError(f"{self.source} was loaded without legs; {ADVICE}")
        floats = jax.dtypes.canonicalize_dtype(np.float64)
        if floats not in self._rigs:
            put = partial(jax.tree.map, lambda leaf: jax.device_put(np.asarray(leaf)))
            self._rigs[floats] = put(self.measured_rig)
        return self._rigs[floats]

    @cached_property
    def _rigs(self) -> dict[np.dtype, Rig]:
        """By precision; placing its arrays takes a millisecond, and many ask for it."""
        return {}

    @property
    def skeleton(self) -> Skeleton:
        """All joints with their rest offsets, in JAX's default precision."""
        return Skeleton(jax.device_put(self.offsets_ls), self.joint_names, self.parents)

    def joints_ws(self, role: int) -> Float64[np.ndarray, "frames legs 3"]:
        """Positions of one joint of each leg, m: `role` is 0 hip, 1 knee, 2 ankle, 3 toe."""
        rig = self.measured_rig or self.rig  # which says why there is none
        return self.positions_ws[:, [joints[role] for joints in rig.joints]]

    def stance_labels(self) -> Bool[np.ndarray, "frames legs"]:
        """Whether each foot stands: the stored contact labels, or else detected from its motion."""
        if self.stance is not None:
            return self.stance
        return self.skating.stance

    def stance_probability(self) -> Float64[np.ndarray, "frames legs"]:
        """The probability of each stance that is detected from the motion; 0 in swings."""
        balls_ws, size = self.joints_ws(3), body.ratio(self.rig)
        if self.skating.is_clear:
            balls_ws = balls_ws + self.skating.travel_ws[:, None]
        return contacts.stance_probability(balls_ws, self.skating.stance, self.fps, size)

    @cached_property
    def skating(self) -> Skating:
        """How the standing feet skate, from the motion alone."""
        pelvis_ws = self.positions_ws[:, self.rig.pelvis]
        size = body.ratio(self.rig)
        return skating.measure(self.joints_ws(3), pelvis_ws, self.left_ws(), self.fps, size)

    def observed_stances(self) -> Bool[np.ndarray, "frames legs"]:
        """`stance_labels` without the stances of which no frame was observed."""
        labels = self.stance_labels().copy()
        for stance in labels.T:
            for first, last in contacts.runs(stance):
                stance[first : last + 1] = self.observed[first : last + 1].any()
        return labels

    def fitted_stances(self) -> Bool[np.ndarray, "frames legs"]:
        """`stance_labels` without the stances that the fit leaves out."""
        labels = self.stance_labels()
        return labels if self.left_out is None else labels & ~self.left_out

    def leg_pose_ws(self) -> LegPose:
        """World transforms of the legs' joints, (frames, legs), in JAX's default precision."""
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
        return left_directions(self.positions_ws[:, hips], side, self.rotations_ws[:, rig.pelvis])

    def world_from_model(
        self, floor: float = 0.0, up_ws: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0)
    ) -> Transform:
        """The character's root in each frame: on the floor below the pelvis, facing forward.

        Forward is perpendicular to the character's left and lies in the floor. Where left points
        straight up or down, the heading is interpolated from neighbouring frames.

        Args:
            floor: height of the floor along `up_ws`, m.
            up_ws: the floor's unit normal; for a climber, the wall's.
        """
        upright = _upright(np.asarray(up_ws, np.float64))
        yaw = self._heading(upright)
        pos = self.positions_ws[:, self.rig.pelvis] @ upright.as_matrix().T
        pos = upright.inv().apply(pos * [1.0, 0.0, 1.0] + [0.0, floor, 0.0])
        zero = np.zeros_like(yaw)
        rot = np.stack([np.cos(yaw / 2), zero, np.sin(yaw / 2), zero], axis=-1)
        root = upright.inv() * rotation(rot)
        return Transform(*jax.device_put((pos, root.as_quat(scalar_first=True))))

    def _heading(self, upright: Rotation) -> Float64[np.ndarray, " frames"]:
        """Continuous yaw of the character, rad: 0 faces +z, pi/2 faces +x."""
        flat = upright.apply(self.left_ws())[:, [0, 2]]
        known = np.linalg.norm(flat, axis=-1) > 0.1
        if not known.any():
            return np.zeros(len(flat))
        frames = np.arange(len(flat))
        yaw = np.unwrap(np.arctan2(-flat[known, 1], flat[known, 0]))
        return np.interp(frames, frames[known], yaw)

    def with_motion(self, positions_ws: np.ndarray, rotations_ws: np.ndarray) -> "Clip":
        """The clip with other world transforms of its joints, in as many frames."""
        return replace(self, positions_ws=positions_ws, rotations_ws=continuous(rotations_ws))

    def select(self, frames: np.ndarray | slice) -> "Clip":
        """The clip with only these frames, by index, mask or slice."""
        return replace(
            self,
            positions_ws=self.positions_ws[frames],
            rotations_ws=self.rotations_ws[frames],
            **{name: track[frames] for name, track in self.tracks.items()},
        )


def _upright(up_ws: Float64[np.ndarray, "3"]) -> Rotation:
    """The shortest rotation that takes `up_ws` to +y; a half turn about x if it points down."""
    quat = np.array([-up_ws[2], 0.0, up_ws[0], 1.0 + up_ws[1]])
    return Rotation.from_quat(quat if quat.any() else [1.0, 0.0, 0.0, 0.0])


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
    model: Model | None = None
    """What else is in a glTF file with a skinned mesh; lost where units or axes change."""

    def __post_init__(self) -> None:
        if self.up_axis not in (None, "y", "z"):
            raise ValueError(f"up_axis is {self.up_axis!r}; wanted 'y', 'z' or None")

    def scaled(self, factor: float) -> "Recording":
        """The same motion with every length multiplied by `factor`."""
        with np.errstate(all="ignore"):  # the loader says which joint is too far away
            offsets_ls, positions_ls = self.offsets_ls * factor, self.positions_ls * factor
        model = self.model if factor == 1.0 else None
        return replace(self, offsets_ls=offsets_ls, positions_ls=positions_ls, model=model)

    def rotated(self, matrix: Float64[np.ndarray, "3 3"]) -> "Recording":
        """The same motion in other axes: vectors v become M v, rotations R become M R M⁻¹.

        The joints' own axes change with the world's, so a rest pose without rotations stays one.
        """
        change = Rotation.from_matrix(matrix)

        def turned(rotations: np.ndarray) -> np.ndarray:
            new = change * rotation(rotations) * change.inv()
            return new.as_quat(scalar_first=True).reshape(rotations.shape)

        rest = self.rest_rotations_ls
        return replace(
            self,
            offsets_ls=self.offsets_ls @ matrix.T,
            positions_ls=self.positions_ls @ matrix.T,
            rotations_ls=turned(self.rotations_ls),
            rest_rotations_ls=None if rest is None else turned(rest),
            model=None,
        )


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
        rot = rotation(rotations_ls[:, joint])
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
            parent_from_world = rotation(rotations_ws[:, parent]).inv()
            offset_ws = positions_ws[:, joint] - positions_ws[:, parent]
            positions_ls[:, joint] = parent_from_world.apply(offset_ws)
            rotations_ls[:, joint] = (parent_from_world * rotation(rotations_ws[:, joint])).as_quat(
                scalar_first=True
            )
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
