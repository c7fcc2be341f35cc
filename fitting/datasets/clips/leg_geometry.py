"""Geometry of two-bone legs over the frames of a clip: hinges, knees and bone rotations.

All arrays are float64 in world space with frames leading, (frames, 3) unless said otherwise.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

Vectors = Float64[np.ndarray, "frames 3"]

BENT = np.sin(np.radians(3.0))  # sine of the flexion from which thigh and shin span a plane


def unit(v: Float64[np.ndarray, "*b 3"]) -> np.ndarray:
    """`v` scaled to length one; zero stays zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=np.zeros_like(v), where=length > 0)


def reject(v: Vectors, axis: Vectors) -> Vectors:
    """The part of `v` perpendicular to the unit vector `axis`."""
    return v - axis * np.sum(v * axis, axis=-1, keepdims=True)


def knee_hinges(hip: Vectors, knee: Vectors, ankle: Vectors, left_ws: Vectors) -> Vectors:
    """Unit axes about which a positive rotation of the shin flexes the knee.

    They are perpendicular to thigh and shin. A straight leg spans no plane: as the leg straightens,
    the axis fades smoothly to `left_ws`, made perpendicular to the leg.
    """
    thigh, shin, leg = unit(knee - hip), unit(ankle - knee), unit(ankle - hip)
    normal = np.cross(thigh, shin)  # its length is the sine of the flexion; a knee bends forward
    bend = np.clip(np.linalg.norm(normal, axis=-1, keepdims=True) / (3 * BENT), 0.0, 1.0)
    fade = 1.0 - bend**2 * (3.0 - 2.0 * bend)
    return unit(normal + 6 * BENT * fade * unit(reject(left_ws, leg)))


def knee_positions(
    hip: Vectors, ankle: Vectors, pole: Vectors, bones: tuple[float, float]
) -> Vectors:
    """Knees between hips and ankles by the law of cosines, m.

    Args:
        hip: m.
        ankle: m; a leg whose ankle is out of reach is straight.
        pole: unit, perpendicular to the line from hip to ankle; where the knee points.
        bones: length of the thigh and of the shin, m.
    """
    thigh, shin = bones
    distance = np.linalg.norm(ankle - hip, axis=-1, keepdims=True)
    along = unit(ankle - hip)
    forth = (thigh**2 - shin**2 + distance**2) / (2.0 * distance)
    return hip + along * forth + pole * np.sqrt(np.maximum(thigh**2 - forth**2, 0.0))


def bone_rotation(top: Vectors, bottom: Vectors, hinge: Vectors) -> Rotation:
    """Axes of a bone: y from its lower end up to its upper one, x along the hinge, z forward."""
    y = unit(top - bottom)
    x = unit(reject(hinge, y))
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def leg_rotations(
    hip: Vectors, knee: Vectors, ankle: Vectors, left_ws: Vectors
) -> list[Float64[np.ndarray, "frames 4"]]:
    """World rotations, wxyz, of thigh and shin known only by their end points.

    Axes as in `bone_rotation`, so a positive rotation about x flexes the knee.
    """
    hinge = knee_hinges(hip, knee, ankle, left_ws)
    bones = ((hip, knee), (knee, ankle))
    return [bone_rotation(*bone, hinge).as_quat(scalar_first=True) for bone in bones]
