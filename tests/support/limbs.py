"""Draws of limbs, bent at any angle and in any attitude."""

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from .gradients import numbers, quaternions

X, Y, Z = np.eye(3)


@st.composite
def limbs(
    draw: st.DrawFn, knee_angles: st.SearchStrategy[float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """To hip and to ankle, m, and the unit hinge, with an interior angle from `knee_angles`, rad.

    A negative angle is a limb bent backwards.
    """
    thigh, shin, angle = draw(numbers(0.2, 0.6)), draw(numbers(0.2, 0.6)), draw(knee_angles)
    attitude = Rotation.from_quat(draw(quaternions()), scalar_first=True)
    to_ankle = shin * (np.cos(angle) * X + np.sin(angle) * Y)
    return attitude.apply(thigh * X), attitude.apply(to_ankle), attitude.apply(Z)
