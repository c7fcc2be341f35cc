"""Stage 4: where each foot would stand, with the ground's height smoothed over time."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import smoothing, vec
from jaxik.maths.gate import AbstractGate
from jaxik.maths.parameter_tree import Leaf, Rule, half_life_parameter, parameter, switch
from jaxik.maths.struct import struct
from jaxik.world.frame import Contact, Foothold, GroundHits, animated_ankles, foothold
from jaxik.world.skeleton import Rig

from .inputs import Inputs, SensedMoment

HEIGHT_BAND = 0.01  # m


class AbstractTarget(Rule):
    """Places footholds."""

    foot_height: eqx.AbstractVar[Array]  # m, sole to ankle

    @abstractmethod
    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame."""

    @abstractmethod
    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        """The foothold that this frame alone asks for."""

    @abstractmethod
    def advance(self, now: SensedMoment, state: PyTree) -> tuple[PyTree, Float[Array, " legs"]]:
        """How far along up each foothold is moved by memory and limits, m."""


class AbstractInstantTarget(AbstractTarget):
    """Places footholds by the present frame alone."""

    def init(self, rig: Rig) -> None:
        return None

    def advance(self, now: SensedMoment, state: None) -> tuple[None, Float[Array, " legs"]]:
        return None, jnp.zeros_like(now.sensed.foothold.height)


@struct
class TargetState:
    """Smoothed height of the ground under each foot."""

    height: Float[Array, " legs"]  # m, along up
    velocity: Float[Array, " legs"]  # m/s, of a spring


class SlopeTarget(AbstractTarget):
    """Keeps the animated lift over the ground and the sole exact on a slope.

    The ankle goes to `I + u (l + h (1/(n·u) - 1))` (ozz's construction with the animated lift `l`
    added): on a slope the ankle of a sole that lies flat is `h / (n·u)` above the hit. The height
    follows the ground with one half-life up and one down, as an exponential or, with `spring` on,
    critically damped; the ankle stays between two heights in model space. Where no ground was found
    the foothold is the animation's own.
    """

    min_ankle_height: Leaf = parameter(
        -0.30, unit="m", low=-1.0, high=0.5, doc="Lowest height of the ankle in model space."
    )
    max_ankle_height: Leaf = parameter(
        0.55, unit="m", low=0.0, high=1.5, doc="Highest height of the ankle in model space."
    )
    foot_height: Leaf = parameter(
        0.08, unit="m", low=0.0, high=0.2, doc="Height of the ankle above the sole."
    )
    max_slope: Leaf = parameter(
        1.0471975512,
        unit="rad",
        low=0.1,
        high=1.5,
        doc="Steepest slope that is compensated; steeper ground counts as this steep.",
    )
    rise_half_life: Leaf = half_life_parameter(
        0.0, doc="Time in which a foothold covers half its way up to higher ground."
    )
    fall_half_life: Leaf = half_life_parameter(
        0.0, doc="Time in which a foothold covers half its way down to lower ground."
    )
    spring: Leaf = switch(
        False, doc="Whether footholds follow the ground as a critically damped spring."
    )

    def init(self, rig: Rig) -> TargetState:
        zero = jnp.zeros_like(rig.side)
        return TargetState(zero, zero)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        hit, up_ws = ground.ankle, inputs.terrain.leg_up_ws
        frame, gate = inputs.frame, inputs.gate
        over = slope_height(self.foot_height, self.max_slope, hit.normal, up_ws, gate)
        standing = hit.point + vec.scale(up_ws, over - self.foot_height)
        point_ws = gate.choose(
            hit.found[..., None], standing, _under(animated_ankles(frame).pos, up_ws, contact.lift)
        )
        return foothold(frame, up_ws, point_ws, contact.lift, hit.found)

    def advance(
        self, now: SensedMoment, state: TargetState
    ) -> tuple[TargetState, Float[Array, " legs"]]:
        foothold, gate, dt = now.sensed.foothold, now.gate, now.dt
        gap = foothold.height - state.height
        rising = gate.above(gap, jnp.zeros_like(gap), band=HEIGHT_BAND)
        share = gate.choose(
            rising,
            smoothing.fraction_of_half_life(self.rise_half_life, dt),
            smoothing.fraction_of_half_life(self.fall_half_life, dt),
        )
        height, velocity = smoothing.follow(
            smoothing.Motion(state.height, state.velocity),
            foothold.height,
            now.progress(share),
            dt,
            self.spring,
        )
        rise = height - foothold.height
        ankle = foothold.ankle_height_ms + rise * foothold.climb
        kept = gate.clip(ankle, self.min_ankle_height, self.max_ankle_height, band=HEIGHT_BAND)
        return TargetState(height, velocity), rise + (kept - ankle)


class SoleTarget(AbstractInstantTarget):
    """The sole on the ground, whatever lift the animation has: `C = I + u h / (n·u)` (ozz).

    Where no ground was found the foothold is the animation's own.
    """

    foot_height: Leaf = parameter(
        0.12, unit="m", low=0.0, high=0.2, doc="Height of the ankle above the sole."
    )
    max_slope: Leaf = parameter(
        1.5,
        unit="rad",
        low=0.1,
        high=1.5,
        doc="Steepest slope that is compensated; steeper ground counts as this steep.",
    )

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        frame, gate, up_ws = inputs.frame, inputs.gate, inputs.terrain.leg_up_ws
        hit = ground.ankle
        lift = slope_height(self.foot_height, self.max_slope, hit.normal, up_ws, gate)
        bare = _under(animated_ankles(frame).pos, up_ws, lift)
        point_ws = gate.choose(hit.found[..., None], hit.point, bare)
        return foothold(frame, up_ws, point_ws, lift, hit.found)


class ContactTarget(AbstractInstantTarget):
    """The ankle `foot_height` over the ground along up, on slopes too: `I + u h` (Mec).

    Where no ground was found the foothold is the animation's own.
    """

    foot_height: Leaf = parameter(
        0.10,
        unit="m",
        low=0.0,
        high=0.2,
        doc="Height of the ankle above the ground, on slopes too.",
    )

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        frame, gate, up_ws = inputs.frame, inputs.gate, inputs.terrain.leg_up_ws
        hit = ground.ankle
        lift = jnp.broadcast_to(self.foot_height, hit.found.shape)
        bare = _under(animated_ankles(frame).pos, up_ws, lift)
        point_ws = gate.choose(hit.found[..., None], hit.point, bare)
        return foothold(frame, up_ws, point_ws, lift, hit.found)


class RootTarget(AbstractInstantTarget):
    """Moves a standing foot by the ground's height over the root, and `adjust` (Unreal, seed 001).

    The animated height over the root is kept, so that what is found is how far the ground lies
    above or below the one the animation was made for. A foot that sees no ground, or does not
    stand, stays where it is.
    """

    adjust: Leaf = parameter(
        0.0, unit="m", low=-0.1, high=0.1, doc="Height added to every foot that stands."
    )

    @property
    def foot_height(self) -> Array:
        """0: heights are those of ankles."""
        return jnp.zeros_like(self.adjust)

    def sense(self, inputs: Inputs, ground: GroundHits, contact: Contact) -> Foothold:
        frame, gate, up_ws = inputs.frame, inputs.gate, inputs.terrain.leg_up_ws
        hit, ankle_ws = ground.ankle, animated_ankles(frame).pos
        over_root = vec.dot(ankle_ws - frame.world_from_model.pos, up_ws)
        standing = contact.weight * hit.found
        lift = over_root + standing * self.adjust
        bare = _under(ankle_ws, up_ws, over_root)
        point_ws = gate.choose(standing[..., None], hit.point, bare)
        return foothold(frame, up_ws, point_ws, lift, hit.found)


def slope_height(
    foot_height: Array, max_slope: Array, normal: Array, up_ws: Array, gate: AbstractGate
) -> Array:
    """Height, m, along up of the ankle of a sole that lies flat on this slope: `h / (n·u)`.

    Slopes steeper than `max_slope`, rad, count as that. Equal to ozz's construction with similar
    triangles.
    """
    steepest = jnp.cos(max_slope)
    cosine = gate.clip(vec.dot(normal, up_ws), steepest, jnp.ones_like(steepest), band=0.01)
    return foot_height / cosine


def _under(ankle_ws: Array, up_ws: Array, lift: Array) -> Array:
    """The foothold of an animated ankle."""
    return ankle_ws - vec.scale(up_ws, lift)
