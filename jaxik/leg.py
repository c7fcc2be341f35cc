"""Stage 7: two-bone legs that bring the ankles to their targets."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import quat, vec
from .gate import AbstractGate
from .rule import parameter
from .skeleton import LegPose, Rig, Transform

LENGTH_BAND = 0.005  # m
DOWN = (0.0, -1.0, 0.0)


class Bend(eqx.Module):
    """A solved leg."""

    pose: LegPose  # legs, model space; ankle and toe carried along
    hip: Float[Array, "legs 4"]  # correction, on the right of the hip's rotation
    knee: Float[Array, "legs 4"]  # correction, on the right of the knee's rotation
    reached: Float[Array, " legs"]  # 1 where the ankle is at its target, else 0


class AbstractLeg(eqx.Module):
    """Solves legs."""

    weight: eqx.AbstractVar[Array]  # 0..1, share of foot IK

    @abstractmethod
    def pose(
        self, rig: Rig, pose: LegPose, target_ms: Array, weight: Array, gate: AbstractGate
    ) -> Bend:
        """The leg with its ankle at `target_ms`, m."""


class TwoBone(AbstractLeg):
    """Turns the knee about its hinge until the ankle is as far as the target, then swings the hip.

    Exact for a hinge that is not square to the leg: distances are split along and across the hinge
    axis, and the triangle is closed across it. Half-angle algebra throughout (systems.md, 0, after
    ozz's two-bone job). Knee limits and softening act on the distance from hip to ankle, never on
    the angle: from `soften` times the longest reach the leg approaches that reach exponentially.

    Beyond reach the leg points at the target; with the target on the hip it keeps its direction; a
    leg with a zero bone, or lying along its hinge, does not bend.
    """

    max_knee_angle: Array = parameter(3.0000531803, unit="rad", low=2.0, high=3.1415926536)
    min_knee_angle: Array = parameter(0.6982008392, unit="rad", low=0.0, high=1.8)
    soften: Array = parameter(0.98, unit="1", low=0.8, high=1.0)
    twist: Array = parameter(0.0, unit="rad", low=-1.0, high=1.0)
    weight: Array = parameter(1.0, unit="1", low=0.0, high=1.0)

    def pose(
        self, rig: Rig, pose: LegPose, target_ms: Array, weight: Array, gate: AbstractGate
    ) -> Bend:
        to_hip = pose.hip.pos - pose.knee.pos
        to_ankle = pose.ankle.pos - pose.knee.pos
        to_target = target_ms - pose.hip.pos
        hinge = quat.rotate(pose.knee.rot, rig.knee_axis_ls)
        reach, reached = self._reach(to_hip, to_ankle, to_target, gate)

        half_cos, half_sin = hinge_turn(to_hip, to_ankle, hinge, reach)
        bent = quat.rotate(quat.from_half(hinge, half_cos, half_sin), to_ankle) - to_hip
        swing = swing_turn(bent, to_target, hinge, self.twist)

        still = quat.identity(target_ms.dtype)
        turn = quat.nlerp(still, quat.from_half(hinge, half_cos, half_sin), weight)
        swing = quat.nlerp(still, swing, weight)

        knee_pos = pose.hip.pos - quat.rotate(swing, to_hip)
        whole = quat.multiply(swing, turn)
        ankle_pos = knee_pos + quat.rotate(whole, to_ankle)
        ankle = Transform(ankle_pos, quat.multiply(whole, pose.ankle.rot))
        solved = LegPose(
            Transform(pose.hip.pos, quat.multiply(swing, pose.hip.rot)),
            Transform(knee_pos, quat.multiply(whole, pose.knee.rot)),
            ankle,
            Transform(
                ankle_pos + quat.rotate(whole, pose.toe.pos - pose.ankle.pos),
                quat.multiply(whole, pose.toe.rot),
            ),
        )
        return Bend(
            solved,
            local(pose.hip.rot, swing),
            local(pose.knee.rot, turn),
            reached * jnp.where(weight >= 1, 1.0, 0.0),
        )

    def _reach(
        self, to_hip: Array, to_ankle: Array, to_target: Array, gate: AbstractGate
    ) -> tuple[Array, Array]:
        """Distance from hip to ankle that the limits allow, m, and 1 where that is the target's."""
        thigh, shin = vec.length(to_hip), vec.length(to_ankle)
        longest = opposite_side(thigh, shin, jnp.cos(self.max_knee_angle))
        shortest = opposite_side(thigh, shin, jnp.cos(self.min_knee_angle))
        free = self.soften * longest
        distance = vec.length(to_target)
        allowed = gate.clip(
            soft_limit(distance, free, longest), shortest, longest, band=LENGTH_BAND
        )
        inside = gate.above(distance, shortest, band=LENGTH_BAND)
        return allowed, inside * gate.below(distance, free, band=LENGTH_BAND)


def local(rot: Array, turn: Array) -> Array:
    """The correction on the right of `rot` that does what `turn` does on its left."""
    return quat.multiply(quat.conjugate(rot), quat.multiply(turn, rot))


def opposite_side(a: Array, b: Array, cos: Array) -> Array:
    """Third side of the triangle with sides `a` and `b` and this cosine between them."""
    return vec.safe_sqrt(a * a + b * b - 2.0 * a * b * cos)


def soft_limit(x: Array, free: Array, limit: Array) -> Array:
    """`x` up to `free`; beyond, an exponential of slope 1 there that tends to `limit`."""
    room = limit - free
    roomy = room > 0
    over = x - free
    beyond = over > 0
    share = jnp.where(beyond, over, 0.0) / jnp.where(roomy, room, 1.0)
    return jnp.where(beyond, free - jnp.where(roomy, room * jnp.expm1(-share), 0.0), x)


def hinge_turn(to_hip: Array, to_ankle: Array, hinge: Array, reach: Array) -> tuple[Array, Array]:
    """Cosine and sine of half the knee's turn about `hinge` that takes hip and ankle `reach` apart.

    The interior angle is 0..pi after the turn, whatever side the leg was bent to before. Clamped to
    straight or folded where the triangle does not close; no turn where a side lies along the hinge.
    """
    along_thigh, along_shin = vec.dot(to_hip, hinge), vec.dot(to_ankle, hinge)
    thigh, shin = vec.reject(to_hip, hinge), vec.reject(to_ankle, hinge)
    a2, b2 = vec.dot(thigh, thigh), vec.dot(shin, shin)
    ab = vec.safe_sqrt(a2 * b2)
    bendable = ab > jnp.finfo(ab.dtype).eps
    ab = jnp.where(bendable, ab, 1.0)

    across2 = reach * reach - (along_thigh - along_shin) ** 2
    cosine = (a2 + b2 - across2) / (2.0 * ab)
    open_cos = vec.safe_sqrt(bounded((1.0 + cosine) * 0.5))
    open_sin = vec.safe_sqrt(bounded((1.0 - cosine) * 0.5))

    cos_now = vec.dot(thigh, shin) / ab
    sin_now = vec.dot(hinge, vec.cross(thigh, shin)) / ab
    norm = vec.length(jnp.stack([cos_now, sin_now, jnp.zeros_like(cos_now)], axis=-1))
    norm = jnp.where(norm > 0, norm, 1.0)
    now_cos, now_sin = quat.half_angle(cos_now / norm, sin_now / norm)
    turn_cos = open_cos * now_cos + open_sin * now_sin
    turn_sin = open_sin * now_cos - open_cos * now_sin
    return jnp.where(bendable, turn_cos, 1.0), jnp.where(bendable, turn_sin, 0.0)


def bounded(x: Array) -> Array:
    """`x` kept within 0..1, the cosines a triangle can have."""
    return jnp.where(x < 0, 0.0, jnp.where(x > 1, 1.0, x))


def swing_turn(bent: Array, to_target: Array, hinge: Array, twist: Array) -> Array:
    """Rotation of the hip that takes the ankle's direction to the target's and keeps the hinge.

    The shortest arc, then a turn about the target's direction that lines the hinge up with where it
    was, seen along that direction; then `twist`, rad, about it.
    """
    down = vec.constant(DOWN, bent)
    start = vec.unit(bent, down)
    aim = vec.unit(to_target, start)
    square = vec.unit(vec.reject(hinge, start), vec.reject(down, start))
    arc = quat.arc(start, aim, vec.unit(square, hinge))
    swung = vec.reject(quat.rotate(arc, hinge), aim)
    wanted = vec.reject(hinge, aim)
    spans = vec.safe_sqrt(vec.dot(swung, swung) * vec.dot(wanted, wanted))
    known = spans > jnp.finfo(spans.dtype).eps ** 0.5
    spans = jnp.where(known, spans, 1.0)
    cos = jnp.where(known, vec.dot(swung, wanted) / spans, 1.0)
    sin = jnp.where(known, vec.dot(aim, vec.cross(swung, wanted)) / spans, 0.0)
    pole = quat.unit(quat.from_cos_sin(aim, bounded_cosine(cos), sin))
    return quat.multiply(quat.from_axis_angle(aim, twist), quat.multiply(pole, arc))


def bounded_cosine(x: Array) -> Array:
    """`x` kept within -1..1 against rounding."""
    return jnp.where(x < -1, -1.0, jnp.where(x > 1, 1.0, x))
