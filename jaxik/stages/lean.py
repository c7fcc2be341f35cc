"""Stage 5: how the body leans on slopes."""

from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import Leaf, Rule, constant, gain_parameter, parameter, switch
from jaxik.maths.struct import struct
from jaxik.world.frame import Contact, GroundHits, Slope, heading
from jaxik.world.skeleton import Rig

from .inputs import Inputs, SensedMoment


@struct
class Lean:
    """How the body leans."""

    rot_ws: Float[Array, "4"]
    """Rotation of the body about its pivot, world axes."""
    normal_ws: Float[Array, "3"]
    """Unit, the smoothed ground normal."""


class AbstractLean(Rule):
    """Leans the body on slopes."""

    per_leg: ClassVar[bool] = False

    @abstractmethod
    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame."""

    @abstractmethod
    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        """The slope under the feet from this frame alone; `weight` (0..1) is that of each leg."""

    @abstractmethod
    def advance(self, now: SensedMoment, state: PyTree) -> tuple[PyTree, Lean]:
        """Memory after this frame, and the lean."""


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


class SlopeLean(AbstractLean):
    """Leans in proportion to the smoothed slope, with other rates while sliding (the record).

    The record calls this "undulation". The slope is that of the mean normal under the standing
    feet. A rate of 1 aligns the body with the normal, a negative rate leans it into the hill. The
    slope is smoothed before rates apply, so that the smoothed normal is available to the pelvis;
    with `spring` on by a critically damped spring with the half-lives of the same gains.
    """

    forward_rate: Leaf = parameter(
        -0.30,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean forward per slope ahead; 1 is square to the ground, below 0 into the hill.",
    )
    side_rate: Leaf = parameter(
        -0.10,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean sideways per slope aside; 1 is square to the ground, below 0 into the hill.",
    )
    forward_rate_slide: Leaf = parameter(
        0.80,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean forward per slope ahead while the character slides.",
    )
    side_rate_slide: Leaf = parameter(
        0.60,
        unit="1",
        low=-1.0,
        high=1.0,
        doc="Lean sideways per slope aside while the character slides.",
    )
    gain: Leaf = gain_parameter(
        0.19, doc="Part of the gap that the smoothed slope closes in each tick."
    )
    gain_slide: Leaf = gain_parameter(
        0.294, doc="Part of the gap that the smoothed slope closes in each tick of a slide."
    )
    slide_on_gain: Leaf = gain_parameter(
        0.226, doc="Part of the way into sliding rates covered in each tick as a slide begins."
    )
    slide_off_gain: Leaf = gain_parameter(
        0.135, doc="Part of the way out of sliding rates covered in each tick as a slide ends."
    )
    spring: Leaf = switch(False, doc="Whether the slope is smoothed by a critically damped spring.")
    tick_hz: Leaf = constant(30.0, unit="Hz", doc="Ticks per second that the gains refer to.")

    def init(self, rig: Rig) -> LeanState:
        zero = jnp.zeros((), rig.side.dtype)
        return LeanState(zero, zero, zero, zero, zero)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        up_ws = inputs.terrain.up_ws
        forward_ws, right_ws = heading(inputs.frame.world_from_model, up_ws)
        standing = contact.weight * ground.ankle.found * weight
        normal = vec.sum_vectors(vec.scale(ground.ankle.normal, standing))
        normal = jnp.where(vec.sum_last(standing) > 0, normal, up_ws)
        up = vec.dot(normal, up_ws)
        return Slope(
            vec.safe_arctan2(-vec.dot(normal, forward_ws), up),
            vec.safe_arctan2(-vec.dot(normal, right_ws), up),
            forward_ws,
            right_ws,
        )

    def advance(self, now: SensedMoment, state: LeanState) -> tuple[LeanState, Lean]:
        gate, dt, slope, slide = now.gate, now.dt, now.sensed.slope, now.sensed.slide
        entering = gate.above(slide - state.slide, jnp.zeros_like(slide), band=0.1)
        slide_gain = gate.choose(entering, self.slide_on_gain, self.slide_off_gain)
        slide_fraction = smoothing.fraction_of_gain(slide_gain, dt, self.tick_hz)
        sliding = smoothing.lerp(state.slide, slide, now.progress(slide_fraction))

        gain = smoothing.lerp(self.gain, self.gain_slide, sliding)
        fraction = now.progress(smoothing.fraction_of_gain(gain, dt, self.tick_hz))
        forward, forward_speed = smoothing.follow(
            smoothing.Motion(state.forward, state.forward_speed),
            slope.forward,
            fraction,
            dt,
            self.spring,
        )
        side, side_speed = smoothing.follow(
            smoothing.Motion(state.side, state.side_speed), slope.side, fraction, dt, self.spring
        )

        lean_forward = forward * smoothing.lerp(self.forward_rate, self.forward_rate_slide, sliding)
        lean_side = side * smoothing.lerp(self.side_rate, self.side_rate_slide, sliding)
        rotvec = vec.scale(slope.right_ws, lean_forward) - vec.scale(slope.forward_ws, lean_side)
        lean = Lean(
            quat.from_rotvec(rotvec), _ground_normal(slope, now.sensed.up_ws, forward, side)
        )
        return LeanState(forward, side, sliding, forward_speed, side_speed), lean


class NoLean(AbstractLean):
    """The body does not lean."""

    def init(self, rig: Rig) -> None:
        return None

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact, weight: Array) -> Slope:
        frame = inputs.frame
        level = jnp.zeros_like(frame.dt)
        return Slope(level, level, *heading(frame.world_from_model, inputs.terrain.up_ws))

    def advance(self, now: SensedMoment, state: None) -> tuple[None, Lean]:
        up_ws = now.sensed.up_ws
        return None, Lean(quat.identity(up_ws.dtype), up_ws)


@vec.remat
def _ground_normal(slope: Slope, up_ws: Array, forward: Array, side: Array) -> Array:
    """Unit normal of ground that rises by these angles ahead and to the right, rad."""
    (forward_cos, forward_sin), (side_cos, side_sin) = vec.cos_sin(forward), vec.cos_sin(side)
    ahead = vec.scale(slope.forward_ws, forward_sin * side_cos)
    aside = vec.scale(slope.right_ws, forward_cos * side_sin)
    return vec.normalize(vec.scale(up_ws, forward_cos * side_cos) - ahead - aside, up_ws)
