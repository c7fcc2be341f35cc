"""Stage 1: how far each foot of the animation stands."""

from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import smoothing, vec
from jaxik.maths.parameter_tree import Leaf, Rule, half_life_parameter, parameter
from jaxik.maths.struct import struct
from jaxik.world.frame import Contact
from jaxik.world.skeleton import Rig

from .inputs import Inputs, Moment

HEIGHT_BAND = 0.01  # m over which a softened height decision turns
SPEED_BAND = 0.05  # m/s, likewise


class AbstractContact(Rule):
    """Reads contact from the animation."""

    @abstractmethod
    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame."""

    @abstractmethod
    def sense(self, inputs: Inputs) -> Contact:
        """Lift and contact of each foot as this frame alone shows them."""

    @abstractmethod
    def advance(self, now: Moment, contact: Contact, state: PyTree) -> tuple[PyTree, Contact]:
        """Memory after this frame, and the contact with it."""


class AbstractInstantContact(AbstractContact):
    """Reads contact from the present frame alone."""

    def init(self, rig: Rig) -> None:
        return None

    def advance(self, now: Moment, contact: Contact, state: None) -> tuple[None, Contact]:
        return None, contact


class HeightContact(AbstractInstantContact):
    """By the ankle's height: 1 below `planted_height`, 0 above `raised_height`, linear between."""

    ground_height: Leaf = parameter(
        0.0, unit="m", low=-0.5, high=0.5, doc="Height of the animation's floor in model space."
    )
    planted_height: Leaf = parameter(
        0.10,
        unit="m",
        low=0.0,
        high=0.4,
        kind="threshold",
        doc="Ankle height over the floor below which a foot counts as planted.",
    )
    raised_height: Leaf = parameter(
        0.16,
        unit="m",
        low=0.0,
        high=0.6,
        kind="threshold",
        above="planted_height",
        doc="Ankle height over the floor above which a foot counts as lifted.",
    )

    def sense(self, inputs: Inputs) -> Contact:
        gate = inputs.gate
        lift = inputs.frame.pose.ankle.pos[..., 1] - self.ground_height
        planted = gate.below(lift, self.planted_height, band=HEIGHT_BAND)
        lifted = gate.above(lift, self.raised_height, band=HEIGHT_BAND)
        span = self.raised_height - self.planted_height
        share = vec.safe_divide(self.raised_height - lift, span)
        zero, one = jnp.zeros_like(lift), jnp.ones_like(lift)
        ramp = gate.clip(share, zero, one, band=0.1)
        return Contact(lift, jnp.where(span > 0, ramp, planted), planted, lifted)


class StandingContact(AbstractInstantContact):
    """Every foot always stands: where there is ground, foot IK works (ozz and Mec)."""

    def sense(self, inputs: Inputs) -> Contact:
        lift = inputs.frame.pose.ankle.pos[..., 1]
        one, zero = jnp.ones_like(lift), jnp.zeros_like(lift)
        return Contact(lift, one, one, zero)


class IdleContact(AbstractInstantContact):
    """All feet stand while the character does, none while it moves (Unreal, seed 001)."""

    idle_speed: Leaf = parameter(
        0.0,
        unit="m/s",
        low=0.0,
        high=3.0,
        kind="threshold",
        doc="Speed of the character up to which it counts as standing still.",
    )

    def sense(self, inputs: Inputs) -> Contact:
        lift = inputs.frame.pose.ankle.pos[..., 1]
        idle = inputs.gate.below(inputs.frame.speed, self.idle_speed, band=SPEED_BAND)
        idle = jnp.broadcast_to(idle, lift.shape)
        return Contact(lift, idle, idle, 1.0 - idle)


class LabelContact(AbstractInstantContact):
    """As the animation is labelled (`Stride.standing`): what its author or a capture says."""

    ground_height: Leaf = parameter(
        0.0, unit="m", low=-0.5, high=0.5, doc="Height of the animation's floor in model space."
    )

    def sense(self, inputs: Inputs) -> Contact:
        standing = inputs.frame.stride.standing
        lift = inputs.frame.pose.ankle.pos[..., 1] - self.ground_height
        return Contact(lift, standing, standing, 1.0 - standing)


@struct
class SpeedState:
    """Which feet stand."""

    standing: Float[Array, " legs"]  # 0 or 1
    weight: Float[Array, " legs"]  # 0..1, follows it


class SpeedContact(AbstractContact):
    """By speed and height of the ball, with hysteresis.

    A foot begins to stand once its ball is both low and slow, and stops once it is either high or
    fast, by thresholds of their own: a foot on the border does not flicker. Gait labs find contact
    so (foot velocity algorithms; O'Connor et al. 2007 take the foot's centre). A standing foot's
    ball is slower than 0.25 m/s, a swinging one's hardly ever.
    """

    ground_height: Leaf = parameter(
        0.0, unit="m", low=-0.5, high=0.5, doc="Height of the animation's floor in model space."
    )
    planted_height: Leaf = parameter(
        0.075,
        unit="m",
        low=0.0,
        high=0.4,
        kind="threshold",
        doc="A swinging foot can plant once its ball is below this height.",
    )
    raised_height: Leaf = parameter(
        0.10,
        unit="m",
        low=0.0,
        high=0.6,
        kind="threshold",
        above="planted_height",
        doc="A planted foot lifts once its ball is above this height.",
    )
    planted_speed: Leaf = parameter(
        0.25,
        unit="m/s",
        low=0.0,
        high=1.5,
        kind="threshold",
        doc="A swinging foot can plant once its ball is slower than this.",
    )
    raised_speed: Leaf = parameter(
        0.50,
        unit="m/s",
        low=0.0,
        high=3.0,
        kind="threshold",
        above="planted_speed",
        doc="A planted foot lifts once its ball is faster than this.",
    )
    half_life: Leaf = half_life_parameter(
        0.0, doc="Time in which the contact weight covers half its way after a change."
    )

    def init(self, rig: Rig) -> SpeedState:
        zero = jnp.zeros_like(rig.side)
        return SpeedState(zero, zero)

    def sense(self, inputs: Inputs) -> Contact:
        frame, gate = inputs.frame, inputs.gate
        lift = frame.pose.ankle.pos[..., 1] - self.ground_height
        height, speed = frame.pose.toe.pos[..., 1] - self.ground_height, frame.toe_speed
        low = gate.below(height, self.planted_height, band=HEIGHT_BAND)
        slow = gate.below(speed, self.planted_speed, band=SPEED_BAND)
        lowish = gate.below(height, self.raised_height, band=HEIGHT_BAND)
        slowish = gate.below(speed, self.raised_speed, band=SPEED_BAND)
        planted = low * slow
        return Contact(lift, planted, planted, 1.0 - lowish * slowish)

    def advance(
        self, now: Moment, contact: Contact, state: SpeedState
    ) -> tuple[SpeedState, Contact]:
        gate = now.gate
        before = jnp.where(now.started, state.standing, contact.planted)
        one, zero = jnp.ones_like(before), jnp.zeros_like(before)
        standing = gate.choose(contact.planted, one, before)
        standing = gate.choose(contact.lifted, zero, standing)
        fraction = now.progress(smoothing.fraction_of_half_life(self.half_life, now.dt))
        weight = smoothing.lerp(state.weight, standing, fraction)
        return SpeedState(standing, weight), Contact(contact.lift, weight, standing, 1.0 - standing)
