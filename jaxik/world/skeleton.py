"""Transforms, joint trees with forward kinematics, rigs and leg poses."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxik.maths import quat, vec
from jaxik.maths.struct import struct


@struct
class Transform:
    """A rigid transform. Named `a_from_b`, it maps points of space b to space a."""

    pos: Float[Array, "*b 3"]
    """Metres."""
    rot: Float[Array, "*b 4"]
    """Unit quaternions, wxyz."""

    @classmethod
    def identity(cls, dtype=None) -> "Transform":
        """The transform that moves nothing."""
        return cls(jnp.zeros(3, dtype), quat.identity(dtype))

    @classmethod
    def none(cls, like: Float[Array, "*b"]) -> "Transform":
        """No transforms: a last batch axis of length 0 after those of `like`, with its dtype."""
        return cls(*(jnp.zeros((*like.shape, 0, size), like.dtype) for size in (3, 4)))

    def apply(self, points: Float[Array, "*p 3"]) -> Float[Array, "*c 3"]:
        """Points of space b, m, in space a."""
        return vec.add(self.pos, quat.rotate(self.rot, points))

    def apply_rot(self, rot: Float[Array, "*p 4"]) -> Float[Array, "*c 4"]:
        """Rotations of space b in space a."""
        return quat.multiply(self.rot, rot)

    def turn(self, vectors: Float[Array, "*p 3"]) -> Float[Array, "*c 3"]:
        """Directions and distances of space b in space a: turned, not moved."""
        return quat.rotate(self.rot, vectors)

    def turn_rot(self, rot: Float[Array, "*p 4"]) -> Float[Array, "*c 4"]:
        """Rotations about axes of space b as rotations about the same axes in space a."""
        return quat.multiply(self.rot, quat.multiply(rot, quat.conjugate(self.rot)))

    def inverse(self) -> "Transform":
        """`b_from_a`."""
        back = quat.conjugate(self.rot)
        return Transform(-quat.rotate(back, self.pos), back)

    def repeat(self, count: int) -> "Transform":
        """`count` copies on a new last batch axis, such as the legs.

        With broadcasting instead, reverse mode would sum over the legs at each use.
        """
        return Transform(vec.repeat(self.pos, count), vec.repeat(self.rot, count))

    def __matmul__(self, other: "Transform") -> "Transform":
        """`a_from_b @ b_from_c` is `a_from_c`."""
        return Transform(self.apply(other.pos), self.apply_rot(other.rot))


@struct
class Still:
    """The transform that moves nothing. It has no numbers, so that it costs nothing either."""

    def apply(self, points: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
        """The same points."""
        return points

    def apply_rot(self, rot: Float[Array, "*p 4"]) -> Float[Array, "*p 4"]:
        """The same rotations."""
        return rot

    def turn(self, vectors: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
        """The same directions and distances."""
        return vectors

    def turn_rot(self, rot: Float[Array, "*p 4"]) -> Float[Array, "*p 4"]:
        """The same rotations."""
        return rot


class Skeleton(eqx.Module):
    """A tree of joints, parents before children."""

    offsets: Float[Array, "joints 3"]
    """m, in the parent's space."""
    names: tuple[str, ...] = eqx.field(static=True)
    parents: tuple[int, ...] = eqx.field(static=True)
    """-1 at a root."""

    def __check_init__(self) -> None:
        if not len(self.names) == len(self.parents) == self.offsets.shape[0]:
            raise ValueError(
                "a skeleton has one name, one parent and one offset per joint; got "
                f"{len(self.names)} names, {len(self.parents)} parents, "
                f"{self.offsets.shape[0]} offsets"
            )
        for joint, parent in enumerate(self.parents):
            if not -1 <= parent < joint:
                raise ValueError(
                    f"parents come before children; joint {joint} ({self.names[joint]}) has parent "
                    f"{parent}"
                )


def forward_kinematics(
    skeleton: Skeleton,
    rotations_ls: Float[Array, "*b joints 4"],
    positions_ls: Float[Array, "*b joints 3"] | None = None,
) -> Transform:
    """World transforms of all joints, `*b joints`.

    Args:
        skeleton: the joint tree.
        rotations_ls: rotation of each joint in its parent's space.
        positions_ls: position of each joint in its parent's space, m; None takes the skeleton's
            offsets. Needed where a joint translates, as the root does.
    """
    if positions_ls is None:
        positions_ls = jnp.broadcast_to(skeleton.offsets, (*rotations_ls.shape[:-1], 3))
    world: list[Transform] = []
    for joint, parent in enumerate(skeleton.parents):
        local = Transform(positions_ls[..., joint, :], rotations_ls[..., joint, :])
        world.append(local if parent < 0 else world[parent] @ local)
    return Transform(
        jnp.stack([joint.pos for joint in world], axis=-2),
        jnp.stack([joint.rot for joint in world], axis=-2),
    )


@struct
class LegPose:
    """The four joints of each leg; `toe` is the ball of the foot."""

    hip: Transform
    """Legs, model space."""
    knee: Transform
    ankle: Transform
    toe: Transform

    def transformed(self, by: Transform) -> "LegPose":
        """The whole pose, moved rigidly."""
        return LegPose(by @ self.hip, by @ self.knee, by @ self.ankle, by @ self.toe)


@struct
class Rig:
    """What a leg is, apart from its pose. The legs of one character may all differ."""

    knee_axis_ls: Float[Array, "*b legs 3"]
    """Unit, knee space; positive rotation opens the knee."""
    ankle_from_foot: Float[Array, "*b legs 4"]
    """Foot axes (x left, y up, z forward) in ankle space."""
    thigh: Float[Array, "*b legs"]
    """m, hip to knee."""
    shin: Float[Array, "*b legs"]
    """m, knee to ankle."""
    foot: Float[Array, "*b legs"]
    """m, ankle to ball."""
    ankle_height: Float[Array, "*b legs"]
    """m, of the ankle above the sole while the foot stands flat."""
    ball_height: Float[Array, "*b legs"]
    """m, of the ball above the sole, likewise."""
    side: Float[Array, "*b legs"]
    """+1 left, -1 right, 0 in the middle."""
    present: Bool[Array, "*b legs"]
    """False for legs that only pad a batch of mixed leg counts."""
    names: tuple[str, ...] = eqx.field(static=True)
    """One per leg."""
    joints: tuple[tuple[int, int, int, int], ...] = eqx.field(static=True)
    """Hip knee ankle toe."""
    pelvis: int = eqx.field(static=True)
    """Joint index."""

    @classmethod
    def from_pose(cls, pose: LegPose) -> "Rig":
        """The legs of a body that stands on y = 0, faces +z, and bends its knees forward.

        Soles are flat and feet point from ankle to toe. Knees may be straight.

        Args:
            pose: of that body (legs), model space, of NumPy or JAX arrays.
        """
        pose = jax.tree.map(jnp.asarray, pose)
        legs, floats = len(pose.hip.pos), pose.hip.pos.dtype
        opens = jnp.broadcast_to(jnp.asarray((-1.0, 0.0, 0.0), floats), (legs, 3))
        thigh, shin = bone_lengths(pose)
        foot = pose.toe.pos - pose.ankle.pos
        half_yaw = 0.5 * jnp.arctan2(foot[:, 0], foot[:, 2])
        zero = jnp.zeros_like(half_yaw)
        model_from_foot = vec.stack(jnp.cos(half_yaw), zero, jnp.sin(half_yaw), zero)
        x = pose.hip.pos[:, 0]
        return cls(
            knee_axis_ls=quat.unrotate(pose.knee.rot, opens),
            ankle_from_foot=quat.multiply(quat.conjugate(pose.ankle.rot), model_from_foot),
            thigh=thigh,
            shin=shin,
            foot=vec.length(foot),
            ankle_height=pose.ankle.pos[:, 1],
            ball_height=pose.toe.pos[:, 1],
            side=jnp.where(jnp.abs(x) > 0.01 * thigh, jnp.sign(x), 0.0),
            present=jnp.ones(legs, bool),
            names=tuple(f"leg {leg}" for leg in range(legs)),
            joints=tuple((4 * leg, 4 * leg + 1, 4 * leg + 2, 4 * leg + 3) for leg in range(legs)),
            pelvis=4 * legs,
        )


def bone_lengths(pose: LegPose) -> tuple[Array, Array]:
    """Thigh and shin lengths of a pose, m, each of shape `legs`."""
    return (vec.length(pose.knee.pos - pose.hip.pos), vec.length(pose.ankle.pos - pose.knee.pos))


def mean_position(positions: Float[Array, "legs 3"], present: Bool[Array, " legs"]) -> Array:
    """Mean of a position, m, of each leg that is there; 0 if none is."""
    weight = present.astype(positions.dtype)
    return vec.sum_vectors(vec.scale(positions, weight / jnp.maximum(vec.sum_last(weight), 1.0)))
