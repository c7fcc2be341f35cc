"""Flat base animations: what a game would play on flat ground, made from a clip on uneven ground.

The captured feet with the ground taken out: through each stance a foot is lowered by the height of
the ground under it, between two stances by a quintic smoothstep from one height to the next. The
pelvis keeps its way over the ground plan at a constant height, and knees are rebuilt by the cosine
law in the plane in which the captured leg bends.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from fitting.runtime.validation import error_context

from .clips import contacts, load_clip
from .clips.clip import Clip
from .clips.formats.npz import is_blocks_file
from .clips.recording import local_from_world, place
from .clips.rigs import hinges, unit

STRETCH = 1e-4  # m, change of a bone's length that counts as stretching
LONGEST = 0.9995  # share of a leg's length that it may be stretched to


def flatten_clip(
    clip: Clip,
    height_under: Callable[[np.ndarray], np.ndarray],
    *,
    pelvis_height: float | None = None,
) -> Clip:
    """The clip over a flat floor at y = 0.

    Feet keep their orientation and their way over the ground plan; where the pelvis is too high for
    a leg, its foot is drawn along the line to its hip until the leg reaches, and bones keep their
    lengths always. Hips and the body above them move with the pelvis as captured.

    Args:
        clip: captured motion over the terrain; its contact labels, or if it has none those found
            from its motion, say when a foot stands.
        height_under: ground height, m, (points,), under points (points, 3), m.
        pelvis_height: m; None keeps its mean height over the ground under the standing feet.

    Errors: ValueError when a foot never stands or the ground is not finite under a stance.
    """
    rig = clip.rig
    stance = clip.stance_labels()
    ground = ground_under(clip, stance, height_under)
    pelvis = clip.positions_ws[:, rig.pelvis]
    if pelvis_height is None:
        stands = stance.any(axis=1)
        under = (ground * stance).sum(axis=1)[stands] / stance.sum(axis=1)[stands]
        pelvis_height = float(np.mean(pelvis[stands, 1] - under))
    lift = (pelvis_height - pelvis[:, 1])[:, None, None] * [0.0, 1.0, 0.0]
    positions_ws, rotations_ws = clip.positions_ws + lift, clip.rotations_ws.copy()
    for leg, joints in enumerate(rig.joints):
        lengths = float(rig.thigh[leg]), float(rig.shin[leg])
        _rebuild(clip, joints, lengths, ground[:, leg], positions_ws, rotations_ws)
    positions_ws, rotations_ws = _hang_children(clip, positions_ws, rotations_ws)
    return replace(clip.with_motion(positions_ws, rotations_ws), stance=stance)


def with_rigid_legs(clip: Clip) -> Clip:
    """The clip with thighs and shins of the rig's lengths in every frame.

    Where an animation stretches a leg its foot is drawn along the line to its hip until the leg
    reaches; a clip whose bones already keep their lengths is returned as it is.
    """
    rig = clip.rig
    hip, knee, ankle = (clip.joints_ws(role) for role in range(3))
    errors = [
        np.abs(np.linalg.norm(a - b, axis=-1) - np.asarray(length)).max()
        for a, b, length in ((hip, knee, rig.thigh), (knee, ankle, rig.shin))
    ]
    if max(errors) < STRETCH:
        return clip
    positions_ws, rotations_ws = clip.positions_ws.copy(), clip.rotations_ws.copy()
    for leg, joints in enumerate(rig.joints):
        lengths = float(rig.thigh[leg]), float(rig.shin[leg])
        _rebuild(clip, joints, lengths, np.zeros(clip.frame_count), positions_ws, rotations_ws)
    return clip.with_motion(*_hang_children(clip, positions_ws, rotations_ws))


def load_flat_animation(path: Path) -> Clip:
    """The animation in a file as foot IK takes it: a blocks file's base, with rigid legs."""
    clip = load_clip(path, variant="base" if is_blocks_file(path) else "captured")
    with error_context(path):
        return with_rigid_legs(clip)


def ground_under(
    clip: Clip, stance: np.ndarray, height_under: Callable[[np.ndarray], np.ndarray]
) -> Float64[np.ndarray, "frames legs"]:
    """Height, m, of the ground that each foot comes from or goes to.

    In a stance the height under the median place of its ball; before the first stance and after the
    last theirs.
    """
    balls = clip.joints_ws(3)
    ground = np.empty(stance.shape)
    for leg, name in enumerate(clip.rig.names):
        if not stance[:, leg].any():
            raise ValueError(f"{clip.source}: the {name} foot never stands, so no ground is known")
        falls = contacts.footfalls(balls[:, leg], stance[:, leg])
        places = falls.places_ws
        heights = np.asarray(height_under(places), np.float64)
        if heights.shape != (len(places),) or not np.isfinite(heights).all():
            raise ValueError(
                f"{clip.source}: wanted {len(places)} finite ground heights under the stances of "
                f"the {name} foot, got {heights}"
            )
        low, high, share = heights[falls.last], heights[falls.next], falls.share
        ground[:, leg] = low + (high - low) * share**3 * (10 - 15 * share + 6 * share**2)
    return ground


def _rebuild(
    clip: Clip,
    joints: tuple[int, int, int, int],
    lengths: tuple[float, float],
    ground: np.ndarray,
    positions_ws: np.ndarray,
    rotations_ws: np.ndarray,
) -> None:
    """Places one leg's joints in the arrays and turns its thigh and shin after them."""
    captured = [clip.positions_ws[:, joint] for joint in joints]
    hip = positions_ws[:, joints[0]]
    drop = ground[:, None] * [0.0, 1.0, 0.0]
    ankle = captured[2] - drop
    farthest = LONGEST * sum(lengths)
    distance = np.linalg.norm(ankle - hip, axis=-1, keepdims=True)
    ankle = hip + (ankle - hip) * np.minimum(1.0, farthest / distance)
    knee = bent_knee(hip, ankle, lengths, captured, clip.left_ws())
    new = [hip, knee, ankle, captured[3] + ankle - captured[2]]
    for joint, pos in zip(joints, new, strict=True):
        positions_ws[:, joint] = pos
    for bone in (0, 1):
        turn = _frame(new, bone, clip) * _frame(captured, bone, clip).inv()
        old = Rotation.from_quat(clip.rotations_ws[:, joints[bone]], scalar_first=True)
        rotations_ws[:, joints[bone]] = (turn * old).as_quat(scalar_first=True)


def bent_knee(
    hip: np.ndarray,
    ankle: np.ndarray,
    lengths: tuple[float, float],
    captured: list[np.ndarray],
    left_ws: np.ndarray,
) -> Float64[np.ndarray, "frames 3"]:
    """The knee between `hip` and `ankle` by the cosine law.

    It bends to where the captured one does, after the shortest turn that takes the captured line
    from hip to ankle onto the new one.

    Args:
        hip, ankle: world space, m, near enough for the lengths.
        lengths: thigh and shin, m.
        captured: hip, knee and ankle (and more) of the captured leg, world space, m.
        left_ws: unit; which way a straight leg's hinge points.
    """
    thigh, shin = lengths
    hinge = hinges(captured[0], captured[1], captured[2], left_ws)
    before, along = unit(captured[2] - captured[0]), unit(ankle - hip)
    pole = unit(np.cross(before, hinge))
    axis = np.cross(before, along)  # Rodrigues' formula with the sine as the axis' length
    cos = np.sum(before * along, axis=-1, keepdims=True)
    pole = (
        pole * cos
        + np.cross(axis, pole)
        + axis * (np.sum(axis * pole, axis=-1, keepdims=True) / (1.0 + cos))
    )
    distance = np.linalg.norm(ankle - hip, axis=-1, keepdims=True)
    forth = (thigh**2 - shin**2 + distance**2) / (2.0 * distance)
    return hip + along * forth + pole * np.sqrt(np.maximum(thigh**2 - forth**2, 0.0))


def _frame(leg: list[np.ndarray], bone: int, clip: Clip) -> Rotation:
    """Axes of a thigh (0) or shin (1): along the bone, across it along the hinge, and both."""
    hinge = hinges(leg[0], leg[1], leg[2], clip.left_ws())
    along = unit(leg[bone] - leg[bone + 1])
    across = unit(hinge - along * np.sum(hinge * along, axis=-1, keepdims=True))
    return Rotation.from_matrix(np.stack([across, along, np.cross(across, along)], axis=-1))


def _hang_children(
    clip: Clip, positions_ws: np.ndarray, rotations_ws: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Joints on the legs but not of them (end sites, helpers) as they hung on their parents."""
    own = {joint for leg in clip.rig.joints for joint in leg}
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    kept_pos, kept_rot = local_from_world(clip.parents, positions_ws, rotations_ws)
    below: set[int] = set()
    for joint, parent in enumerate(clip.parents):
        if joint not in own and (parent in own or parent in below):
            below.add(joint)
            kept_pos[:, joint], kept_rot[:, joint] = positions_ls[:, joint], rotations_ls[:, joint]
    return place(clip.parents, kept_pos, kept_rot)
