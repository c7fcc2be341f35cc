"""Stage 3 with foresight: the ground as a stride will meet it."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import parameter_tree, quat, vec
from jaxik.maths.parameter_tree import Leaf, parameter
from jaxik.maths.struct import struct
from jaxik.world.frame import Contact, GroundHits, Stride, animated_ankles
from jaxik.world.terrain import Hit, LegTerrains, Terrain, cast

from .inputs import Inputs
from .probe import AbstractProbe, rays_of, unseen

HEIGHT_BAND = 0.01  # m
STEP_FADE = 0.10  # m over which a step becomes too high
SLOPE_FADE = 0.10  # rad over which a slope becomes too steep
WAY = 8  # rays between two footholds
ENDS = 0.15  # share of a swing, at either end, in which nothing is stepped over any more
NOWHERE = -1e6  # m, below any ground


class StrideProbe(AbstractProbe):
    """Rays at the last and the next foothold; between them the ground is a smooth curve.

    A swinging foot leaves the ground of its last stance and is to arrive on that of its next, so
    the ground under it goes from the one height to the other: `s = x^k / (x^k + (1 - x)^k)` of the
    way, with `x` the share of the swing between `rise_start` and `rise_end` and `k` the
    `steepness` (1.875 has the middle slope of the quintic of least jerk; Flash and Hogan 1985). A
    foot thus begins to rise before the block is under it.

    The animation may tell where its feet stood and will stand (`Frame.stride`). Where it does not,
    both follow from the character's velocity: feet stand for `stance_time` and swing for
    `swing_time`, from as far ahead of the hip to as far behind it (Raibert 1986).

    A next foothold more than `max_step` off the last, or steeper than `max_slope`, loses its say by
    and by, so that a foot neither drops off a ledge nor snaps onto a wall. Rays between the
    footholds lift the foot over edges up to `max_step` above them, on a slope of `way_slope`
    towards each: where the ground stands out of the curve, heel and ball clear it by as much as the
    animation lifts them, less `clearance`.
    """

    ray_up: Leaf = parameter(
        1.0,
        unit="m",
        low=0.0,
        high=2.0,
        kind="threshold",
        doc="Height above the character's level at which rays start.",
    )
    ray_down: Leaf = parameter(
        1.0,
        unit="m",
        low=0.0,
        high=2.0,
        kind="threshold",
        doc="Depth below the character's level to which rays look.",
    )
    layers: Leaf = parameter_tree.layers()
    rise_start: Leaf = parameter(
        0.0,
        unit="1",
        low=0.0,
        high=0.45,
        doc="Part of the swing after which the foot begins to change its height.",
    )
    rise_end: Leaf = parameter(
        1.0,
        unit="1",
        low=0.55,
        high=1.0,
        above="rise_start",
        doc="Part of the swing after which the foot has its next foothold's height.",
    )
    steepness: Leaf = parameter(
        1.875,
        unit="1",
        low=1.0,
        high=4.0,
        doc="How much faster than evenly the height changes in the middle of the swing.",
    )
    max_step: Leaf = parameter(
        0.60,
        unit="m",
        low=0.1,
        high=1.0,
        doc="Height of a step up or down above which the next foothold is ignored.",
    )
    max_slope: Leaf = parameter(
        1.05,
        unit="rad",
        low=0.1,
        high=1.4,
        doc="Slope of the ground above which the next foothold is ignored.",
    )
    clearance: Leaf = parameter(
        0.0,
        unit="m",
        low=-0.1,
        high=0.1,
        doc="How much of its animated lift a foot may lose as it passes over an edge.",
    )
    way_slope: Leaf = parameter(
        1.5,
        unit="1",
        low=0.2,
        high=5.0,
        scale="log",
        doc="Slope, rise over run, at which a foot climbs to an edge and descends from it.",
    )
    heel_length: Leaf = parameter(
        0.07, unit="m", low=0.0, high=0.2, doc="Distance backward from the ankle to the heel."
    )
    ball_height: Leaf = parameter(
        0.055, unit="m", low=0.0, high=0.15, doc="Height of the ball joint above the sole."
    )
    stance_time: Leaf = parameter(
        0.65,
        unit="s",
        low=0.2,
        high=1.5,
        doc="How long a foot stands, where the animation does not give its footholds.",
    )
    swing_time: Leaf = parameter(
        0.45,
        unit="s",
        low=0.1,
        high=1.0,
        doc="How long a foot swings, where the animation does not give its footholds.",
    )

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        terrain, frame = inputs.terrain, inputs.frame
        level = Level(frame.world_from_model.pos, terrain.leg_up_ws)
        stride = self._stride(inputs, contact, level)
        last, low = self._look(terrain, level, stride.last_ws)
        next_, high = self._look(terrain, level, stride.next_ws)
        found = jnp.where(last.found > next_.found, last.found, next_.found)
        low = jnp.where(last.found > 0, low, jnp.where(next_.found > 0, high, 0.0))
        normal = jnp.where(last.found[..., None] > 0, last.normal, next_.normal)
        trust = next_.found * self._trust(next_.normal, high - low, level)
        rise = trust * (high - low)
        normal_rise = vec.scale(next_.normal - normal, trust)

        share = vec.safe_divide(stride.fraction - self.rise_start, self.rise_end - self.rise_start)
        share = s_curve(share, self.steepness)
        height = low + rise * share
        top = low + jnp.where(rise > 0, rise, 0.0)
        feet = self._feet(inputs, level, foot_height)
        height += self._over_edges(inputs, stride, feet, height, top)
        height = jnp.where(found > 0, height, 0.0)

        ankle_ws = level.at(animated_ankles(frame).pos) + vec.scale(level.up_ws, height)
        tilted = normal + vec.scale(normal_rise, share)
        hit = Hit(ankle_ws, vec.normalize(tilted, level.up_ws), self.ray_up - height, found)
        rays = rays_of(hit, self.ray_up, self.ray_down, self.layers)
        return GroundHits(hit, unseen(hit), unseen(hit), rays)

    def _stride(self, inputs: Inputs, contact: Contact, level: "Level") -> Stride:
        """The stride as it is told, or else as velocity foretells it."""
        frame, gate = inputs.frame, inputs.gate
        told = frame.stride
        velocity = vec.reject(frame.velocity_ws, level.up_ws)
        ball = level.at(frame.world_from_model.apply(frame.pose.toe.pos))
        ankle, hip = animated_ankles(frame).pos, frame.world_from_model.apply(frame.pose.hip.pos)
        half = 0.5 * self.stance_time
        ahead = vec.safe_divide(vec.dot(ankle - hip, velocity), vec.dot(velocity, velocity))
        ahead = gate.clip(ahead, -half, half, band=0.02)
        share = 0.5 + ahead / self.stance_time
        zero = jnp.zeros_like(share)
        share = gate.choose(contact.planted, zero, share)
        past = gate.choose(contact.planted, zero, half + ahead + share * self.swing_time)
        left = half - ahead + (1.0 - share) * self.swing_time
        left = gate.choose(contact.planted, zero + self.stance_time + self.swing_time, left)
        known = told.known > 0
        last_ws, next_ws = (
            jnp.where(known[..., None], place, ball + vec.scale(velocity, time))
            for place, time in ((told.last_ws, -past), (told.next_ws, left))
        )
        share = jnp.where(known, told.fraction, share)
        return Stride(told.standing, last_ws, next_ws, share, told.known)

    def _look(
        self, terrain: Terrain | LegTerrains, level: "Level", places_ws: Array
    ) -> tuple[Hit, Array]:
        """What lies at these places of the ground plan, and its height over the level, m."""
        above = level.at(places_ws) + vec.scale(level.up_ws, self.ray_up)
        hit = cast(terrain, above, self.ray_up + self.ray_down, self.layers)
        return hit, level.height(hit.point)

    def _trust(self, normal: Array, step: Array, level: "Level") -> Array:
        """0..1, how much of a step to ground with this normal is taken."""
        cosine = vec.dot(normal, level.up_ws)
        slope = vec.safe_arctan2(vec.length(vec.cross(normal, level.up_ws)), cosine)
        low = 1.0 - smooth_share((jnp.abs(step) - self.max_step) / STEP_FADE)
        return low * (1.0 - smooth_share((slope - self.max_slope) / SLOPE_FADE))

    def _feet(self, inputs: Inputs, level: "Level", foot_height: Array) -> Array:
        """The soles' heels and balls as animated, (2 legs 3), m, world space."""
        frame = inputs.frame
        ankle = animated_ankles(frame)
        foot = quat.multiply(ankle.rot, inputs.rig.ankle_from_foot)
        under = vec.stack(jnp.zeros_like(self.heel_length), -foot_height, -self.heel_length)
        heel = ankle.pos + quat.rotate(foot, under)
        ball = frame.world_from_model.apply(frame.pose.toe.pos)
        return jnp.stack([heel, ball - vec.scale(level.up_ws, self.ball_height)])

    def _over_edges(
        self, inputs: Inputs, stride: Stride, feet: Array, height: Array, top: Array
    ) -> Float[Array, " legs"]:
        """How much higher, m, each foot goes so as not to touch what lies between its footholds."""
        terrain, gate = inputs.terrain, inputs.gate
        level = Level(inputs.frame.world_from_model.pos, terrain.leg_up_ws)
        shares = (jnp.arange(WAY, dtype=height.dtype) + 0.5) / WAY
        way_ws = stride.last_ws + vec.scale(
            stride.next_ws - stride.last_ws, shares[:, None]
        )  # (way legs 3)
        hit, ground = self._look(terrain, level, way_ws)
        fade = 1.0 - smooth_share((ground - top - self.max_step) / STEP_FADE)
        away = vec.length(vec.reject(way_ws[:, None] - feet, level.up_ws))  # (way 2 legs)
        over = fade[:, None] * (ground[:, None] - self.way_slope * away - height)
        # What the animation itself does over its floor is not to be mended.
        lift = level.height(feet) - self.clearance
        lift = gate.clip(lift, jnp.zeros_like(lift), jnp.full_like(lift, jnp.inf), band=HEIGHT_BAND)
        need = over - lift
        need = jnp.where(hit.found[:, None] > 0, need, NOWHERE)
        most = gate.maximum(jnp.moveaxis(need.reshape(-1, *height.shape), 0, -1), band=HEIGHT_BAND)
        zero = jnp.zeros_like(most)
        most = gate.clip(most, zero, zero + jnp.inf, band=HEIGHT_BAND)
        return (
            most
            * smooth_share(stride.fraction / ENDS)
            * smooth_share((1.0 - stride.fraction) / ENDS)
        )


@struct
class Level:
    """The level of a character's root, at right angles to each leg's up."""

    origin_ws: Float[Array, "3"]  # m
    up_ws: Float[Array, "*legs 3"]

    def height(self, points_ws: Float[Array, "*b legs 3"]) -> Float[Array, "*b legs"]:
        """Of points over the level, m."""
        return vec.dot(points_ws - self.origin_ws, self.up_ws)

    def at(self, points_ws: Float[Array, "*b legs 3"]) -> Float[Array, "*b legs 3"]:
        """The points' places on the level, m."""
        return points_ws - vec.scale(self.up_ws, self.height(points_ws))


def s_curve(share: Array, steepness: Array) -> Array:
    """From 0 to 1 with `share`, `steepness` times as fast in the middle: 1 / (1 + (1/x - 1)^k)."""
    inside = (share > 0) & (share < 1)
    x = jnp.where(inside, share, 0.5)
    odds = jnp.exp(steepness * (jnp.log1p(-x) - jnp.log(x)))
    return jnp.where(inside, 1.0 / (1.0 + odds), jnp.where(share < 0.5, 0.0, 1.0))


def smooth_share(x: Array) -> Array:
    """`3x² - 2x³` between 0 and 1, which goes from 0 to 1 without a kink; flat outside."""
    x = jnp.where(x < 0, 0.0, jnp.where(x > 1, 1.0, x))
    return x * x * (3.0 - 2.0 * x)
