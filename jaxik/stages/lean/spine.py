"""The lean of people: pelvis and spine lean into the hill, and the head stays level."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import Leaf, half_life, length, ratio, switch
from jaxik.stages.inputs import Inputs, SensedMoment
from jaxik.world.frame import Contact, GroundHits, Slope
from jaxik.world.skeleton import Rig

from .base import (
    AbstractLean,
    Lean,
    LeanState,
    follow_slope,
    ground_normal,
    lean_rotvec,
    standing_slope,
)

SLOPE_BAND = 0.05  # rad
LITTLE = 0.1  # of a foot's ground, from which its slope counts in full


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
