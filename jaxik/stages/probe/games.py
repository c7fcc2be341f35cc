"""The probes of the games: ozz and the record, Unreal, Mec."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import parameter_tree, vec
from jaxik.maths.parameter_tree import Leaf, length, switch, threshold
from jaxik.maths.smoothing import lerp
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import Contact, GroundHits, animated_ankles
from jaxik.world.terrain import Hit

from .base import (
    AbstractLimitedProbe,
    foot_heading,
    level_origin,
    make_rays,
    no_hit,
    on_same_ground,
    or_level,
    separate,
    toe_point,
    with_weight,
)

HEIGHT_BAND = 0.01  # m
SPEED_BAND = 0.05  # m/s
MARGIN = 0.1  # m that rays are cast too far, so that a softened reach has ground on both sides


class FootProbe(AbstractLimitedProbe):
    """One ray at the ankle and, with `use_toe`, one at the toe (the record; ozz has no toe ray)."""

    ray_up: Leaf = threshold(
        0.5, 0, 2, "Height above ankle and toe at which the rays start.", unit="m"
    )
    ray_down: Leaf = threshold(
        0.8, 0, 2, "Depth below ankle and toe to which the rays look.", unit="m"
    )
    toe_ls: Leaf = length(
        (0, -0.07, 0.2),
        -0.4,
        0.4,
        "Toe of a left foot from its ankle, in foot axes (x left, y up, z forward).",
    )
    use_toe: Leaf = switch(
        True, "Whether a second ray, at the toe, measures the pitch of the ground."
    )
    layers: Leaf = parameter_tree.layers()

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        terrain, frame = inputs.terrain, inputs.frame
        reach = self.ray_up + self.ray_down
        above = vec.scale(terrain.leg_up_ws, self.ray_up)
        ankle_ws = animated_ankles(frame).pos
        toe_ws = frame.world_from_model.apply(toe_point(inputs.rig, frame, self.toe_ls))
        starts = (ankle_ws + above, toe_ws + above)
        ankle, toe = separate(self.cast_over_gaps(inputs, jnp.stack(starts), reach, self.layers))
        toe = with_weight(toe, jnp.where(self.use_toe, toe.found, 0.0))
        if self.limited:
            toe = on_same_ground(toe, ankle, terrain.leg_up_ws)
        rays = make_rays(ankle, self.ray_up, self.ray_down, self.layers)
        return GroundHits(ankle, toe, no_hit(ankle), jnp.zeros_like(ankle.found), rays)


class RootProbe(AbstractLimitedProbe):
    """One vertical ray through each ankle, between two heights relative to the root.

    This is the trace of Unreal's foot IK: it starts at the height of the capsule's centre, `ray_up`
    (the half-height) above the root, and ends `ray_down` (the trace distance) below the root.
    """

    ray_up: Leaf = threshold(
        0.9,
        0,
        2,
        "Height above the character's origin at which rays start: its capsule's centre.",
        unit="m",
    )
    ray_down: Leaf = threshold(
        0.5, 0, 2, "Depth below the character's origin to which rays look.", unit="m"
    )
    layers: Leaf = parameter_tree.layers()

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        terrain, frame = inputs.terrain, inputs.frame
        up, ankle_ws = terrain.leg_up_ws, animated_ankles(frame).pos
        over_level = vec.dot(ankle_ws - level_origin(inputs), up)
        start = ankle_ws + vec.scale(up, self.ray_up - over_level)
        hit = self.cast_over_gaps(inputs, start, self.ray_up + self.ray_down, self.layers)
        rays = make_rays(hit, self.ray_up, self.ray_down, self.layers)
        return GroundHits(hit, no_hit(hit), no_hit(hit), jnp.zeros_like(hit.found), rays)


class CornerProbe(AbstractLimitedProbe):
    """Three rays: at the foot, ahead of it for pitch, and to its right for roll (Mec).

    The rays for toe and corner start from where the first ray placed the foot, in the directions of
    the animated foot. All rays end `foot_height` and an extra distance below the foot: `extra`, or,
    with `by_height` or `by_speed` on, `extra_max` for a stable foot (low, slow, or both) and
    `extra_min` for others.
    """

    active: Leaf = switch(True, "Whether the leg looks for ground; if not, it stays as animated.")
    ray_up: Leaf = threshold(0.5, 0, 2, "Height above the foot at which rays start.", unit="m")
    foot_length: Leaf = length(0.2, 0.02, 0.5, "Distance forward from the foot to the toe's ray.")
    half_width: Leaf = length(
        0.05, 0.01, 0.2, "Distance to the right from the foot to the corner's ray."
    )
    extra: Leaf = threshold(
        0.2,
        0,
        1,
        "How far rays look below the sole where neither height nor speed sets it.",
        unit="m",
    )
    by_height: Leaf = switch(
        True, "Whether rays look deeper below a foot that is low over the root."
    )
    by_speed: Leaf = switch(False, "Whether rays look deeper below a foot that is slow.")
    extra_min: Leaf = threshold(
        0, 0, 1, "How far rays look below the sole of an unstable foot.", unit="m"
    )
    extra_max: Leaf = threshold(
        0.3, 0, 1, "How far rays look below the sole of a stable foot.", unit="m", above="extra_min"
    )
    stable_height: Leaf = threshold(
        0.12,
        0,
        0.5,
        "Height over the root below which a foot counts as stable.",
        unit="m",
        follows="over ankle height",
    )
    stable_speed: Leaf = threshold(
        0.5, 0, 3, "Speed below which a foot counts as stable.", unit="m/s"
    )
    layers: Leaf = parameter_tree.layers()

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        frame, gate, up = inputs.frame, inputs.gate, inputs.terrain.leg_up_ws
        foot = animated_ankles(frame)
        below = foot_height + self._extra(inputs, foot.pos, up)
        reach = self.ray_up + below

        def hits_below(*points_ws: Array) -> list[Hit]:
            starts = [point + vec.scale(up, self.ray_up) for point in points_ws]
            hits = separate(self.cast(inputs, jnp.stack(starts), reach + MARGIN, self.layers))
            near = (gate.below(hit.distance, reach, band=HEIGHT_BAND) for hit in hits)
            return [
                with_weight(hit, hit.found * weight) for hit, weight in zip(hits, near, strict=True)
            ]

        (ankle,) = hits_below(foot.pos)
        ankle = with_weight(ankle, jnp.where(self.active, ankle.found, 0.0))
        level = foot.pos - vec.scale(up, foot_height)
        sole = lerp(level, ankle.point, ankle.found[..., None])
        ahead, right = foot_heading(inputs)
        over = sole + vec.scale(up, foot_height)
        sides = (vec.scale(ahead, self.foot_length), vec.scale(right, self.half_width))
        beside = hits_below(*(over + offset for offset in sides))
        if self.limited:
            beside = [on_same_ground(hit, ankle, up) for hit in beside]
        toe, corner = (
            or_level(hit, ankle.found, sole + offset)
            for hit, offset in zip(beside, sides, strict=True)
        )
        rays = make_rays(ankle, self.ray_up + foot_height, below - foot_height, self.layers)
        return GroundHits(ankle, toe, corner, jnp.zeros_like(ankle.found), rays)

    def _extra(self, inputs: Inputs, foot_ws: Array, up_ws: Array) -> Array:
        """How far below a standing sole the rays of each foot end, m."""
        frame, gate = inputs.frame, inputs.gate
        height = vec.dot(foot_ws - level_origin(inputs), up_ws)
        low = gate.below(height, self.stable_height, band=HEIGHT_BAND)
        slow = gate.below(frame.foot_speed, self.stable_speed, band=SPEED_BAND)
        stable = jnp.where(self.by_height, low, 1.0) * jnp.where(self.by_speed, slow, 1.0)
        chosen = gate.choose(stable, self.extra_max, self.extra_min)
        return jnp.where(self.by_height | self.by_speed, chosen, self.extra)
