"""What is not known of a capture: where its ground is, when it begins, where its joints are.

None of it belongs to a system. Left out of a fit, it pulls the system's parameters to wherever they
make up for it; fitted with a narrow prior, it takes its share, and intervals say what is left.
"""

# pyright: reportInvalidTypeVarUse=false

from typing import ClassVar

import jax
import jax.numpy as jnp

from jaxik.maths.parameter_tree import Declared, Leaf, Rule, parameter

GROUND = ("ground_height", "ground_tilt_x", "ground_tilt_z")
SHIFT = "time_shift"
SPREAD = 0.55  # of u: 95 % of such a prior are within half the reach, 2 standard deviations


def nuisance(default: float, *, unit: str, reach: float, doc: str) -> Declared:
    """Declares a number of a capture, which stays within `reach` of its default.

    The standard deviation of its prior is a quarter of that.
    """
    low, high = default - reach, default + reach
    return parameter(default, unit=unit, low=low, high=high, doc=doc, follows="nothing")


class Capture(Rule):
    """What is not known of a capture: numbers of one clip, or of several, (clips).

    Offsets are those of the captured joint from the one of the system's leg, along the axes of the
    foot; both feet of a character share them.
    """

    per_leg: ClassVar[bool] = False

    ground_height: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="By how much the ground is higher than its file says."
    )
    ground_tilt_x: Leaf = nuisance(
        0.0, unit="rad", reach=0.07, doc="Angle by which the ground rises along the world's x."
    )
    ground_tilt_z: Leaf = nuisance(
        0.0, unit="rad", reach=0.07, doc="Angle by which the ground rises along the world's z."
    )
    time_shift: Leaf = nuisance(
        0.0, unit="s", reach=0.08, doc="How long after the animation the capture shows a motion."
    )
    ankle_forward: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="How far before the ankle the captured one lies."
    )
    ankle_up: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="How far above the ankle the captured one lies."
    )
    ankle_outward: Leaf = nuisance(
        0.0, unit="m", reach=0.08, doc="How far outside the ankle the captured one lies."
    )
    ball_up: Leaf = nuisance(
        0.0,
        unit="m",
        reach=0.08,
        doc="How far above the ball the captured one lies, which pitches the captured foot.",
    )
    ball_outward: Leaf = nuisance(
        0.0,
        unit="m",
        reach=0.08,
        doc="How far outside the ball the captured one lies, which turns the captured foot.",
    )
    scale: Leaf = nuisance(
        1.0, unit="1", reach=0.04, doc="Captured lengths over true ones, about the middle."
    )

    def of_clip(self, number: int) -> "Capture":
        """The numbers of one of several clips."""
        return jax.tree.map(lambda values: values[number], self)

    def for_clips(self, count: int) -> "Capture":
        """The same numbers for each of several clips."""
        return jax.tree.map(lambda value: jnp.full(count, value), self)
