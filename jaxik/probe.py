"""Stage 1: rays that look for ground under each foot."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from . import quat, vec
from .frame import Frame, Ground
from .rule import parameter, switch
from .skeleton import Rig
from .terrain import Terrain, cast


class AbstractProbe(eqx.Module):
    """Looks for ground."""

    @abstractmethod
    def sense(self, rig: Rig, terrain: Terrain, frame: Frame) -> Ground:
        """What the rays of each leg see in this frame."""


class FootProbe(AbstractProbe):
    """A ray at the ankle and, if wanted, one at the toe (record: useFootEndRay)."""

    ray_up: Array = parameter(0.50, unit="m", low=0.0, high=2.0, kind="threshold")
    ray_down: Array = parameter(0.80, unit="m", low=0.0, high=2.0, kind="threshold")
    toe_ls: Array = parameter((0.0, -0.07, 0.20), unit="m", low=-0.4, high=0.4)
    use_toe: Array = switch(True)

    def sense(self, rig: Rig, terrain: Terrain, frame: Frame) -> Ground:
        reach = self.ray_up + self.ray_down
        above = vec.scale(terrain.up_ws, self.ray_up)
        ankle_ws = frame.world_from_model.apply(frame.pose.ankle.pos)
        toe_ws = frame.world_from_model.apply(toe_point(rig, frame, self.toe_ls))
        toe = cast(terrain, toe_ws + above, reach)
        toe = eqx.tree_at(lambda hit: hit.found, toe, jnp.where(self.use_toe, toe.found, 0.0))
        return Ground(cast(terrain, ankle_ws + above, reach), toe)


def toe_point(rig: Rig, frame: Frame, toe_ls: Array) -> Array:
    """The toe of each leg, m, model space, for a toe given in the foot's axes from the ankle.

    Its sideways component is meant for a left foot and mirrors on a right one (A16).
    """
    x, y, z = vec.components(toe_ls)
    foot = quat.multiply(frame.pose.ankle.rot, rig.ankle_from_foot)
    return frame.pose.ankle.pos + quat.rotate(foot, vec.stack(rig.side * x, y, z))
