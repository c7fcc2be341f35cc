"""The lean of the record: the whole body, in proportion to the slope."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import quat, smoothing
from jaxik.maths.parameter_tree import Leaf, constant, gain_per_tick, ratio, switch
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


class SlopeLean(AbstractLean):
    """Leans in proportion to the smoothed slope, with other rates while sliding (the record).

    The record calls this "undulation". The slope is that of the mean normal under the standing
    feet. A rate of 1 aligns the body with the normal, a negative rate leans it into the hill. The
    slope is smoothed before rates apply, so that the smoothed normal is available to the pelvis;
    with `spring` on by a critically damped spring with the half-lives of the same gains.
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
    gain: Leaf = gain_per_tick(0.19, "Part of the gap that the smoothed slope closes in each tick.")
    gain_slide: Leaf = gain_per_tick(
        0.294, "Part of the gap that the smoothed slope closes in each tick of a slide."
    )
    slide_on_gain: Leaf = gain_per_tick(
        0.226, "Part of the way into sliding rates covered in each tick as a slide begins."
    )
    slide_off_gain: Leaf = gain_per_tick(
        0.135, "Part of the way out of sliding rates covered in each tick as a slide ends."
    )
    spring: Leaf = switch(False, "Whether the slope is smoothed by a critically damped spring.")
    tick_hz: Leaf = constant(30, "Ticks per second that the gains refer to.", unit="Hz")

    def init(self, rig: Rig) -> LeanState:
        return LeanState.level(rig)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        return standing_slope(inputs, ground, contact, weight)

    def advance(self, now: SensedMoment, state: LeanState) -> tuple[LeanState, Lean]:
        gate, dt, slide = now.gate, now.dt, now.sensed.slide
        entering = gate.above(slide - state.slide, jnp.zeros_like(slide), band=0.1)
        slide_gain = gate.choose(entering, self.slide_on_gain, self.slide_off_gain)
        slide_fraction = smoothing.fraction_of_gain(slide_gain, dt, self.tick_hz)
        sliding = smoothing.lerp(state.slide, slide, now.progress(slide_fraction))

        gain = smoothing.lerp(self.gain, self.gain_slide, sliding)
        fraction = now.progress(smoothing.fraction_of_gain(gain, dt, self.tick_hz))
        after = follow_slope(now, state, sliding, fraction, self.spring)

        forward_rate = smoothing.lerp(self.forward_rate, self.forward_rate_slide, sliding)
        side_rate = smoothing.lerp(self.side_rate, self.side_rate_slide, sliding)
        rotvec = lean_rotvec(now.sensed.slope, after.forward * forward_rate, after.side * side_rate)
        return after, Lean(quat.from_rotvec(rotvec), ground_normal(now, after))
