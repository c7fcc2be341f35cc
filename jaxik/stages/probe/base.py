"""The abstract probes, what all share, and which ground a foot may stand on.

Ground is refused that is too high, too low, too steep or too narrow.
"""

import dataclasses
import functools
import math
from abc import abstractmethod

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import parameter_tree, quat, vec
from jaxik.maths.parameter_tree import Leaf, Rule, angle, constant, length, option, ratio
from jaxik.maths.smoothing import lerp, smoothstep
from jaxik.stages.inputs import GroundMoment, Inputs
from jaxik.world.frame import (
    FORWARD,
    Contact,
    Frame,
    GroundHits,
    Rays,
    Stride,
    animated_ankles,
    heading,
)
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import Hit, Terrain, cast

SAME_STEP, SAME_FADE = 0.05, 0.03  # m, between hits under one sole, and over which it fades
RING = tuple(  # forward and right of the rays that look for support around a foothold
    (math.cos(turn), math.sin(turn)) for turn in (i * math.pi / 4 for i in range(8))
)
SUPPORT_FADE = 0.25  # of the ring, over which ground becomes too narrow
SLOPE_FADE = 0.10  # rad, over which a slope becomes too steep
SAME_GROUND = 1e-3  # m, between hits of one surface at most
HOLLOW = 0.02  # m, depth up to which ground between two others is uneven; as much more is a gap


class AbstractProbe(Rule):
    """Finds the ground under the feet."""

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a probe that goes by each frame alone."""
        return None

    def watch(self, inputs: Inputs, contact: Contact, foot_height: Array) -> PyTree:
        """What memory advances with, from this frame alone."""
        return None

    def advance(
        self, now: GroundMoment, watched: PyTree, state: PyTree
    ) -> tuple[PyTree, Stride | None]:
        """Memory after this frame, and the stride that `sense` finds in the frame.

        It runs before `sense`. None leaves the animation's stride.
        """
        return None, None

    def ground(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        """The ground that counts, as `sense` finds it."""
        return self.sense(inputs, contact, foot_height)

    @abstractmethod
    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        """The ground under each leg in this frame; `foot_height` is from sole to ankle, m."""


def level_origin(inputs: Inputs) -> Float[Array, "*#legs 3"]:
    """Where the level of each leg is, m, world space, from which steps of its ground count.

    That of legs is the character's root. One that bears nothing, such as a hand on a wall, has no
    level but its own animated place.
    """
    root_ws = inputs.frame.world_from_model.pos
    if isinstance(inputs.terrain, Terrain):
        return root_ws
    return lerp(root_ws, animated_ankles(inputs.frame).pos, 1.0 - inputs.bearing[:, None])


def separate(hits: Hit) -> list[Hit]:
    """Hits along their first axis."""
    return [jax.tree.map(lambda x: x[i], hits) for i in range(len(hits.found))]  # noqa: B023


def toe_point(rig: Rig, frame: Frame, toe_ls: Array) -> Array:
    """Toe of each leg, m, model space.

    `toe_ls` is the toe of a left foot relative to its ankle, in foot axes; right feet mirror it.
    """
    x, y, z = vec.components(toe_ls)
    foot = quat.multiply(frame.pose.ankle.rot, rig.ankle_from_foot)
    return frame.pose.ankle.pos + quat.rotate(foot, vec.stack(rig.side * x, y, z))


def foot_heading(inputs: Inputs) -> tuple[Array, Array]:
    """Forward and right of each animated foot, unit, perpendicular to its up, world space.

    A foot that points along up gets those of the character.
    """
    if inputs.foot_heading_ws is not None:
        return inputs.foot_heading_ws
    frame, up_ws = inputs.frame, inputs.terrain.leg_up_ws
    foot = quat.multiply(animated_ankles(frame).rot, inputs.rig.ankle_from_foot)
    sole = quat.rotate(foot, vec.constant(FORWARD, up_ws))
    ahead = vec.across(sole, up_ws, heading(frame.world_from_model, up_ws)[0])
    return ahead, vec.cross(ahead, up_ws)


def with_weight(hit: Hit, found: Array) -> Hit:
    """The hit with another weight `found`."""
    return dataclasses.replace(hit, found=found)


def mixed(hit: Hit, other: Hit, up_ws: Array) -> Hit:
    """Both hits, each by how far it is found; these weights add up to at most 1."""
    found = hit.found + other.found
    found, share = vec.stacked_barrier(found, vec.safe_divide(other.found, found))
    platform = None
    if hit.platform is not None and other.platform is not None:
        platform = jnp.where(share > 0.5, other.platform, hit.platform)
    return Hit(
        vec.add(hit.point, vec.scale(other.point - hit.point, share)),
        vec.normalize(lerp(hit.normal, other.normal, share[..., None]), up_ws),
        lerp(hit.distance, other.distance, share),
        found,
        platform,
    )


def no_hit(like: Hit) -> Hit:
    """Misses, for rays that were not cast."""
    return with_weight(like, jnp.zeros_like(like.found))


def or_level(hit: Hit, found: Array, level_ws: Array) -> Hit:
    """The hit where its foot was `found` too; else a miss at `level_ws`, level with the foot."""
    weight = hit.found * found
    point = lerp(level_ws, hit.point, weight[..., None])
    return Hit(point, hit.normal, hit.distance, weight, hit.platform)


def on_same_ground(hit: Hit, foot: Hit, up_ws: Array) -> Hit:
    """A hit beside that of its foot, less found the higher the step is between them.

    A toe over a ledge is not to pitch its foot into it, nor one before a riser onto it.
    """
    way = hit.point - foot.point
    # Off the foot's ground along its normal, and so along up.
    step = vec.safe_divide(vec.dot(way, foot.normal), vec.dot(foot.normal, up_ws))
    same = 1.0 - smoothstep((jnp.abs(step) - SAME_STEP) / SAME_FADE)
    return with_weight(hit, hit.found * jnp.where(foot.found > 0, same, 1.0))


def make_rays(like: Hit, above: Array, below: Array, layers: Array) -> Rays:
    """One ray per hit in `like`, all of the same reach, m."""
    shape = like.found.shape
    return Rays(jnp.broadcast_to(above, shape), jnp.broadcast_to(below, shape), layers)


class AbstractLimitedProbe(AbstractProbe):
    """Rays that refuse ground which is too high, too low, too steep or, if asked to, too narrow.

    Steps are measured from the level of the character's root (`level_origin`), and only by what is
    not a slope: of ground that rises evenly from below the root nothing is a step. Where the
    highest ground below a ray is refused, that below the highest step counts, such as the floor
    under a table. Where that is refused too, there is no ground, and the foot stays as animated.

    With `check_support` eight rays around each foothold, `support_radius` from it, look for ground
    that goes on as it is there, neither higher nor lower by more than that radius. A post has none
    around it, a beam two, an edge half, a floor all eight. Ground with less than `min_support` of
    them is refused.

    Feet stand over gaps narrower than `support_radius`, in the ground and between planks
    (`cast_over_gaps`): what lies that far to either side carries them.

    With `simple_in_flight`, as simple and complex collision in Unreal's Foot Placement, feet in
    flight see `flight_layers` and standing feet `layers`, in between by their contact. A swing
    whose footholds are known goes over from one to the other as it leaves and lands.

    Ground fades out over `step_fade`, `SLOPE_FADE` and `SUPPORT_FADE` beyond its limit: `found`
    falls from 1 to 0.
    """

    max_step_up: Leaf = length(
        0.3, 0.1, 1, "Height of a step up, not of a slope, above which ground is refused."
    )
    max_step_down: Leaf = length(
        0.4, 0.1, 1, "Height of a step down, not of a slope, above which ground is refused."
    )
    max_slope: Leaf = angle(0.785, 0.1, 1.5, "Slope of the ground above which it is refused.")
    step_fade: Leaf = constant(
        0.1, "Height over which a step becomes too high or too low.", unit="m"
    )
    min_support: Leaf = ratio(
        0.5, 0, 1, "Share of the ground around a foothold that must go on; with less it is refused."
    )
    support_radius: Leaf = length(
        0.04,
        0.01,
        0.15,
        "Distance from a foothold at which ground must go on: half the width of a sole.",
    )
    limited: bool = option(
        True, "Whether any ground is refused; without limits no ray is cast for them."
    )
    check_support: bool = option(
        False, "Whether narrow ground is refused, which takes nine times as many rays."
    )
    flight_layers: Leaf = parameter_tree.layers(
        "Layers that count for feet in flight, one bit each."
    )
    simple_in_flight: bool = option(
        False, "Whether other layers count for feet in flight, which takes twice as many rays."
    )

    def ground(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        standing = self.sense(inputs, contact, foot_height)
        if not self.simple_in_flight:
            return standing
        simple = dataclasses.replace(self, **{"layers": self.flight_layers})
        flying, up = simple.sense(inputs, contact, foot_height), inputs.terrain.leg_up_ws
        stride = inputs.frame.stride
        # A swing that is known begins and ends on what its foot stands on.
        apart = 4.0 * stride.fraction * (1.0 - stride.fraction)
        share = (1.0 - contact.weight) * (1.0 - stride.known * (1.0 - smoothstep(apart)))

        def weighed(hit: Hit, other: Hit) -> Hit:
            first = with_weight(hit, (1.0 - share) * hit.found)
            return mixed(first, with_weight(other, share * other.found), up)

        names = ("swing", "lift", "pitch", "support")
        blended = {
            name: lerp(value, getattr(flying, name), share)
            for name in names
            if (value := getattr(standing, name)) is not None
        }
        hits = {
            name: weighed(getattr(standing, name), getattr(flying, name))
            for name in ("ankle", "toe", "corner")
        }
        return dataclasses.replace(standing, **hits, **blended)

    def cast(
        self,
        inputs: Inputs,
        starts_ws: Array,
        reach: Array,
        layers: Array,
        margin: Array | None = None,
        stood_on: bool = True,
    ) -> Hit:
        """The ground below points above the feet; refused ground counts as missed.

        Args:
            inputs: the frame.
            starts_ws: where the rays start, (... legs 3), m.
            reach: their length, m.
            layers: what they can hit.
            margin: how much higher and lower than a step ground may be (... legs), m; None is 0.
            stood_on: whether a foot is to stand there; what it only passes may be narrow.
        """
        up = inputs.terrain.leg_up_ws
        if not self.limited:
            return cast(inputs.terrain, starts_ws, reach, layers)
        margin = jnp.zeros_like(starts_ws[..., 0]) if margin is None else margin
        origin = level_origin(inputs)
        above = vec.dot(starts_ws - origin, up) - self.max_step_up - margin
        above = jnp.where(above > 0, above, 0.0)
        # Both by one search: each search adds much to a program.
        starts = jnp.stack([starts_ws, starts_ws - vec.scale(up, above)])
        reaches = jnp.stack([reach + jnp.zeros_like(above), reach - above])
        hits = cast(inputs.terrain, starts, reaches, layers)
        accepted = hits.found * self.trust_from(origin, hits, up, margin)
        if self.check_support and stood_on:
            accepted *= self._trust_of_width(inputs, starts, reaches, hits, layers)
        first, below = (jax.tree.map(lambda x: x[i], hits) for i in range(2))  # noqa: B023
        # Ground that is refused for its slope may be hit by both rays.
        lies_below = below.distance + above > first.distance + SAME_GROUND
        upper, lower = vec.stacked_barrier(*accepted)
        lower = jnp.where(lies_below, (1.0 - upper) * lower, 0.0)
        below = dataclasses.replace(below, distance=below.distance + above, found=lower)
        return mixed(with_weight(first, upper), below, up)

    def cast_over_gaps(self, inputs: Inputs, starts_ws: Array, reach: Array, layers: Array) -> Hit:
        """What carries feet below these points: `cast`, or the lower side of a narrow gap.

        The sides are diagonally to the foot, so that it stands over gaps along it and across.
        """
        if not self.limited:
            return self.cast(inputs, starts_ws, reach, layers)
        up = inputs.terrain.leg_up_ws
        forward, aside = foot_heading(inputs)
        away = vec.scale(forward + aside, self.support_radius)
        starts = jnp.stack([starts_ws, starts_ws + away, starts_ws - away])
        hits = self.cast(inputs, starts, reach, layers)
        hit, left, right = (jax.tree.map(lambda x: x[i], hits) for i in range(3))  # noqa: B023
        heights = vec.dot(hits.point, up)
        side = jnp.where(heights[1] < heights[2], heights[1], heights[2])
        depth = side - heights[0]
        spans = left.found * right.found * smoothstep((depth - HOLLOW) / HOLLOW)
        normal = lerp(hit.normal, left.normal + right.normal, spans[..., None])
        platform = hit.platform
        if platform is not None:
            platform = jnp.where(spans > 0.5, left.platform, platform)
        return Hit(
            hit.point + vec.scale(up, spans * depth),
            vec.normalize(normal, up),
            hit.distance - spans * depth,
            lerp(hit.found, jnp.ones_like(spans), spans),
            platform,
        )

    def trust(self, step: Array, normal: Array, up_ws: Array) -> Array:
        """0..1, how far ground with this normal is accepted after a step of this height, m."""
        low_enough = 1.0 - smoothstep(self.excess(step) / self.step_fade)
        return low_enough * self.gentleness(normal, up_ws)

    def excess(self, step: Array) -> Array:
        """By how much a step, up or down, is beyond its limit, m; negative within it."""
        up, down = step - self.max_step_up, -step - self.max_step_down
        return jnp.where(up > down, up, down)

    def gentleness(self, normal: Array, up_ws: Array) -> Array:
        """0..1, how far ground with this normal is accepted: less if it is too steep."""
        cosine = vec.dot(normal, up_ws)
        slope = vec.safe_arctan2(vec.length(vec.cross(normal, up_ws)), cosine)
        return 1.0 - smoothstep((slope - self.max_slope) / SLOPE_FADE)

    def climb(self, normal: Array, way: Array, up_ws: Array) -> Array:
        """How much higher ground with this normal is at the end of a way than at its start, m.

        Ground that is too steep counts as level: a foot is not to follow a wall.
        """
        return climb(normal, way, up_ws) * self.gentleness(normal, up_ws)

    def trust_from(self, origin_ws: Array, hits: Hit, up_ws: Array, margin: Array) -> Array:
        """0..1, how far each hit is accepted where the level goes through that origin."""
        if not self.limited:
            return self.gentleness(hits.normal, up_ws)
        way = hits.point - origin_ws
        rise = vec.dot(way, up_ws)
        slope = least_rise(rise, climb(hits.normal, way, up_ws))
        (step,) = vec.stacked_barrier(rise - slope)
        step -= jnp.where(step > margin, margin, jnp.where(step < -margin, -margin, step))
        return self.trust(step, hits.normal, up_ws)

    def _trust_of_width(
        self, inputs: Inputs, starts_ws: Array, reach: Array, hits: Hit, layers: Array
    ) -> Array:
        """0..1, how far each hit is accepted for the ground around it."""
        up, radius = inputs.terrain.leg_up_ws, self.support_radius
        ahead, right = foot_heading(inputs)
        forward, aside = jnp.moveaxis(jnp.asarray(RING, starts_ws.dtype), -1, 0)[..., None]
        ways = vec.scale(vec.scale(ahead, forward) + vec.scale(right, aside), radius)
        ways = ways.reshape(len(RING), *[1] * (starts_ws.ndim - ahead.ndim), *ahead.shape)
        starts = starts_ws + ways
        reach = jnp.broadcast_to(reach + radius, starts.shape[:-1])
        around = cast(inputs.terrain, starts, reach, layers)
        even = vec.dot(hits.point - starts_ws, up) + climb(hits.normal, ways, up)
        gap = jnp.abs(vec.dot(around.point - starts, up) - even)
        level = around.found * (1.0 - smoothstep(vec.safe_divide(gap, radius) - 0.5))
        missing = self.min_support - level.sum(0) / len(RING)
        return 1.0 - smoothstep(missing / SUPPORT_FADE)


def climb(normal: Array, way: Array, up_ws: Array) -> Float[Array, "*b"]:
    """How much higher a plane with this normal is at the end of a way than at its start, m."""
    against = vec.dot(vec.reject(way, up_ws), normal)
    return -vec.safe_divide(against, vec.dot(normal, up_ws))


def least_rise(*rises: Array) -> Array:
    """The rise nearest to 0, or 0 if some go up and others down, m."""
    # Not `jnp.minimum`: on a plane all are equal, and its derivative would add up several of them.
    rises = vec.stacked_barrier(*rises)
    lowest = functools.reduce(lambda a, b: jnp.where(a < b, a, b), rises)
    highest = functools.reduce(lambda a, b: jnp.where(a > b, a, b), rises)
    return jnp.where(lowest > 0, lowest, jnp.where(highest < 0, highest, 0.0))
