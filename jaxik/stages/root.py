"""Stage 2: the height of the whole character."""

from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import parameter_tree, vec
from jaxik.maths.parameter_tree import Leaf, Rule, parameter, switch
from jaxik.world.terrain import cast

from .inputs import Inputs


class AbstractRoot(Rule):
    """Moves the whole character before its legs look for ground."""

    per_leg: ClassVar[bool] = False

    @abstractmethod
    def sense(self, inputs: Inputs) -> Float[Array, ""]:
        """How far the character moves along up in this frame, m."""


class KeepRoot(AbstractRoot):
    """The character stays where the game put it."""

    def sense(self, inputs: Inputs) -> Float[Array, ""]:
        return jnp.zeros_like(inputs.frame.dt)


class GroundRoot(AbstractRoot):
    """Puts the character's origin on the ground below it (ozz's "auto character height").

    Without ground below, or with `enabled` off, the character stays where it is.
    """

    enabled: Leaf = switch(True, doc="Whether the character is placed on the ground.")
    ray_up: Leaf = parameter(
        10.0,
        unit="m",
        low=0.0,
        high=20.0,
        kind="threshold",
        doc="Height above the character's origin at which the ray starts.",
    )
    ray_down: Leaf = parameter(
        float("inf"),
        unit="m",
        low=0.0,
        high=20.0,
        kind="threshold",
        doc="Depth below the character's origin to which the ray looks.",
    )
    layers: Leaf = parameter_tree.layers()

    def sense(self, inputs: Inputs) -> Float[Array, ""]:
        terrain = inputs.terrain
        origin, up = inputs.frame.world_from_model.pos, terrain.up_ws
        above = origin + vec.scale(up, self.ray_up)
        hit = cast(terrain.body, above, self.ray_up + self.ray_down, self.layers)
        height = vec.dot(hit.point - origin, up)
        return jnp.where(self.enabled & (hit.found > 0), height, 0.0)
