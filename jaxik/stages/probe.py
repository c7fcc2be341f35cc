"""Stage 3: rays that look for ground under each foot."""

import dataclasses
from abc import abstractmethod
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import parameter_tree, quat, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.parameter_tree import Leaf, Rule, parameter, switch
from jaxik.world.frame import FORWARD, Contact, Frame, GroundHits, Rays, animated_ankles, heading
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import Hit, LegTerrains, Terrain, cast

from .inputs import Inputs

HEIGHT_BAND = 0.01  # m
SPEED_BAND = 0.05  # m/s
MARGIN = 0.1  # m by which a ray is cast beyond its reach, so that a softened end has two sides


class AbstractProbe(Rule):
    """Looks for ground."""

    @abstractmethod
    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        """What the rays of each leg see in this frame; `foot_height`, m, is sole to ankle."""


class FootProbe(AbstractProbe):
    """A ray at the ankle and, if wanted, one at the toe (record: useFootEndRay; ozz without it)."""

    ray_up: Leaf = parameter(
        0.50,
        unit="m",
        low=0.0,
        high=2.0,
        kind="threshold",
        doc="Height above ankle and toe at which the rays start.",
    )
    ray_down: Leaf = parameter(
        0.80,
        unit="m",
        low=0.0,
        high=2.0,
        kind="threshold",
        doc="Depth below ankle and toe to which the rays look.",
    )
    toe_ls: Leaf = parameter(
        (0.0, -0.07, 0.20),
        unit="m",
        low=-0.4,
        high=0.4,
        doc="Toe of a left foot from its ankle, in foot axes (x left, y up, z forward).",
    )
    use_toe: Leaf = switch(
        True, doc="Whether a second ray, at the toe, measures the pitch of the ground."
    )
    layers: Leaf = parameter_tree.layers()

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        terrain, frame = inputs.terrain, inputs.frame
        reach = self.ray_up + self.ray_down
        above = vec.scale(terrain.leg_up_ws, self.ray_up)
        ankle_ws = animated_ankles(frame).pos
        toe_ws = frame.world_from_model.apply(toe_point(inputs.rig, frame, self.toe_ls))
        ankle, toe = cast_each(terrain, (ankle_ws + above, toe_ws + above), reach, self.layers)
        toe = seen_if(toe, jnp.where(self.use_toe, toe.found, 0.0))
        rays = rays_of(ankle, self.ray_up, self.ray_down, self.layers)
        return GroundHits(ankle, toe, unseen(ankle), rays)


class RootProbe(AbstractProbe):
    """A ray over each ankle's place on the ground plan, between two heights over the root.

    Unreal's trace (seed 001): from the capsule's centre, `ray_up` (its half-height) over the root,
    to `ray_down` (the trace distance) under it.
    """

    ray_up: Leaf = parameter(
        0.90,
        unit="m",
        low=0.0,
        high=2.0,
        kind="threshold",
        doc="Height above the character's origin at which rays start: its capsule's centre.",
    )
    ray_down: Leaf = parameter(
        0.50,
        unit="m",
        low=0.0,
        high=2.0,
        kind="threshold",
        doc="Depth below the character's origin to which rays look.",
    )
    layers: Leaf = parameter_tree.layers()

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        terrain, frame = inputs.terrain, inputs.frame
        up, ankle_ws = terrain.leg_up_ws, animated_ankles(frame).pos
        over_root = vec.dot(ankle_ws - frame.world_from_model.pos, up)
        start = ankle_ws + vec.scale(up, self.ray_up - over_root)
        hit = cast(terrain, start, self.ray_up + self.ray_down, self.layers)
        rays = rays_of(hit, self.ray_up, self.ray_down, self.layers)
        return GroundHits(hit, unseen(hit), unseen(hit), rays)


class CornerProbe(AbstractProbe):
    """Three rays: at the foot, ahead of it for the pitch, and to its right for the roll (Mec).

    The toe's and the corner's rays start over the detected foot, along the animated foot's heading.
    Rays end `foot_height` and an extra distance under the foot. That extra is fixed, or set by how
    stable the foot is: the longer one while it is low, slow, or both, as the switches ask.
    """

    active: Leaf = switch(
        True, doc="Whether the leg looks for ground; if not, it stays as animated."
    )
    ray_up: Leaf = parameter(
        0.50,
        unit="m",
        low=0.0,
        high=2.0,
        kind="threshold",
        doc="Height above the foot at which rays start.",
    )
    foot_length: Leaf = parameter(
        0.20, unit="m", low=0.02, high=0.5, doc="Distance forward from the foot to the toe's ray."
    )
    half_width: Leaf = parameter(
        0.05,
        unit="m",
        low=0.01,
        high=0.2,
        doc="Distance to the right from the foot to the corner's ray.",
    )
    extra: Leaf = parameter(
        0.20,
        unit="m",
        low=0.0,
        high=1.0,
        kind="threshold",
        doc="How far rays look below the sole where neither height nor speed sets it.",
    )
    by_height: Leaf = switch(
        True, doc="Whether rays look deeper below a foot that is low over the root."
    )
    by_speed: Leaf = switch(False, doc="Whether rays look deeper below a foot that is slow.")
    extra_min: Leaf = parameter(
        0.0,
        unit="m",
        low=0.0,
        high=1.0,
        kind="threshold",
        doc="How far rays look below the sole of an unstable foot.",
    )
    extra_max: Leaf = parameter(
        0.30,
        unit="m",
        low=0.0,
        high=1.0,
        kind="threshold",
        above="extra_min",
        doc="How far rays look below the sole of a stable foot.",
    )
    stable_height: Leaf = parameter(
        0.12,
        unit="m",
        low=0.0,
        high=0.5,
        kind="threshold",
        doc="Height over the root below which a foot counts as stable.",
    )
    stable_speed: Leaf = parameter(
        0.50,
        unit="m/s",
        low=0.0,
        high=3.0,
        kind="threshold",
        doc="Speed below which a foot counts as stable.",
    )
    layers: Leaf = parameter_tree.layers()

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        frame, gate, up = inputs.frame, inputs.gate, inputs.terrain.leg_up_ws
        foot = animated_ankles(frame)
        below = foot_height + self._extra(inputs, foot.pos, up)
        reach = self.ray_up + below

        def look(*points_ws: Array) -> list[Hit]:
            starts = [place + vec.scale(up, self.ray_up) for place in points_ws]
            hits = cast_each(inputs.terrain, starts, reach + MARGIN, self.layers)
            seen = (gate.below(hit.distance, reach, band=HEIGHT_BAND) for hit in hits)
            return [seen_if(hit, hit.found * near) for hit, near in zip(hits, seen, strict=True)]

        (ankle,) = look(foot.pos)
        ankle = seen_if(ankle, jnp.where(self.active, ankle.found, 0.0))
        sole = gate.choose(
            ankle.found[..., None], ankle.point, foot.pos - vec.scale(up, foot_height)
        )
        ahead, right = foot_heading(inputs, up)
        over = sole + vec.scale(up, foot_height)
        level_toe = vec.scale(ahead, self.foot_length)
        level_corner = vec.scale(right, self.half_width)
        sides = (level_toe, level_corner)
        toe, corner = (
            on_level(hit, ankle.found, sole + aside, gate)
            for hit, aside in zip(look(*(over + aside for aside in sides)), sides, strict=True)
        )
        rays = rays_of(ankle, self.ray_up + foot_height, below - foot_height, self.layers)
        return GroundHits(ankle, toe, corner, rays)

    def _extra(self, inputs: Inputs, foot_ws: Array, up_ws: Array) -> Array:
        """How far under a standing sole each foot's rays end, m."""
        frame, gate = inputs.frame, inputs.gate
        height = vec.dot(foot_ws - frame.world_from_model.pos, up_ws)
        low = gate.below(height, self.stable_height, band=HEIGHT_BAND)
        slow = gate.below(frame.foot_speed, self.stable_speed, band=SPEED_BAND)
        stable = jnp.where(self.by_height, low, 1.0) * jnp.where(self.by_speed, slow, 1.0)
        chosen = gate.choose(stable, self.extra_max, self.extra_min)
        return jnp.where(self.by_height | self.by_speed, chosen, self.extra)


def cast_each(
    terrain: Terrain | LegTerrains, starts_ws: Sequence[Array], reach: Array, mask: Array
) -> list[Hit]:
    """What rays from several places of each leg meet; one search, which is much of a program."""
    hits = cast(terrain, jnp.stack(starts_ws), reach, mask)
    return [jax.tree.map(lambda x: x[i], hits) for i in range(len(starts_ws))]  # noqa: B023


def toe_point(rig: Rig, frame: Frame, toe_ls: Array) -> Array:
    """The toe of each leg, m, model space, for a toe given in the foot's axes from the ankle.

    Its sideways component is meant for a left foot and mirrors on a right one (A16).
    """
    x, y, z = vec.components(toe_ls)
    foot = quat.multiply(frame.pose.ankle.rot, rig.ankle_from_foot)
    return frame.pose.ankle.pos + quat.rotate(foot, vec.stack(rig.side * x, y, z))


def foot_heading(inputs: Inputs, up_ws: Array) -> tuple[Array, Array]:
    """Forward and right of each animated foot, unit, at right angles to up, world space.

    A foot that points along up has the character's.
    """
    frame = inputs.frame
    foot = quat.multiply(animated_ankles(frame).rot, inputs.rig.ankle_from_foot)
    sole = quat.rotate(foot, vec.constant(FORWARD, up_ws))
    ahead = vec.normalize(vec.reject(sole, up_ws), heading(frame.world_from_model, up_ws)[0])
    return ahead, vec.cross(ahead, up_ws)


def seen_if(hit: Hit, found: Array) -> Hit:
    """The hit with another weight."""
    return dataclasses.replace(hit, found=found)


def unseen(like: Hit) -> Hit:
    """Hits of rays that were not cast."""
    return seen_if(like, jnp.zeros_like(like.found))


def on_level(hit: Hit, found: Array, level_ws: Array, gate: AbstractGate) -> Hit:
    """A hit beside a foot that was `found`; a miss lies on the level at that foot."""
    seen = hit.found * found
    point = gate.choose(seen[..., None], hit.point, level_ws)
    return Hit(point, hit.normal, hit.distance, seen)


def rays_of(like: Hit, above: Array, below: Array, layers: Array) -> Rays:
    """Rays as many as hits, all of the same reach, m."""
    shape = like.found.shape
    return Rays(jnp.broadcast_to(above, shape), jnp.broadcast_to(below, shape), layers)
