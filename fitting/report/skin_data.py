"""Skinned meshes as the page's scripts read them, and the rotations of the joints that they follow.

Places of vertices have 16 bits of the mesh's size, weights 8, and the parts of a quaternion 16.
"""

import base64
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from fitting.clips import Clip
from fitting.clips.formats import gltf_model
from fitting.clips.formats.gltf_model import Surface

STEPS = 65_535  # of a coordinate
FULL = 255  # weight of a joint that a vertex follows alone
LARGEST = 32_767  # of a part of a quaternion


class Skin(NamedTuple):
    """The mesh of a character, packed, and the joints whose rotations it needs."""

    content: dict[str, Any]
    joints: tuple[int, ...]
    """By index, parents first."""
    size: int
    """Bytes before base64."""


def pack(clip: Clip) -> Skin | None:
    """The mesh of a clip's character; None for one without."""
    surface = gltf_model.surface(clip)
    if surface is None or not len(surface.triangles):
        return None
    joints = tuple(sorted(set(surface.joints)))
    low = surface.vertices.min(axis=0)
    step = np.maximum(np.ptp(surface.vertices, axis=0), 1e-9) / STEPS
    arrays = {
        "vertices": np.round((surface.vertices - low) / step).astype("<u2"),
        "triangles": surface.triangles.astype("<u2" if len(surface.vertices) <= STEPS else "<u4"),
        "followed": surface.followed.astype("<u2"),
        "weights": _weights(surface),
        "binds": surface.binds.astype("<f4"),
    }
    content = {name: _base64(array) for name, array in arrays.items()}
    content |= {
        "low": low.tolist(),
        "step": step.tolist(),
        "slots": [joints.index(joint) for joint in surface.joints],
        "joints": joints,
        "above": [_above(clip, joints, joint) for joint in joints],
        "towards": [_next(clip, joint) for joint in joints],
    }
    return Skin(content, joints, sum(array.nbytes for array in arrays.values()))


def pack_rotations(rotations_ws: Float64[np.ndarray, "frames joints 4"]) -> str:
    """Quaternions of a skin's joints, wxyz, in base64."""
    return _base64(rounded_rotations(rotations_ws))


def rounded_rotations(rotations_ws: Float64[np.ndarray, "frames joints 4"]) -> np.ndarray:
    """Quaternions of a skin's joints, wxyz, as integers of 16 bits."""
    return np.round(rotations_ws * LARGEST).astype("<i2")


def _weights(surface: Surface) -> np.ndarray:
    """In steps whose sum is `FULL`: what rounding takes, the largest gets."""
    steps = np.floor(surface.weights * FULL).astype(int)
    rows, largest = np.arange(len(steps)), steps.argmax(axis=1)
    steps[rows, largest] += FULL - steps.sum(axis=1)
    return steps.astype("u1")


def _above(clip: Clip, joints: tuple[int, ...], joint: int) -> int:
    """Where among the joints the nearest one above is; -1 if there is none."""
    parent = clip.parents[joint]
    while parent >= 0 and parent not in joints:
        parent = clip.parents[parent]
    return joints.index(parent) if parent >= 0 else -1


def _next(clip: Clip, joint: int) -> int:
    """The first joint below one that is not in the same place; -1 at an end."""
    for child, parent in enumerate(clip.parents):
        if parent == joint and np.linalg.norm(clip.offsets_ls[child]) > 1e-3:
            return child
    return -1


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
