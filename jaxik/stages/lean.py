"""Stage 6: how the body leans on slopes.

`SlopeLean`, that of the record, tilts the whole body; `SpineLean`, that of people, leans pelvis and
spine into the hill and keeps the head level. To write a rule, start with `AbstractLean`.
"""

import dataclasses
from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.gate import HARD
from jaxik.maths.parameter_tree import Leaf, Rule, half_life, length, ratio, switch
from jaxik.maths.struct import struct
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.world.frame import Contact, GroundHits, Slope, heading
from jaxik.world.skeleton import Rig

SLOPE_BAND = 0.05  # rad
LITTLE = 0.1  # of a foot's ground, from which its slope counts in full


@struct
class Lean:
    """How the body leans."""

    rot_ws: Float[Array, "4"]
    """Rotation of the body about its pivot, world axes."""
    normal_ws: Float[Array, "3"]
    """Unit, the smoothed ground normal."""
    spine_ws: Float[Array, "4"] | None = None
    """Rotation of the spine about its base, after the body's, world axes; None if there is none."""
    head_ws: Float[Array, "4"] | None = None
    """Rotation of the head about its joint, after the spine's, likewise."""


class AbstractLean(Rule):
    """Leans the body on slopes."""

    per_leg: ClassVar[bool] = False

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        """The slope under the feet from this frame alone; `weight` (0..1) is that of each leg."""

    @abstractmethod
    def advance(self, now: SensedMoment, state: PyTree) -> tuple[PyTree, Lean]:
        """Memory after this frame, and the lean."""


class NoLean(AbstractLean):
    """The body does not lean."""

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        frame = inputs.frame
        level = jnp.zeros_like(frame.dt)
        return Slope(level, level, *heading(frame.world_from_model, inputs.terrain.up_ws))

    def advance(self, now: SensedMoment, state: None) -> tuple[None, Lean]:
        up_ws = now.sensed.up_ws
        return None, Lean(quat.identity(up_ws.dtype), up_ws)


@struct
class LeanState:
    """Smoothed slope and sliding weight."""

    forward: Float[Array, ""]
    """Radians."""
    side: Float[Array, ""]
    """Radians."""
    slide: Float[Array, ""]
    """0..1, smoothed `Frame.slide`."""
    forward_speed: Float[Array, ""]
    """rad/s; 0 unless it follows as a spring."""
    side_speed: Float[Array, ""]
    """rad/s, likewise."""

    @classmethod
    def level(cls, rig: Rig) -> "LeanState":
        """Level ground, not sliding."""
        zero = jnp.zeros((), rig.side.dtype)
        return cls(zero, zero, zero, zero, zero)


def standing_slope(inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
    """The slope of the mean normal under the standing feet; level where none stands."""
    up_ws = inputs.terrain.up_ws
    forward_ws, right_ws = heading(inputs.frame.world_from_model, up_ws)
    stands = jnp.where(inputs.rig.present, contact.weight * ground.ankle.found, 0.0)
    stands = stands * inputs.bearing
    standing = stands * weight
    normal = vec.sum_vectors(vec.scale(ground.ankle.normal, standing))
    total = vec.sum_last(standing)
    normal = vec.scale(normal, vec.safe_divide(jnp.ones_like(total), total))
    most = HARD.maximum(stands, band=0.0)
    # Not as soon as a leg that stands has any weight at all.
    normal = smoothing.lerp(up_ws, normal, smoothing.clip_to_one(vec.safe_divide(total, most)))
    up = vec.dot(normal, up_ws)
    return Slope(
        vec.safe_arctan2(-vec.dot(normal, forward_ws), up),
        vec.safe_arctan2(-vec.dot(normal, right_ws), up),
        forward_ws,
        right_ws,
    )


def follow_slope(
    now: SensedMoment, state: LeanState, sliding: Array, fraction: Array, spring: Array
) -> LeanState:
    """Memory after the slope was followed by `fraction`, 0..1, of the gap, or as a spring."""
    slope, dt = now.sensed.slope, now.dt
    forward, forward_speed = smoothing.follow(
        smoothing.Motion(state.forward, state.forward_speed), slope.forward, fraction, dt, spring
    )
    side, side_speed = smoothing.follow(
        smoothing.Motion(state.side, state.side_speed), slope.side, fraction, dt, spring
    )
    return LeanState(forward, side, sliding, forward_speed, side_speed)


def lean_rotvec(slope: Slope, forward: Array, side: Array) -> Float[Array, "3"]:
    """Rotation vector, world axes, of a lean with the ground's rise ahead and to the right, rad."""
    return vec.scale(slope.right_ws, forward) - vec.scale(slope.forward_ws, side)


def ground_normal(now: SensedMoment, state: LeanState) -> Float[Array, "3"]:
    """Unit normal of ground with the smoothed slope."""
    return _normal(now.sensed.slope, now.sensed.up_ws, state.forward, state.side)


@vec.remat
def _normal(slope: Slope, up_ws: Array, forward: Array, side: Array) -> Array:
    """Unit normal of ground that rises by these angles ahead and to the right, rad."""
    forward_cos, forward_sin, side_cos, side_sin = vec.stacked_barrier(
        *vec.cos_sin(forward), *vec.cos_sin(side)
    )
    ahead = vec.scale(slope.forward_ws, forward_sin * side_cos)
    aside = vec.scale(slope.right_ws, forward_cos * side_sin)
    return vec.normalize(vec.scale(up_ws, forward_cos * side_cos) - ahead - aside, up_ws)


class SlopeLean(AbstractLean):
    """Leans in proportion to the smoothed slope, with other rates while sliding (the record).

    The record calls this "undulation". The slope is that of the mean normal under the standing
    feet. A rate of 1 aligns the body with the normal, a negative rate leans it into the hill. The
    slope is smoothed before rates apply, so that the smoothed normal is available to the pelvis;
    with `spring` on by a critically damped spring with the same half-lives.
    """

    forward_rate: Leaf = ratio(
        -0.3,
        -1,
        1,
        "Lean forward per slope ahead; 1 is square to the ground, below 0 into the hill.",
    )
    side_rate: Leaf = ratio(
        -0.1,
        -1,
        1,
        "Lean sideways per slope aside; 1 is square to the ground, below 0 into the hill.",
    )
    forward_rate_slide: Leaf = ratio(
        0.8, -1, 1, "Lean forward per slope ahead while the character slides."
    )
    side_rate_slide: Leaf = ratio(
        0.6, -1, 1, "Lean sideways per slope aside while the character slides."
    )
    half_life_slide: Leaf = half_life(
        0.06637, "Time in which the smoothed slope covers half its way during a slide."
    )
    slide_on_half_life: Leaf = half_life(
        0.09019, "Time to half of the sliding rates as a slide begins."
    )
    slide_off_half_life: Leaf = half_life(
        0.1593, "Time to half of the usual rates as a slide ends."
    )
    half_life: Leaf = half_life(0.1096, "Time in which the smoothed slope covers half its way.")
    spring: Leaf = switch(False, "Whether the slope is smoothed by a critically damped spring.")

    def init(self, rig: Rig) -> LeanState:
        return LeanState.level(rig)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        return standing_slope(inputs, ground, contact, weight)

    def advance(self, now: SensedMoment, state: LeanState) -> tuple[LeanState, Lean]:
        gate, dt, slide = now.gate, now.dt, now.sensed.slide
        entering = gate.above(slide - state.slide, jnp.zeros_like(slide), band=0.1)
        slide_fraction = gate.choose(
            entering,
            smoothing.fraction_of_half_life(self.slide_on_half_life, dt),
            smoothing.fraction_of_half_life(self.slide_off_half_life, dt),
        )
        sliding = smoothing.lerp(state.slide, slide, now.progress(slide_fraction))

        fraction = smoothing.lerp(
            smoothing.fraction_of_half_life(self.half_life, dt),
            smoothing.fraction_of_half_life(self.half_life_slide, dt),
            sliding,
        )
        after = follow_slope(now, state, sliding, now.progress(fraction), self.spring)

        forward_rate = smoothing.lerp(self.forward_rate, self.forward_rate_slide, sliding)
        side_rate = smoothing.lerp(self.side_rate, self.side_rate_slide, sliding)
        rotvec = lean_rotvec(now.sensed.slope, after.forward * forward_rate, after.side * side_rate)
        return after, Lean(quat.from_rotvec(rotvec), ground_normal(now, after))


class SpineLean(AbstractLean):
    """Leans pelvis and trunk on slopes, the trunk differently uphill and downhill; legs stay.

    The trunk turns by `rate * slope`, forward and sideways, where the rate forward is `uphill_rate`
    where the ground rises ahead and `downhill_rate` where it falls. A rate of 1 leans the trunk
    with the slope, square to the ground, a negative rate leans it into the hill. The head turns
    back by `head_share` of the trunk's turn, so that the gaze stays level. The pelvis tilts about
    the hips at rates of its own, `pelvis_rate` and `pelvis_side_rate`, in which the trunk does not
    take part. Apply `Corrections.spine` and `Corrections.head`, or all of it tilts.

    The slope, ahead as aside, is the tangent m with the least `v (m - c / v)² + (spacing / 2)²
    (m - n)²`: n is the tangent from the mean normal under the standing feet, c and v are covariance
    and variance of the height of the ground under all feet and their place ahead or aside. On
    stairs, which are level under each foot, it thus is the slope from foot to foot.

    People lean forward uphill and backward downhill (Leroux, Fung and Barbeau 2002). The defaults
    were measured on a person who walked up and down blocks (CMU subject 03, trial 03): there the
    rule explains 61 % of the variance of the trunk's pitch, with like rates in both halves of 38 s,
    but nothing of it in the few steps of trial 01. The head went with half of the trunk's lean.
    Where the animated pelvis knew the phase of the gait alone, the rule brought its pitch from 3.3
    to 2.7° and from 3.6 to 3.2° of the captured (rms) in the halves of that walk
    (`tests/phase_pelvis`). Its roll it does not explain.
    """

    uphill_rate: Leaf = ratio(
        -0.65,
        -1,
        1,
        "Lean of the trunk per slope where the ground rises ahead; below 0 into the hill.",
    )
    downhill_rate: Leaf = ratio(
        -0.25,
        -1,
        1,
        "Lean of the trunk per slope where the ground falls ahead; below 0 into the hill.",
    )
    side_rate: Leaf = ratio(
        0, -1, 1, "Lean of the trunk sideways per slope aside; below 0 into the hill."
    )
    forward_rate_slide: Leaf = ratio(
        0, -1, 1, "Lean of the trunk per slope ahead while the character slides."
    )
    side_rate_slide: Leaf = ratio(
        0, -1, 1, "Lean of the trunk sideways per slope aside while the character slides."
    )
    head_share: Leaf = ratio(
        0.5, 0, 1, "Part of the lean of the trunk that the head turns back; 1 keeps the gaze level."
    )
    pelvis_rate: Leaf = ratio(
        -0.25, -1, 1, "Tilt of the pelvis forward per slope ahead; below 0 into the hill."
    )
    pelvis_side_rate: Leaf = ratio(
        0, -1, 1, "Tilt of the pelvis sideways per slope aside; below 0 into the hill."
    )
    spacing: Leaf = length(
        0.3,
        0.05,
        2,
        "Distance between feet at which the slope between them counts as that of their soles.",
        scale="log",
    )
    half_life: Leaf = half_life(
        0.2, "Time in which the lean covers half its way to that of a new slope."
    )
    spring: Leaf = switch(False, "Whether the slope is smoothed by a critically damped spring.")

    def init(self, rig: Rig) -> LeanState:
        return LeanState.level(rig)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        soles = standing_slope(inputs, ground, contact, weight)
        load = weight * inputs.bearing
        found = jnp.where(inputs.rig.present, ground.ankle.found * inputs.bearing, 0.0)
        sure = _known(contact.weight * found)
        # A line takes two legs: with one of hardly any load, it hardly counts.
        total = vec.sum_last(load)
        pairs = 0.5 * (total * total - vec.sum_last(load * load))
        known = _known(found) * smoothing.clip_to_one(pairs)
        weight = weight * found
        weight = vec.safe_divide(weight, vec.sum_last(weight))
        points = ground.ankle.point - inputs.frame.world_from_model.pos
        height = self._about_mean(points, inputs.terrain.up_ws, weight)

        def between_feet(along_ws: Array, slope: Array) -> Array:
            place = self._about_mean(points, along_ws, weight)
            variance, covariance = (vec.sum_last(weight * place * x) for x in (place, height))
            variance, covariance = known * variance, known * covariance
            prior = (0.5 * self.spacing) ** 2
            cos, sin = vec.cos_sin(sure * slope)
            return vec.safe_arctan2(covariance * cos + prior * sin, (variance + prior) * cos)

        forward = between_feet(soles.forward_ws, soles.forward)
        side = between_feet(soles.right_ws, soles.side)
        return dataclasses.replace(soles, forward=forward, side=side)

    def _about_mean(self, points: Array, along: Array, weight: Array) -> Float[Array, " legs"]:
        """Places of points along a direction, m, from their weighted mean."""
        place = vec.dot(points, along)
        return place - vec.sum_last(weight * place)

    def advance(self, now: SensedMoment, state: LeanState) -> tuple[LeanState, Lean]:
        fraction = now.progress(smoothing.fraction_of_half_life(self.half_life, now.dt))
        sliding = smoothing.lerp(state.slide, now.sensed.slide, fraction)
        after = follow_slope(now, state, sliding, fraction, self.spring)

        zero = jnp.zeros_like(after.forward)
        rises = now.gate.above(after.forward, zero, band=SLOPE_BAND)
        forward_rate = now.gate.choose(rises, self.uphill_rate, self.downhill_rate)
        forward_rate = smoothing.lerp(forward_rate, self.forward_rate_slide, sliding)
        side_rate = smoothing.lerp(self.side_rate, self.side_rate_slide, sliding)
        forward, side = after.forward * forward_rate, after.side * side_rate
        upright = 1.0 - sliding
        tilt = upright * self.pelvis_rate, upright * self.pelvis_side_rate
        trunk, head, pelvis = (
            quat.from_rotvec(lean_rotvec(now.sensed.slope, *angles))
            for angles in (
                (forward, side),
                (-self.head_share * forward, -self.head_share * side),
                (tilt[0] * after.forward, tilt[1] * after.side),
            )
        )
        spine = quat.multiply(trunk, quat.conjugate(pelvis))
        return after, Lean(pelvis, ground_normal(now, after), spine, head)


def _known(ground: Array) -> Float[Array, ""]:
    """0..1, whether there is ground under feet: all of it as soon as there is a little."""
    return smoothing.clip_to_one(vec.sum_last(ground) / LITTLE)
