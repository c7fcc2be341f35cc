"""Stage 1: which feet of the animation stand."""

from abc import abstractmethod
from math import inf

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import smoothing, vec
from jaxik.maths.parameter_tree import Leaf, Rule, half_life, length, threshold
from jaxik.maths.struct import struct
from jaxik.world.frame import Contact
from jaxik.world.skeleton import Rig

from .inputs import Inputs, Moment

HEIGHT_BAND = 0.01  # m, width of softened height decisions
SPEED_BAND = 0.05  # m/s, width of softened speed decisions


class AbstractContact(Rule):
    """Decides from the animation which feet stand."""

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def sense(self, inputs: Inputs) -> Contact:
        """Lift and contact of each foot from this frame alone."""

    def advance(self, now: Moment, contact: Contact, state: PyTree) -> tuple[PyTree, Contact]:
        """Memory after this frame, and the contact that it and `contact` give."""
        return None, contact


class HeightContact(AbstractContact):
    """Contact by ankle height: 1 up to `planted_height`, 0 from `raised_height`, linear between.

    A limb that bears nothing, such as a hand on a wall, stands at any height.
    """

    ground_height: Leaf = length(0, -0.5, 0.5, "Height of the animation's floor in model space.")
    planted_height: Leaf = threshold(
        0.1,
        0,
        0.4,
        "Ankle height over the floor below which a foot counts as planted.",
        unit="m",
        follows="over ankle height",
    )
    raised_height: Leaf = threshold(
        0.16,
        0,
        0.6,
        "Ankle height over the floor above which a foot counts as lifted.",
        unit="m",
        follows="over ankle height",
        above="planted_height",
    )

    def sense(self, inputs: Inputs) -> Contact:
        gate = inputs.gate
        lift = inputs.frame.pose.ankle.pos[..., 1] - self.ground_height
        planted = gate.below(lift, self.planted_height, band=HEIGHT_BAND)
        lifted = gate.above(lift, self.raised_height, band=HEIGHT_BAND)
        span = self.raised_height - self.planted_height
        fraction = vec.safe_divide(self.raised_height - lift, span)
        zeros, ones = jnp.zeros_like(lift), jnp.ones_like(lift)
        ramp = gate.clip(fraction, zeros, ones, band=0.1)
        weight = jnp.where(span > 0, ramp, planted)
        return Contact(
            lift,
            _at_any_height(inputs, weight),
            _at_any_height(inputs, planted),
            lifted * inputs.bearing,
        )


class StandingContact(AbstractContact):
    """All feet stand, so that foot IK works wherever there is ground (ozz, Mec).

    With a finite `idle_speed` they stand while the character stands still only (Unreal).
    """

    idle_speed: Leaf = threshold(
        inf, 0, 3, "Speed of the character up to which its feet stand.", unit="m/s"
    )

    def sense(self, inputs: Inputs) -> Contact:
        lift = inputs.frame.pose.ankle.pos[..., 1]
        idle = inputs.gate.below(inputs.frame.speed, self.idle_speed, band=SPEED_BAND)
        idle = jnp.broadcast_to(idle, lift.shape)
        return Contact(lift, idle, idle, 1.0 - idle)


class LabelContact(AbstractContact):
    """Contact from the labels that come with the animation (`Stride.standing`)."""

    ground_height: Leaf = length(0, -0.5, 0.5, "Height of the animation's floor in model space.")

    def sense(self, inputs: Inputs) -> Contact:
        standing = inputs.frame.stride.standing
        lift = inputs.frame.pose.ankle.pos[..., 1] - self.ground_height
        return Contact(lift, standing, standing, 1.0 - standing)


@struct
class SpeedState:
    """Contact after a frame."""

    standing: Float[Array, " legs"]
    """0 or 1."""
    weight: Float[Array, " legs"]
    """0..1, smoothed `standing`."""


class SpeedContact(AbstractContact):
    """Contact by height and speed of the ball of the foot, with hysteresis.

    A foot starts to stand when its ball is both low and slow. It stops when its ball is either high
    or fast, by larger thresholds, so that a foot near a threshold does not flicker. Gait
    laboratories detect contact in this way (foot velocity algorithm, O'Connor et al. 2007, there
    with the centre of the foot). The ball of a standing foot is slower than 0.25 m/s; that of a
    swinging foot rarely is. A limb that bears nothing, such as a hand on a wall, only needs to be
    slow.
    """

    ground_height: Leaf = length(0, -0.5, 0.5, "Height of the animation's floor in model space.")
    planted_height: Leaf = threshold(
        0.075,
        0,
        0.4,
        "A swinging foot can plant once its ball is below this height.",
        unit="m",
        follows="over ball height",
    )
    raised_height: Leaf = threshold(
        0.1,
        0,
        0.6,
        "A planted foot lifts once its ball is above this height.",
        unit="m",
        follows="over ball height",
        above="planted_height",
    )
    planted_speed: Leaf = threshold(
        0.25, 0, 1.5, "A swinging foot can plant once its ball is slower than this.", unit="m/s"
    )
    raised_speed: Leaf = threshold(
        0.5,
        0,
        3,
        "A planted foot lifts once its ball is faster than this.",
        unit="m/s",
        above="planted_speed",
    )
    half_life: Leaf = half_life(
        0, "Time in which the contact weight covers half its way after a change."
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
        not_raised = gate.below(height, self.raised_height, band=HEIGHT_BAND)
        not_fast = gate.below(speed, self.raised_speed, band=SPEED_BAND)
        low, not_raised = (_at_any_height(inputs, x) for x in (low, not_raised))
        planted = low * slow
        return Contact(lift, planted, planted, 1.0 - not_raised * not_fast)

    def advance(
        self, now: Moment, contact: Contact, state: SpeedState
    ) -> tuple[SpeedState, Contact]:
        gate = now.gate
        before = jnp.where(now.started, state.standing, contact.planted)
        ones, zeros = jnp.ones_like(before), jnp.zeros_like(before)
        standing = gate.choose(contact.planted, ones, before)
        standing = gate.choose(contact.lifted, zeros, standing)
        fraction = now.progress(smoothing.fraction_of_half_life(self.half_life, now.dt))
        weight = smoothing.lerp(state.weight, standing, fraction)
        return SpeedState(standing, weight), Contact(contact.lift, weight, standing, 1.0 - standing)


def _at_any_height(inputs: Inputs, low: Array) -> Float[Array, " legs"]:
    """0..1, how far legs count as low: by their heights as far as they bear the body."""
    return smoothing.lerp(low, jnp.ones_like(low), 1.0 - inputs.bearing)
