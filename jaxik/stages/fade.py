"""How foot IK fades in and out, so that nothing pops when a weight or `Frame.grounded` jumps.

The stage runs in two places: after the pelvis, where the body moves to where pelvis and lean want
it, and after the effector, where each leg's weight moves to the one that it is to have.
"""

import dataclasses
from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.gate import HARD
from jaxik.maths.parameter_tree import Leaf, Rule, speed
from jaxik.maths.struct import place, struct
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Rig, Transform, mean_position

from .effector import Effector
from .inputs import SensedMoment

BODY_SHARE = 0.5  # of the speed, that the body takes while legs fade too
FADING = 0.1  # of a weight that is still to fade, from which the legs take their share of the speed
SETTLED = 0.005  # m; a body that lags less has almost arrived
SMALLEST = 1e-6  # m, smaller corrections fade at once


class AbstractFade(Rule):
    """Fades foot IK of the body and of each leg."""

    per_leg: ClassVar[bool] = False

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def lasting(self, weight: Float[Array, " legs"], state: PyTree) -> Float[Array, " legs"]:
        """Weights for locks, which hold a foot until its leg has faded out."""

    @abstractmethod
    def body(
        self, now: SensedMoment, goal: Transform, weight: Float[Array, " legs"], state: PyTree
    ) -> tuple[PyTree, Transform]:
        """Memory so far, and the body's motion in this frame.

        Args:
            now: the sensed frame.
            goal: offset, m, and rotation about the hips that pelvis and lean want, world axes.
            weight: that each leg is to have, 0..1.
            state: memory after the frame before.
        """

    @abstractmethod
    def legs(
        self,
        now: SensedMoment,
        effector: Effector,
        body: Transform,
        weight: Float[Array, " legs"],
        state: PyTree,
    ) -> tuple[PyTree, Float[Array, " legs"]]:
        """Memory after this frame, and how much foot IK each leg gets in it.

        Args:
            now: the sensed frame.
            effector: where the legs go.
            body: the body's motion in this frame.
            weight: that each leg is to have, 0..1.
            state: memory as `body` returned it.
        """


class NoFade(AbstractFade):
    """Weights act at once; where they jump, so does the pose."""

    def lasting(self, weight: Array, state: None) -> Array:
        return weight

    def body(
        self, now: SensedMoment, goal: Transform, weight: Array, state: None
    ) -> tuple[None, Transform]:
        return None, goal

    def legs(
        self, now: SensedMoment, effector: Effector, body: Transform, weight: Array, state: None
    ) -> tuple[None, Array]:
        return None, weight


@struct
class SpeedFadeState:
    """What has faded in so far."""

    weight: Float[Array, " legs"]
    """0..1, weights that they had."""
    body: Transform
    """Motion of the body: offset, m, and rotation, world axes."""
    moved: Float[Array, ""]
    """m, how far the body moved by itself in this frame."""
    lag: Float[Array, ""]
    """m, how far the body is from where it is to be."""
    hip_height: Float[Array, ""] = place("height")
    """m, along up, of the animated hips."""
    fall_speed: Float[Array, ""]
    """m/s, at which the animated hips fell while foot IK was off; until all has faded in."""
    speed: Float[Array, ""]
    """m/s, of the fade in this frame: what the animation has lost of that speed, at a landing."""


class SpeedFade(AbstractFade):
    """Fades by a speed: whatever jumps, no ankle, ball or pelvis moves faster because of it.

    A leg's weight moves in steps of `speed dt / size`, where `size` bounds how far ankle and ball
    move between no and full foot IK. While weights fade, the body may lag behind where pelvis and
    lean want it, by a leg's length times the largest weight that is still to fade; this lag then
    closes by the same speed. So a change of a weight by x holds the body back by at most x times
    what a full one may, and weights that stay as they are leave no trace.

    A character that falls lands at the speed of its fall: its feet go on to the ground as animated,
    instead of waiting for the fade.
    """

    speed: Leaf = speed(
        0.5,
        0.1,
        3,
        "Speed by which joints move at most while foot IK fades in or out.",
        scale="log",
    )

    def init(self, rig: Rig) -> SpeedFadeState:
        zero, zeros = jnp.zeros((), rig.side.dtype), jnp.zeros_like(rig.side)
        body = Transform(jnp.zeros(3, zero.dtype), quat.identity(zero.dtype))
        return SpeedFadeState(zeros, body, zero, zero, zero, zero, zero)

    def lasting(self, weight: Array, state: SpeedFadeState) -> Array:
        return jnp.where(state.weight > weight, state.weight, weight)

    def body(
        self, now: SensedMoment, goal: Transform, weight: Array, state: SpeedFadeState
    ) -> tuple[SpeedFadeState, Transform]:
        sensed = now.sensed
        lengths = jnp.where(sensed.present, sensed.thigh + sensed.shin, 0.0)
        reach = HARD.maximum(lengths, band=0.0)
        change = sensed.bearing * jnp.abs(weight - state.weight)
        unfaded = HARD.maximum(jnp.where(sensed.present, change, 0.0), band=0.0)
        state = self._with_speed(now, weight, unfaded, state)
        legs_share = jnp.clip(unfaded / FADING, 0.0, 1.0)
        limit = state.speed * (1.0 - (1.0 - BODY_SHARE) * legs_share) * now.dt
        offset = goal.pos - state.body.pos
        gap = vec.length(offset) + reach * quat.angle(state.body.rot, goal.rot)
        most = jnp.where(now.started, jnp.maximum(reach * unfaded, state.lag - limit), 0.0)
        lag = jnp.minimum(jnp.maximum(gap - limit, 0.0), most)
        behind = lag > 0
        part = 1.0 - jnp.where(behind, lag / jnp.where(behind, gap, 1.0), 0.0)
        body = Transform(
            jnp.where(behind, state.body.pos + vec.scale(offset, part), goal.pos),
            jnp.where(behind, quat.nlerp(state.body.rot, goal.rot, part), goal.rot),
        )
        after = dataclasses.replace(state, body=body, moved=jnp.minimum(gap, limit), lag=lag)
        return after, body

    def legs(
        self,
        now: SensedMoment,
        effector: Effector,
        body: Transform,
        weight: Array,
        state: SpeedFadeState,
    ) -> tuple[SpeedFadeState, Array]:
        # A foot that swings by its contact may join its animation as fast as that moves.
        swinging = jnp.clip((now.sensed.weight - weight) / FADING, 0.0, 1.0)
        limit = (state.speed + swinging * now.sensed.foot_speed) * now.dt
        # A leg that has not faded in moves with the body.
        limit -= (1.0 - state.weight) * BODY_SHARE * state.moved
        size = correction_size(now, effector, body, state.weight)
        sized = size > SMALLEST
        step = jnp.where(sized, limit / jnp.where(sized, size, 1.0), 1.0)
        faded = smoothing.move_towards(state.weight, weight, now.progress(step))
        return dataclasses.replace(state, weight=faded), faded

    def _with_speed(
        self, now: SensedMoment, weight: Array, unfaded: Array, state: SpeedFadeState
    ) -> SpeedFadeState:
        """The memory with how fast the hips fall, or fell before the landing."""
        sensed = now.sensed
        height = vec.dot(_mean_hip(sensed) - sensed.root_ws, sensed.up_ws)
        falling = jnp.where(now.started, vec.safe_divide(state.hip_height - height, now.dt), 0.0)
        falling = jnp.where(falling > 0, falling, 0.0)
        landing = state.fall_speed * jnp.clip(unfaded / FADING + state.lag / SETTLED, 0.0, 1.0)
        off = 1.0 - HARD.maximum(weight, band=0.0)
        fall_speed = jnp.maximum(off * falling, landing)
        remaining = fall_speed - falling
        return dataclasses.replace(
            state,
            hip_height=height,
            fall_speed=fall_speed,
            speed=jnp.where(remaining > self.speed, remaining, self.speed),
        )


def correction_size(
    now: SensedMoment, effector: Effector, body: Transform, weight: Float[Array, " legs"]
) -> Float[Array, " legs"]:
    """Bounds how far ankle and ball of each leg move per unit of its weight, m.

    The weight turns hip and knee evenly. A leg that is straight at weight 0 starts to shorten
    slowly, and one that is straight at 1 arrives slowly: at the other end it is twice as fast as on
    average. The foot turns with the leg on one half of the way and back on the other.
    """
    sensed = now.sensed
    carried = Transform(
        carry(sensed, sensed.ankle_ws, body), quat.multiply(body.rot, sensed.ankle_rot_ws)
    )
    hip = carry(sensed, sensed.hip_ws, body)
    reach = sensed.thigh + sensed.shin
    to_target = effector.target_ws - hip
    distance = vec.length(to_target)
    beyond = distance > reach
    within = jnp.where(beyond, reach / jnp.where(beyond, distance, 1.0), 1.0)
    chord = vec.length(hip + vec.scale(to_target, within) - carried.pos)
    share = vec.safe_divide(chord, reach)
    leg_turn = share + vec.safe_sqrt(2.0 * share)
    foot_turn = quat.angle(carried.rot, effector.rot_ws)
    foot_turn += sensed.turned * vec.length(sensed.ground.ankle.normal - sensed.leg_up_ws)
    arm = vec.length(sensed.ball_ws - sensed.ankle_ws)
    end = jnp.abs(2.0 * weight - 1.0)
    return (1.0 + end) * chord + arm * (end * leg_turn + foot_turn)


def carry(sensed: Sensed, points_ws: Array, body: Transform) -> Float[Array, "legs 3"]:
    """Points of the animated legs, m, on the body that turns about the mean of its hips."""
    pivot = _mean_hip(sensed)
    return pivot + body.pos + quat.rotate(body.rot, points_ws - pivot)


def _mean_hip(sensed: Sensed) -> Float[Array, "3"]:
    """The mean of the animated hips, m, world space."""
    return mean_position(sensed.hip_ws, sensed.present)
