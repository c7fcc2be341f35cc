"""A probe that sweeps a capsule along the foot: no crack narrower than the foot swallows it."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import parameter_tree, vec
from jaxik.maths.parameter_tree import Leaf, length, threshold
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import Contact, GroundHits, animated_ankles
from jaxik.world.sweep import sweep, sweepable
from jaxik.world.terrain import Hit, LegTerrains, Terrain, cast

from .base import Ground, foot_heading, make_rays, no_hit
from .limits import AbstractLimitedProbe

STEEPEST = 0.5  # cosine between up and the steepest plane that is continued to below the ankle
MARGIN = 0.3  # m, radius and half the length of the largest capsule


class SweepProbe(AbstractLimitedProbe):
    """A level capsule along each animated foot, from heel to toe, that comes down until it rests.

    The ground under the ankle is on the plane through the contact that faces the capsule, but not
    above its underside nor below what a ray at the ankle hits. On slopes it is the slope itself.
    Over gaps narrower than the capsule it is nearly level, and past an edge it goes down as the
    capsule rolls over it, where a ray would drop. The terrain needs
    `jaxik.world.sweep.sweepable`, which experiments and commands see to (`prepare`).
    """

    ray_up: Leaf = threshold(
        0.5, 0, 2, "Height above the ankle at which the underside of the capsule starts.", unit="m"
    )
    ray_down: Leaf = threshold(
        0.8, 0, 2, "Depth below the ankle to which the capsule comes down.", unit="m"
    )
    radius: Leaf = length(0.04, 0.01, 0.1, "Radius of the capsule.")
    toe_length: Leaf = length(0.15, 0, 0.25, "Distance forward from the ankle to its front end.")
    heel_length: Leaf = length(0.03, 0, 0.15, "Distance backward from the ankle to its back end.")
    layers: Leaf = parameter_tree.layers()

    def prepare(self, terrain: Ground) -> Ground:
        if isinstance(terrain, Terrain):
            return sweepable(terrain, MARGIN)
        legs = tuple(sweepable(ground, MARGIN) for ground in terrain.legs)
        return LegTerrains(terrain.body, legs)

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        up, ankle_ws = inputs.terrain.leg_up_ws, animated_ankles(inputs.frame).pos
        start = ankle_ws + vec.scale(up, self.ray_up)
        hit = self.cast(inputs, start, self.ray_up + self.ray_down, self.layers)
        rays = make_rays(hit, self.ray_up, self.ray_down, self.layers)
        return GroundHits(hit, no_hit(hit), no_hit(hit), jnp.zeros_like(hit.found), rays)

    def find(self, inputs: Inputs, starts_ws: Array, reach: Array, layers: Array) -> Hit:
        up = inputs.terrain.leg_up_ws
        ahead = foot_heading(inputs, up)[0]
        half = vec.scale(ahead, 0.5 * (self.toe_length + self.heel_length))
        middle = vec.scale(ahead, 0.5 * (self.toe_length - self.heel_length))
        centre = starts_ws + middle + vec.scale(up, self.radius)
        rest = sweep(inputs.terrain, centre, self.radius, reach, layers, half)
        ray = cast(inputs.terrain, starts_ws, reach, layers)
        away = starts_ws - rest.point
        facing = vec.dot(rest.normal, up)
        facing = jnp.where(facing > STEEPEST, facing, STEEPEST)
        drop = vec.dot(away, up) + vec.dot(vec.reject(away, up), rest.normal) / facing
        drop = jnp.where(drop < rest.distance, rest.distance, drop)  # not above its underside
        first = (rest.found > 0) & ((ray.found <= 0) | (drop <= ray.distance))
        distance = jnp.where(first, drop, ray.distance)
        platform = None
        if ray.platform is not None and rest.platform is not None:
            platform = jnp.where(first, rest.platform, ray.platform)
        normal = jnp.where(first[..., None], rest.normal, ray.normal)
        found = jnp.where(first, rest.found, ray.found)
        return Hit(starts_ws - vec.scale(up, distance), normal, distance, found, platform)
