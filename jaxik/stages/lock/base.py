"""What lock rules share: how they change footholds, and the rule that has no lock."""

from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths.parameter_tree import Rule
from jaxik.maths.struct import struct
from jaxik.stages.inputs import SensedMoment
from jaxik.world.skeleton import Rig

LEAST = 0.01  # weight of a leg, up to which its foot is not locked


@struct
class Hold:
    """How locks change the footholds."""

    offset_ws: Float[Array, "legs 3"]
    """m, from the foothold."""
    rot_ws: Float[Array, "legs 4"]
    """Of the ankles."""
    locked: Float[Array, " legs"]
    """1 where the foot keeps its place."""


class AbstractLock(Rule):
    """Keeps standing feet in place."""

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: PyTree
    ) -> tuple[PyTree, Hold]:
        """Memory after this frame, and how locks change the footholds.

        Args:
            now: the sensed frame.
            foothold_ws: where each foot would stand without a lock, m.
            hip_ws: the hips on the body as last placed, m.
            state: memory after the frame before.
        """


class NoLock(AbstractLock):
    """No locks: feet follow their footholds."""

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: None
    ) -> tuple[None, Hold]:
        free = jnp.zeros_like(foothold_ws)
        sensed = now.sensed
        return None, Hold(free, sensed.rot_ws, jnp.zeros_like(sensed.foothold.found))
