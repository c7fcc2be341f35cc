"""The lean of the record: the whole body, in proportion to the slope."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxik.maths import quat, smoothing
from jaxik.maths.parameter_tree import Leaf, half_life, ratio, switch
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
