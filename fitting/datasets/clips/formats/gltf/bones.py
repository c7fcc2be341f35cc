"""A mesh that looks like the bones of a skeleton, since some programs take no skeleton without one.

Unreal Engine, among others, makes a skeleton only of a mesh that hangs on it. Each bone is an
octahedron from a joint to its child, as wide as in Blender, and moves with the joint.
"""

import numpy as np
from jaxtyping import Float64, Int64

from fitting.datasets.clips.leg_geometry import unit

THICKEST, WIDTH = 0.15, 0.08  # of a bone's length: from its joint, and across to each side
SHORTEST = 1e-6  # m; a shorter bone has no direction
LONELY = np.array([0.0, 0.1, 0.0])  # m, of the bone of a skeleton that has none
# Corners: the joint, four around the bone, the child. Counterclockwise from outside.
RING = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
FACES = np.array(
    [[0, 1 + (k + 1) % 4, 1 + k] for k in range(4)]
    + [[5, 1 + k, 1 + (k + 1) % 4] for k in range(4)]
)


def bone_mesh(
    joints_ms: Float64[np.ndarray, "joints 3"], parents: tuple[int, ...]
) -> tuple[
    Float64[np.ndarray, "vertices 3"], Int64[np.ndarray, "faces 3"], Int64[np.ndarray, " vertices"]
]:
    """Vertices, m, faces, counterclockwise from outside, and the joint that each vertex follows.

    Args:
        joints_ms: places of the joints in the rest pose, m.
        parents: index of each joint's parent, -1 at the root.
    """
    ends = [(parent, joints_ms[joint]) for joint, parent in enumerate(parents) if parent >= 0]
    bones = [(parent, end - joints_ms[parent]) for parent, end in ends]
    bones = [(parent, bone) for parent, bone in bones if np.linalg.norm(bone) > SHORTEST]
    bones = bones or [(0, LONELY)]
    vertices = [joints_ms[parent] + _octahedron(bone) for parent, bone in bones]
    faces = [FACES + number * len(RING) + 2 * number for number in range(len(bones))]
    owners = np.repeat([parent for parent, _ in bones], len(RING) + 2)
    return np.concatenate(vertices), np.concatenate(faces), owners


def _octahedron(bone: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "corners 3"]:
    """The corners of a bone that begins at the origin."""
    across = unit(np.cross(bone, np.eye(3)[np.argmin(np.abs(bone))]))
    both = np.stack([across, np.cross(unit(bone), across)])
    ring = THICKEST * bone + WIDTH * np.linalg.norm(bone) * RING @ both
    return np.concatenate([[0.0 * bone], ring, [bone]])
