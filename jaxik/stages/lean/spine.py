"""The lean of people: the spine bends into the hill, and the head stays level."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import quat, smoothing
from jaxik.maths.parameter_tree import Leaf, half_life_parameter, parameter, switch
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


class SpineLean(AbstractLean):
    """Bends the base of the spine on slopes, differently uphill and downhill; legs stay.

    The spine turns by `rate * slope`, forward and sideways, where `slope` is the smoothed angle of
    the mean normal under the standing feet, and the rate forward is `uphill_rate` where the ground
    rises ahead and `downhill_rate` where it falls. A rate of 1 aligns the trunk with the normal, a
    negative rate leans it into the hill. The head turns back by `head_share` of the spine's turn,
    so that the gaze stays level. Nothing but trunk and head moves: apply `Corrections.spine` and
    `Corrections.head`.

    People lean forward uphill and backward downhill (Leroux, Fung and Barbeau 2002). The default
    rates were measured on a person who walked up and down blocks (CMU subject 03, trial 03): the
    trunk leaned by 0.12 of the path's slope uphill and 0.26 downhill, the head by a third of that.
    """

    uphill_rate: Leaf = parameter(
        -0.12,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean of the spine per slope where the ground rises ahead; below 0 into the hill.",
    )
    downhill_rate: Leaf = parameter(
        -0.26,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean of the spine per slope where the ground falls ahead; below 0 into the hill.",
    )
    side_rate: Leaf = parameter(
        0.0,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean of the spine sideways per slope aside; below 0 into the hill.",
    )
    forward_rate_slide: Leaf = parameter(
        0.0,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean of the spine per slope ahead while the character slides.",
    )
    side_rate_slide: Leaf = parameter(
        0.0,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean of the spine sideways per slope aside while the character slides.",
    )
    head_share: Leaf = parameter(
        0.65,
        unit="1",
        low=0.0,
        high=1.0,
        doc="Part of the lean of the spine that the head turns back; 1 keeps the gaze level.",
    )
    half_life: Leaf = half_life_parameter(
        0.2, doc="Time in which the lean covers half its way to that of a new slope."
    )
    spring: Leaf = switch(False, doc="Whether the slope is smoothed by a critically damped spring.")

    def init(self, rig: Rig) -> LeanState:
        return LeanState.level(rig)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        return standing_slope(inputs, ground, contact, weight)

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
        spine, head = (
            quat.from_rotvec(lean_rotvec(now.sensed.slope, part * forward, part * side))
            for part in (1.0, -self.head_share)
        )
        body = quat.identity(spine.dtype)
        return after, Lean(body, ground_normal(now, after), spine, head)
