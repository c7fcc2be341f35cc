"""What a leg is, measured from the motion of its joints."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from jaxik.world.skeleton import Rig

from .joint_roles import Leg, Roles

UP = np.array([0.0, 1.0, 0.0])
SWING = np.radians(3.0)  # a knee that turns less, root mean square, tells no axis
BENT = np.sin(np.radians(3.0))  # sine of the flexion above which a leg's plane tells the axis
FLAT_SHARE = 0.25  # share of the stance frames, those of the slowest ankle, in which a foot is flat


def lateral(
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
    pelvis: int,
    hips: list[int],
    side: Float64[np.ndarray, " legs"],
) -> Float64[np.ndarray, "frames 3"]:
    """Unit vectors to the character's left, world space.

    From the right hips to the left ones; with legs of one side only, the pelvis' own x axis.
    """
    at = positions_ws[:, hips]
    if (side > 0).any() and (side < 0).any():
        return unit(at[:, side > 0].mean(axis=1) - at[:, side < 0].mean(axis=1))
    return Rotation.from_quat(rotations_ws[:, pelvis], scalar_first=True).apply([1.0, 0.0, 0.0])


def measure_rig(
    roles: Roles,
    positions_ws: Float64[np.ndarray, "frames joints 3"],
    rotations_ws: Float64[np.ndarray, "frames joints 4"],
    stance: Bool[np.ndarray, "frames legs"],
) -> Rig:
    """The rig of a clip, in float64 whatever JAX's default is.

    Bone lengths are medians over the frames. The knee axis is the main axis of the knee's turns;
    where it hardly turns, it stands at right angles to thigh and shin. Foot axes are those of a
    flat foot: up is the world's, forward goes from ankle to ball in the frames in which both stand.
    """
    hips = [leg.joints[0] for leg in roles.legs]
    side = np.array([leg.side for leg in roles.legs])
    left_ws = lateral(positions_ws, rotations_ws, roles.pelvis, hips, side)
    legs = [
        _measure_leg(leg, left_ws, positions_ws, rotations_ws, stance[:, index])
        for index, leg in enumerate(roles.legs)
    ]
    axes, feet, lengths = (np.stack(part) for part in zip(*legs, strict=True))
    with jax.enable_x64(True):
        return Rig(
            knee_axis_ls=jnp.asarray(axes),
            ankle_from_foot=jnp.asarray(feet),
            thigh=jnp.asarray(lengths[:, 0]),
            shin=jnp.asarray(lengths[:, 1]),
            foot=jnp.asarray(lengths[:, 2]),
            side=jnp.asarray(side),
            present=jnp.ones(len(legs), bool),
            names=tuple(leg.name for leg in roles.legs),
            joints=tuple(leg.joints for leg in roles.legs),
            pelvis=roles.pelvis,
        )


def _measure_leg(
    leg: Leg,
    left_ws: np.ndarray,
    positions_ws: np.ndarray,
    rotations_ws: np.ndarray,
    stands: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    hip, knee, ankle, toe = (positions_ws[:, joint] for joint in leg.joints)
    hip_rot, knee_rot = (
        Rotation.from_quat(rotations_ws[:, joint], scalar_first=True) for joint in leg.joints[:2]
    )
    lengths = [np.median(np.linalg.norm(b - a, axis=-1)) for a, b in
               ((hip, knee), (knee, ankle), (ankle, toe))]  # fmt: skip
    axis = knee_axis(hip, knee, ankle, hip_rot, knee_rot, left_ws)
    still = flat_frames(ankle, toe, stands)
    ankle_rot = Rotation.from_quat(rotations_ws[still, leg.joints[2]], scalar_first=True)
    return (
        axis,
        foot_axes(ankle[still], toe[still], ankle_rot, left_ws[still]),
        np.array(lengths),
    )


def knee_axis(
    hip: np.ndarray,
    knee: np.ndarray,
    ankle: np.ndarray,
    hip_rot: Rotation,
    knee_rot: Rotation,
    left_ws: np.ndarray,
) -> Float64[np.ndarray, "3"]:
    """Unit axis in knee space about which a positive turn opens the knee."""
    normals_ws = hinges(hip, knee, ankle, left_ws)
    flexed_ls = np.mean(knee_rot.inv().apply(normals_ws), axis=0)  # a turn about it flexes
    local = hip_rot.inv() * knee_rot
    turns = (local.mean().inv() * local).as_rotvec()
    if np.sqrt(np.mean(np.sum(turns**2, axis=-1))) < SWING:
        return -flexed_ls / np.linalg.norm(flexed_ls)
    axis = np.linalg.svd(turns, full_matrices=False)[2][0]
    return -axis if axis @ flexed_ls > 0 else axis


def hinges(
    hip: Float64[np.ndarray, "frames 3"],
    knee: Float64[np.ndarray, "frames 3"],
    ankle: Float64[np.ndarray, "frames 3"],
    left_ws: Float64[np.ndarray, "frames 3"],
) -> Float64[np.ndarray, "frames 3"]:
    """Unit axes about which a turn of the shin flexes the knee, world space.

    At right angles to thigh and shin; as the leg straightens and loses its plane, it turns
    smoothly to `left_ws`, at right angles to the leg.
    """
    thigh, shin, leg = unit(knee - hip), unit(ankle - knee), unit(ankle - hip)
    normal = np.cross(thigh, shin)  # as long as the sine of the flexion; a knee bends forward
    share = np.clip(np.linalg.norm(normal, axis=-1, keepdims=True) / (3 * BENT), 0.0, 1.0)
    fade = 1.0 - share**2 * (3.0 - 2.0 * share)
    side = unit(left_ws - leg * np.sum(left_ws * leg, axis=-1, keepdims=True))
    return unit(normal + 6 * BENT * fade * side)


def flat_frames(
    ankle: np.ndarray, toe: np.ndarray, stands: Bool[np.ndarray, " frames"]
) -> Bool[np.ndarray, " frames"]:
    """The frames in which a foot lies flat: it stands and its ankle is slowest.

    Without a stance, those in which the ball is lowest.
    """
    if not stands.any():
        return toe[:, 1] <= np.quantile(toe[:, 1], FLAT_SHARE)
    moved = np.linalg.norm(np.gradient(ankle, axis=0), axis=-1) if len(ankle) > 1 else np.zeros(1)
    return stands & (moved <= np.quantile(moved[stands], FLAT_SHARE))


def foot_axes(
    ankle: np.ndarray, toe: np.ndarray, ankle_rot: Rotation, left_ws: np.ndarray
) -> Float64[np.ndarray, "4"]:
    """`ankle_from_foot`, wxyz: x left, y up, z forward of a flat foot, the mean over the frames.

    A foot without length points where the pelvis does.
    """
    along = toe - ankle
    long = np.linalg.norm(along[:, [0, 2]], axis=-1, keepdims=True) > 1e-3
    forward = unit(np.where(long, along, np.cross(left_ws, UP)) * [1.0, 0.0, 1.0])
    up = np.broadcast_to(UP, forward.shape)
    axes = np.stack([np.cross(up, forward), up, forward], axis=-1)
    mean = (ankle_rot.inv() * Rotation.from_matrix(axes)).mean()
    return mean.as_quat(canonical=True, scalar_first=True)


def unit(v: Float64[np.ndarray, "*b 3"]) -> np.ndarray:
    """`v` at length one; zero stays zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 0)
