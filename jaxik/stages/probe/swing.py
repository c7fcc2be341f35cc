"""How a foot swings from one foothold to the next: how high, how pitched, and over which edges."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.parameter_tree import Leaf, angle, constant, length, parameter, ratio, switch
from jaxik.maths.smoothing import smoothstep
from jaxik.maths.struct import struct
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import FORWARD, Stride, animated_ankles

from .base import AbstractLimitedProbe, foot_heading, least_rise, level_origin

HEIGHT_BAND = 0.01  # m
BLEND = 0.3  # of an arc over an edge, in which the animated lift gives way to it
FAR = 1e6  # m, beyond any ground
FIRST = 1e-12  # of a swing, in which nothing has moved yet
SHARPNESS = 7.0  # of the bumps by which a swing changes; each is half as high 0.2 of it aside
# When a swing changes most, as a fraction of it: measured on people who walk over blocks.
HELD, CLEAR, RISE, FALL, OVER = 0.28, 0.55, 0.52, 0.31, 0.455
TOES_UP, TOES_DOWN = 0.23, 0.75
ON_HEEL = 0.08  # rad, toes up, from which a foot of the animation is on its heel


@struct
class Level:
    """The plane through the `level_origin` of each leg, perpendicular to its up."""

    origin_ws: Float[Array, "*#legs 3"]
    """Metres."""
    up_ws: Float[Array, "*legs 3"]

    @classmethod
    def of(cls, inputs: Inputs) -> "Level":
        """That of a frame."""
        return cls(level_origin(inputs), inputs.terrain.leg_up_ws)

    def height(self, points_ws: Float[Array, "*b legs 3"]) -> Float[Array, "*b legs"]:
        """Height of points above the plane, m."""
        return vec.dot(points_ws - self.origin_ws, self.up_ws)

    def project(self, points_ws: Float[Array, "*b legs 3"]) -> Float[Array, "*b legs 3"]:
        """Points projected onto the plane, m."""
        return points_ws - vec.scale(self.up_ws, self.height(points_ws))


@struct
class Swing:
    """How a foot moves beyond the animation and the ground under it."""

    lift: Float[Array, " legs"]
    """m, of the ankle."""
    pitch: Float[Array, " legs"]
    """rad, toes up."""


class AbstractSwingProbe(AbstractLimitedProbe):
    """The parameters of a swing, for probes that know from where to where it goes.

    People who step up, down or over something lift a foot later than on the flat, but higher, and
    point their toes to the ground on which they will land. How much, follows from the step's height
    and from how far the ground on the way stands over both footholds. A foot that follows the other
    up is lifted most; one that leads, beyond the other foot's ground, the less the higher it goes,
    and onto the highest steps not at all. Each part is a bump over the time of the swing,
    `((x/m)^m ((1-x)/(1-m))^(1-m))^7` with its top at its own time `m`. The shape was read off a
    captured walk over blocks; where the ground is as even as in the animation nothing is added.
    Steps higher than `highest_step`, the highest of that walk, add no more than it does: several
    stairs at once are no reason to lift a foot far above them. Nor does a foot pass over what is
    higher than `highest_over` at a greater distance.
    """

    clearance: Leaf = length(
        0, -0.1, 0.1, "How much of its animated lift a foot may lose as it passes over an edge."
    )
    heel_length: Leaf = length(0.07, 0, 0.2, "Distance backward from the ankle to the heel.")
    toe_length: Leaf = length(
        0.04,
        0,
        0.2,
        "Distance forward from the ball to the tip of the toes, which bend as they pass.",
    )
    ball_height: Leaf = length(
        0.055, 0, 0.15, "Height of the ball joint above the sole.", follows="ball height"
    )
    held_lift: Leaf = ratio(
        0.6,
        0,
        1,
        "Part of its animated lift that a foot holds back early in a step on uneven ground.",
    )
    toe_clearance: Leaf = length(
        0.03,
        0,
        0.15,
        "How much higher than animated a foot passes the middle of a step on uneven ground.",
    )
    lift_per_rise: Leaf = ratio(
        0.5, 0, 1.5, "Height added to a step up to the other foot's ground, per height of the step."
    )
    lift_ahead: Leaf = ratio(
        0.85, 0, 2, "Height added to a step up from there on, per height; the less, the higher."
    )
    lift_per_fall: Leaf = ratio(
        0.35, 0, 1.5, "Height added to a step down, early, per height of the step."
    )
    lift_over: Leaf = ratio(
        1.7, 0, 3, "Height added over what stands between the footholds, per height over both."
    )
    toes_up: Leaf = angle(
        0.1,
        0,
        0.6,
        "By how much less a foot points its toes down early in a step on uneven ground.",
    )
    toes_down: Leaf = angle(
        0.3, 0, 0.8, "By how much more a foot points its toes down late in a step on uneven ground."
    )
    toes_down_per_height: Leaf = parameter(
        0.9,
        0,
        3,
        "The same per metre that the ground rises, falls, or stands in the way.",
        unit="rad/m",
    )
    toes_first: Leaf = parameter(
        0.5,
        0,
        2,
        "By how much more a foot points its toes down as it lands, per height below the other.",
        unit="rad/m",
    )
    swing_as_animated: Leaf = switch(
        False, "Whether feet swing as animated, over uneven ground too; they still clear edges."
    )
    uneven_height: Leaf = constant(
        0.05, "Height of a step from which ground counts as uneven.", unit="m"
    )
    highest_step: Leaf = constant(
        0.3, "Height of a step up or down, beyond which a higher one adds no more.", unit="m"
    )
    highest_over: Leaf = constant(
        0.175, "Height over both footholds, from which a foot passes no further above.", unit="m"
    )

    def swing(
        self,
        inputs: Inputs,
        stride: Stride,
        step: Array,
        ahead: Array,
        over: Array,
        trust: Array,
        below: Array,
    ) -> Swing:
        """How much higher and more pitched than animated the feet are.

        Args:
            inputs: the frame.
            stride: where the feet are in it.
            step: by how much the next foothold is higher than the last, m, without the slope.
            ahead: by how much it is higher than other feet too, m.
            over: how far the ground on the way is over both, m.
            trust: 0..1, how far the next foothold is accepted.
            below: how far each foot's ground is below that of another foot, m.
        """
        x = stride.fraction
        rise, fall = self._height_of_step(step), self._height_of_step(-step)
        low_over = jnp.where(over < self.highest_over, over, self.highest_over)
        total = rise + fall + low_over
        total, uneven = vec.stacked_barrier(total, smoothstep(total / self.uneven_height))
        lift = uneven * (
            self.toe_clearance * bump(x, CLEAR)
            - self.held_lift * self._animated_lift(inputs) * bump(x, HELD)
        )
        ahead = jnp.where(ahead < rise, ahead, rise)
        low = 1.0 - vec.safe_divide(ahead, self.highest_step)
        high = self.lift_per_rise * (rise - ahead) + self.lift_ahead * ahead * low
        lift += high * bump(x, RISE)
        lift += self.lift_per_fall * fall * bump(x, FALL)
        lift += self.lift_over * low_over * bump(x, OVER) + (over - low_over) * arc(x)
        down = uneven * self.toes_down + self.toes_down_per_height * total
        # Only feet swing as people swing them.
        share = jnp.where(self.swing_as_animated, 0.0, trust) * inputs.bearing
        pitch = share * (uneven * self.toes_up * bump(x, TOES_UP) - down * bump(x, TOES_DOWN))
        first = jnp.where(self.swing_as_animated, 0.0, self.toes_first)
        pitch -= first * below * smoothstep(self._toe_angle(inputs) / ON_HEEL)
        lift, pitch = vec.stacked_barrier(share * lift, pitch)
        arm = animated_ankles(inputs.frame).pos - _balls(inputs)
        up = inputs.terrain.leg_up_ws
        turned = quat.rotate(pitch_rotation(inputs, pitch), arm)
        return Swing(lift + vec.dot(turned - arm, up), pitch)

    def _height_of_step(self, rise: Array) -> Array:
        """The height of a step that rises, m; 0 if it falls."""
        rise = jnp.where(rise > 0, rise, 0.0)
        return jnp.where(rise < self.highest_step, rise, self.highest_step)

    def _animated_lift(self, inputs: Inputs) -> Float[Array, " legs"]:
        """m, of the balls over a flat foot's."""
        level = Level.of(inputs)
        lift = level.height(_balls(inputs)) - self.ball_height
        return jnp.where(lift > 0, lift, 0.0)

    def _toe_angle(self, inputs: Inputs) -> Float[Array, " legs"]:
        """rad, by which the animation lifts the toes over the heel."""
        foot = quat.multiply(animated_ankles(inputs.frame).rot, inputs.rig.ankle_from_foot)
        ahead = quat.rotate(foot, vec.constant(FORWARD, foot[..., :3]))
        up = inputs.terrain.leg_up_ws
        return vec.safe_arctan2(vec.dot(ahead, up), vec.length(vec.reject(ahead, up)))

    def below_others(
        self, inputs: Inputs, height: Array, normal: Array, found: Array
    ) -> Float[Array, " legs"]:
        """How far each foot's ground is below that of the highest other foot, m.

        What the ground under both feet and between them rises by as a slope does not count, nor do
        legs that bear nothing.

        Args:
            inputs: the frame.
            height: of the ground under each ball, m.
            normal: of that ground.
            found: of that ground; where it is 0, as of absent legs, nothing is below or above.
        """
        balls = _balls(inputs)
        up = jnp.broadcast_to(inputs.terrain.leg_up_ws, balls.shape)
        rise = height - height[:, None]  # from the foot of a row to that of a column
        way = balls - balls[:, None]
        climbs = self.climb(normal, way, up), self.climb(normal[:, None], way, up[:, None])
        slope = least_rise(rise, *climbs)
        counts = (found > 0) & (found[:, None] > 0) & inputs.rig.present
        bears = jnp.broadcast_to(inputs.bearing, found.shape)
        below = jnp.where(counts & (rise - slope > 0), rise - slope, 0.0)
        return jnp.max(bears * bears[:, None] * below, axis=-1)

    def above_others(
        self, inputs: Inputs, next_height: Array, height: Array, found: Array
    ) -> Float[Array, " legs"]:
        """How far each next foothold is above the ground of all other feet, m.

        Args:
            inputs: the frame.
            next_height: of the next foothold, m.
            height: of the ground under each ball, m.
            found: of that ground; where it is 0, as of absent legs, a foot is above it.
        """
        others = ~jnp.eye(len(height), dtype=bool) & (found > 0) & inputs.rig.present
        highest = jnp.max(jnp.where(others, height, -FAR), axis=-1)
        return jnp.where(next_height > highest, next_height - highest, 0.0)

    def highest(self, inputs: Inputs, heights: Array, found: Array) -> Float[Array, " legs"]:
        """The highest of heights of the ground on the way (points legs), m; 0 if all are below.

        What is higher than a foot can step up does not count.
        """
        counts = 1.0 - smoothstep((heights - self.max_step_up) / self.step_fade)
        heights = jnp.where((found > 0) & (heights > 0), heights * counts, 0.0)
        return inputs.gate.maximum(jnp.moveaxis(heights, 0, -1), band=HEIGHT_BAND)

    def soles(self, inputs: Inputs, foot_height: Array) -> Array:
        """Animated heels, balls and toes' tips at sole height, (3 legs 3), m, world space."""
        ankle = animated_ankles(inputs.frame)
        foot = quat.multiply(ankle.rot, inputs.rig.ankle_from_foot)
        heel_ls = vec.stack(jnp.zeros_like(self.heel_length), -foot_height, -self.heel_length)
        heel = ankle.pos + quat.rotate(foot, heel_ls)
        ball = _balls(inputs) - vec.scale(inputs.terrain.leg_up_ws, self.ball_height)
        ahead = quat.rotate(foot, vec.constant(FORWARD, ball))
        return jnp.stack([heel, ball, ball + vec.scale(ahead, self.toe_length)])

    def clearance_over_edges(
        self, inputs: Inputs, stride: Stride, swing: Swing, foot_height: Array, edge: Array
    ) -> Float[Array, " legs"]:
        """How much higher each foot goes to clear what lies between its footholds, m.

        As in one arc over the highest edge, where the foot is not lifted so high already.

        Args:
            inputs: the frame.
            stride: where the feet are in it.
            swing: what it adds to the animation.
            foot_height: of the ankles over the soles, m.
            edge: how far the highest edge is over the line between the footholds, m.
        """
        level = Level.of(inputs)
        soles, ankle = self.soles(inputs, foot_height), animated_ankles(inputs.frame).pos
        # A sole that the animation sinks into its own floor needs no correction.
        lift = level.height(soles) - self.clearance
        lift = jnp.where(lift > 0, lift, 0.0) + swing.lift
        pitched = ankle + quat.rotate(pitch_rotation(inputs, swing.pitch), soles - ankle)
        lift += level.height(pitched) - level.height(soles)
        lowest = inputs.gate.minimum(jnp.moveaxis(lift, 0, -1), band=HEIGHT_BAND)
        least = edge * arc(stride.fraction)
        gap, blend = least - lowest, BLEND * least
        return 0.5 * (gap + vec.safe_sqrt(gap * gap + blend * blend))


def s_curve(fraction: Array, steepness: Array) -> Array:
    """Curve from 0 to 1 with slope `steepness` in the middle: `1 / (1 + (1/x - 1)^k)`."""
    inside = (fraction > FIRST) & (fraction < 1)
    x = jnp.where(inside, fraction, 0.5)
    # Beyond e^80 odds are infinite in 32 bits, and their derivative is not a number.
    odds = jnp.exp(jnp.minimum(steepness * (jnp.log1p(-x) - jnp.log(x)), 80.0))
    return jnp.where(inside, 1.0 / (1.0 + odds), jnp.where(fraction < 0.5, 0.0, 1.0))


def bump(fraction: Array, peak: float) -> Array:
    """A bump over 0..1 whose top, 1, is at `peak`, and which leaves both ends without a kink."""
    inside = (fraction > 0) & (fraction < 1)
    x = jnp.where(inside, fraction, 0.5)
    log = peak * jnp.log(x / peak) + (1.0 - peak) * jnp.log((1.0 - x) / (1.0 - peak))
    return jnp.where(inside, jnp.exp(SHARPNESS * log), 0.0)


def arc(fraction: Array) -> Array:
    """A wide arc over 0..1, whose top, 1, is in the middle."""
    return 0.5 * (1.0 - jnp.cos(2.0 * jnp.pi * fraction))


def pitch_rotation(inputs: Inputs, pitch: Array) -> Float[Array, "legs 4"]:
    """The rotation that lifts the toes of each foot by an angle, rad, world space."""
    return quat.from_axis_angle(foot_heading(inputs)[1], pitch)


def _balls(inputs: Inputs) -> Array:
    """The animated balls (legs), m, world space."""
    return inputs.frame.world_from_model.apply(inputs.frame.pose.toe.pos)
