"""Stage 7: locks that keep standing feet in place in the world.

`OffsetLock`, that of the record, is an offset that cancels the motion of a standing foot;
`PlantLock`, that of Mec, leaves a foot where it first found ground. To write a rule, start with
`AbstractLock`.
"""

from abc import abstractmethod
from math import inf

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import (
    Leaf,
    Rule,
    duration,
    half_life,
    rate,
    ratio,
    speed,
    switch,
    threshold,
)
from jaxik.maths.struct import place, struct
from jaxik.stages.inputs import SensedMoment
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import cast

LEAST = 0.01  # weight of a leg, up to which its foot is not locked
DISTANCE_BAND = 0.01  # m
COSINE_BAND = 0.03  # about 2 degrees at a right angle
ANGLE_BAND = 0.035  # rad, 2 degrees
SPEED_BAND = 0.05  # m/s
FACTOR_BAND = 0.05
HOLD_BAND = 0.1


@struct
class Hold:
    """How locks change the footholds."""

    offset_ws: Float[Array, "legs 3"]
    """m, from the foothold."""
    rot_ws: Float[Array, "legs 4"]
    """Of the ankles."""
    locked: Float[Array, " legs"]
    """1 where the foot keeps its place."""


class AbstractLock(Rule):
    """Keeps standing feet in place."""

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: PyTree
    ) -> tuple[PyTree, Hold]:
        """Memory after this frame, and how locks change the footholds.

        Args:
            now: the sensed frame.
            foothold_ws: where each foot would stand without a lock, m.
            hip_ws: the hips on the body as last placed, m.
            state: memory after the frame before.
        """


class NoLock(AbstractLock):
    """No locks: feet follow their footholds."""

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: None
    ) -> tuple[None, Hold]:
        free = jnp.zeros_like(foothold_ws)
        sensed = now.sensed
        return None, Hold(free, sensed.rot_ws, jnp.zeros_like(sensed.foothold.found))


@struct
class LockState:
    """Which feet are locked, and how far that holds them from their footholds."""

    locked: Float[Array, " legs"]
    """0 or 1."""
    factor: Float[Array, " legs"]
    """0..1, rises while locked, decays after release."""
    offset: Float[Array, "legs 3"]
    """m, of the ball or the ankle from where it would be without a lock, world axes."""
    turn: Float[Array, " legs"]
    """rad about up, from the animated heading of the foot to the one it keeps."""
    foothold: Float[Array, "legs 3"] = place("point")
    """m, of the frame before, world space."""
    ball: Float[Array, "legs 3"] = place("point")
    """m, likewise."""
    ahead: Float[Array, "legs 3"]
    """Unit, animated heading of the foot, world axes, likewise."""


class OffsetLock(AbstractLock):
    """Cancels the motion of a foot while it is locked (the record).

    The target is the foothold plus an offset. While the foot is locked, its motion since the frame
    before, over ground that may itself move, is subtracted from the offset. After release the
    offset decays, by no more than `return_speed`, so that neither locks nor releases jump.

    With `hold_ball` on, what stays is the ball of the foot and its heading: the foot turns about up
    against the animation, by an angle that is kept and decays as the offset does, and its heel
    rises about the ball as animated. With it off, only the ankle stays; the foot may turn, and a
    rising heel pushes the ball forward. The lift follows the animation in both cases.

    A foot locks when its contact is planted and it moves slower than `max_speed`. It is released
    when its contact is lifted, or earlier for any of these reasons:

    - Staying would bend or open the knee too far (`release_min_angle`, `release_max_angle`).
    - The leg would leave its animated direction by more than `release_cone`.
    - The offset would exceed `release_distance`.
    - The animated foot points away by more than `release_heading`.
    - The foothold moves faster than `release_speed`.

    A released foot can lock again once `factor` has decayed to `relock_threshold`.
    """

    enabled: Leaf = switch(True, "Whether planted feet are locked in place.")
    hold_ball: Leaf = switch(
        False,
        "Whether a lock holds ball and heading, so that the heel can rise, or only the ankle.",
        per_leg=False,
    )
    release_min_angle: Leaf = threshold(
        0.872664626,
        0,
        1.8,
        "A lock lets go if it would bend the knee below this interior angle.",
        unit="rad",
    )
    release_max_angle: Leaf = threshold(
        3.0019663134,
        2,
        3.1415926536,
        "A lock lets go if it would open the knee beyond this interior angle.",
        unit="rad",
    )
    release_cone: Leaf = threshold(
        0.436332313,
        0,
        1.5,
        "A lock lets go if the leg would leave its animated direction by this angle.",
        unit="rad",
    )
    release_distance: Leaf = threshold(
        0.2, 0, 0.5, "A lock lets go if the foot would be this far from its foothold.", unit="m"
    )
    release_heading: Leaf = threshold(
        3.1415926536,
        0.1,
        3.1415926536,
        "A lock lets go if the animated foot points away by this angle.",
        unit="rad",
    )
    release_speed: Leaf = threshold(
        inf, 0, 3, "A lock lets go if the foot would otherwise move faster than this.", unit="m/s"
    )
    relock_threshold: Leaf = threshold(
        0.2,
        0,
        1,
        "A released foot can lock again once its lock has faded to this weight.",
        unit="1",
    )
    max_speed: Leaf = threshold(
        inf, 0, 3, "A foot locks only while it is slower than this.", unit="m/s"
    )
    lock_half_life: Leaf = half_life(0.05, "Time in which a new lock reaches half its hold.")
    unlock_half_life: Leaf = half_life(
        0.1, "Time in which a released foot covers half its way back to the foothold."
    )
    return_speed: Leaf = speed(
        inf, 0.1, 3, "Highest speed at which a released foot goes back to its foothold."
    )

    def init(self, rig: Rig) -> LockState:
        zero, zeros = jnp.zeros_like(rig.side), jnp.zeros_like(rig.knee_axis_ls)
        return LockState(zero, zero, zeros, zero, zeros, zeros, zeros)

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: LockState
    ) -> tuple[LockState, Hold]:
        sensed, gate = now.sensed, now.gate
        moved, turned = self._motion(now, foothold_ws, state)
        before = sensed.carry.turn(state.offset)
        kept_ws = self._of_ankle(sensed, before - moved, state.turn - turned)
        stays = self._may_stay(now, foothold_ws + kept_ws, hip_ws)
        stays = stays * self._follows_animation(now, before - moved, state.turn - turned, moved)
        starts = stays * self._may_start(now, moved, state.factor)
        # Without this, each number of the memory would compute all these conditions again.
        stays, starts = vec.stacked_barrier(stays, starts)

        ones, zeros = jnp.ones_like(state.locked), jnp.zeros_like(state.locked)
        locked = gate.choose(starts, ones, state.locked)
        locked = gate.choose(stays, locked, zeros)

        lock_fraction = smoothing.fraction_of_half_life(self.lock_half_life, now.dt)
        unlock_fraction = smoothing.fraction_of_half_life(self.unlock_half_life, now.dt)
        risen = smoothing.lerp(state.factor, ones, lock_fraction)
        factor = gate.choose(locked, risen, smoothing.lerp(state.factor, zeros, unlock_fraction))
        remaining = 1.0 - self._returned(now, before, state.turn, unlock_fraction)
        locked, factor, remaining = vec.stacked_barrier(locked, factor, remaining)
        offset_ws = gate.choose(
            locked[..., None], before - vec.scale(moved, risen), vec.scale(before, remaining)
        )
        turn = gate.choose(locked, state.turn - turned * risen, state.turn * remaining)
        after = LockState(
            locked, factor, offset_ws, turn, foothold_ws, sensed.ball_ws, sensed.ahead_ws
        )
        kept_rot = quat.multiply(quat.from_axis_angle(sensed.leg_up_ws, turn), sensed.rot_ws)
        rot_ws = jnp.where(self.hold_ball, kept_rot, sensed.rot_ws)
        return after, Hold(self._of_ankle(sensed, offset_ws, turn), rot_ws, locked)

    def _motion(
        self, now: SensedMoment, foothold_ws: Array, state: LockState
    ) -> tuple[Array, Array]:
        """What a lock cancels, since the frame before: m, and rad about up."""
        sensed = now.sensed
        up, carry = sensed.leg_up_ws, sensed.carry
        moved = foothold_ws - carry.apply(state.foothold)
        ball_moved = vec.reject(sensed.ball_ws - carry.apply(state.ball), up)
        ball_moved += vec.scale(up, vec.dot(moved, up))
        ahead = carry.turn(state.ahead)
        sine = vec.dot(vec.cross(ahead, sensed.ahead_ws), up)
        turned = vec.safe_arctan2(sine, vec.dot(ahead, sensed.ahead_ws))
        moved = jnp.where(self.hold_ball, ball_moved, moved)
        return jnp.where(now.started, moved, 0.0), jnp.where(now.started, turned, 0.0)

    def _of_ankle(self, sensed: Sensed, offset_ws: Array, turn: Array) -> Array:
        """Offset of the ankle, m, if the lock's is `offset_ws`, and the foot turns by `turn`."""
        arm = sensed.ball_ws - sensed.ankle_ws
        turned_arm = quat.rotate(quat.from_axis_angle(sensed.leg_up_ws, turn), arm)
        return jnp.where(self.hold_ball, offset_ws + (arm - turned_arm), offset_ws)

    def _returned(self, now: SensedMoment, offset_ws: Array, turn: Array, fraction: Array) -> Array:
        """Part of its way back that a released foot covers: `fraction`, or less where too fast."""
        arm = vec.length(now.sensed.ball_ws - now.sensed.ankle_ws)
        way = vec.length(offset_ws) + jnp.where(self.hold_ball, jnp.abs(turn) * arm, 0.0)
        limited = jnp.isfinite(self.return_speed)
        step = jnp.where(limited, self.return_speed, 0.0) * now.dt
        allowed = vec.safe_divide(step, way, otherwise=1.0)
        return jnp.where(limited & (allowed < fraction), allowed, fraction)

    def _may_start(self, now: SensedMoment, moved: Array, factor: Array) -> Array:
        """1 where a foot that is free may lock."""
        sensed, gate = now.sensed, now.gate
        speed = vec.safe_divide(vec.length(moved), now.dt)
        calm = gate.below(speed, self.max_speed, band=SPEED_BAND)
        recovered = gate.below(factor, self.relock_threshold, band=FACTOR_BAND)
        return sensed.contact.planted * calm * recovered * sensed.foothold.found

    def _may_stay(self, now: SensedMoment, point_ws: Array, hip_ws: Array) -> Array:
        """1 where a foot with its foothold at `point_ws` suits contact, knee and leg."""
        sensed, gate = now.sensed, now.gate
        leg = point_ws + vec.scale(sensed.leg_up_ws, sensed.foothold.lift) - hip_ws
        squares = sensed.thigh**2 + sensed.shin**2
        cosine = vec.safe_divide(squares - vec.dot(leg, leg), 2.0 * sensed.thigh * sensed.shin)
        cosine = gate.clip(cosine, -jnp.ones_like(cosine), jnp.ones_like(cosine), band=COSINE_BAND)
        not_folded = gate.below(cosine, jnp.cos(self.release_min_angle), band=COSINE_BAND)
        not_straight = gate.above(cosine, jnp.cos(self.release_max_angle), band=COSINE_BAND)

        animated = sensed.ankle_ws - sensed.hip_ws
        lengths = vec.length(leg) * vec.length(animated)
        alignment = vec.safe_divide(vec.dot(leg, animated), lengths, otherwise=1.0)
        aligned = gate.above(alignment, jnp.cos(self.release_cone), band=COSINE_BAND)
        enabled = jnp.where(self.enabled & (sensed.weight > LEAST), 1.0, 0.0)
        return not_folded * not_straight * aligned * enabled * (1.0 - sensed.contact.lifted)

    def _follows_animation(
        self, now: SensedMoment, offset_ws: Array, turn: Array, moved: Array
    ) -> Array:
        """1 where a foot stays near its animation, which does not move too fast."""
        gate = now.gate
        near = gate.below(vec.length(offset_ws), self.release_distance, band=DISTANCE_BAND)
        aligned = gate.below(jnp.abs(turn), self.release_heading, band=ANGLE_BAND)
        # No foot points away by more than half a turn.
        aligned = jnp.where(self.release_heading < jnp.pi, aligned, 1.0)
        speed = vec.safe_divide(vec.length(moved), now.dt)
        return near * aligned * gate.below(speed, self.release_speed, band=SPEED_BAND)


@struct
class PlantState:
    """Where planted feet stand."""

    locked: Float[Array, " legs"]
    """0 or 1."""
    weight: Float[Array, " legs"]
    """0..1, how much of the planting is applied."""
    hold: Float[Array, " legs"]
    """0..1, how much of it is left to a foot that is let go."""
    foothold: Float[Array, "legs 3"] = place("point")
    """m, world space."""
    clearance: Float[Array, " legs"]
    """m, of that foothold above the ground below it."""
    rot: Float[Array, "legs 4"]
    """Of the ankles, world axes."""


class PlantLock(AbstractLock):
    """Keeps a foot where and how it first stood on ground until its ray finds none (Mec).

    It is planted once it has ground and its contact is planted, and let go once it has none or its
    contact is lifted. With `StandingContact`, as in the original, ground alone decides.
    The kept foothold follows the ground below it, which is probed again in every frame, and moves
    with it where the ground is a platform. The weight of planting moves to `plant_weight` at
    `plant_speed`: set it to 0 or 1 between steps to turn planting off or on over time, at once if
    the speed is infinite.

    A foot that its animation leaves, by more than `release_distance` or `release_angle`, is let go:
    it goes to where it would be without the lock in `release_time`, and is then planted anew. In
    the original, nothing but a lost ground lets go of a foot.
    """

    plant: Leaf = switch(True, "Whether a foot stays where it first stood on ground.")
    plant_weight: Leaf = ratio(1, 0, 1, "How much a planted foot keeps its place, 0 to 1.")
    plant_speed: Leaf = rate(
        inf, 0.1, 20, "Rate at which planting moves to its weight; infinite sets it at once."
    )

    release_distance: Leaf = threshold(
        inf, 0, 0.5, "A planted foot is let go if its foothold would be this far from it.", unit="m"
    )
    release_angle: Leaf = threshold(
        3.1415926536,
        0.1,
        3.1415926536,
        "A planted foot is let go if it would be turned away from it by this angle.",
        unit="rad",
    )
    release_time: Leaf = duration(0.3, 0.05, 1, "Time in which a foot that is let go is free.")

    def init(self, rig: Rig) -> PlantState:
        zero, zeros = jnp.zeros_like(rig.side), jnp.zeros_like(rig.knee_axis_ls)
        identity = jnp.broadcast_to(quat.identity(rig.side.dtype), (*rig.side.shape, 4))
        return PlantState(zero, zero, jnp.ones_like(zero), zeros, zero, identity)

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: PlantState
    ) -> tuple[PlantState, Hold]:
        sensed, gate = now.sensed, now.gate
        up, carry, rays = sensed.leg_up_ws, sensed.carry, sensed.ground.rays
        before = state.locked
        kept_ws = gate.choose(before[..., None], carry.apply(state.foothold), foothold_ws)
        kept_rot = quat.nlerp(sensed.rot_ws, carry.apply_rot(state.rot), before)

        hit = cast(
            now.terrain, kept_ws + vec.scale(up, rays.above), rays.above + rays.below, rays.layers
        )
        height = vec.dot(kept_ws - hit.point, up)
        clearance = gate.choose(before, state.clearance, height * hit.found)
        on_ground = hit.point + vec.scale(up, clearance)
        planted_ws = gate.choose(hit.found[..., None], on_ground, kept_ws)

        contact = sensed.contact
        stands = gate.choose(before, 1.0 - contact.lifted, contact.planted)
        plants = self.plant & (sensed.weight > LEAST)
        locked = jnp.where(plants, sensed.foothold.found * stands, 0.0)
        step = now.progress(smoothing.step_of_speed(self.plant_speed, now.dt))
        weight = smoothing.move_towards(state.weight, self.plant_weight, step)
        hold = self._hold(now, planted_ws - foothold_ws, kept_rot, state.hold)
        locked *= jnp.where(hold > 0, 1.0, 0.0)
        hold = jnp.where(locked > 0, hold, 1.0)
        planting = locked * weight * hold
        after = PlantState(locked, weight, hold, planted_ws, clearance, kept_rot)
        return after, Hold(
            vec.scale(planted_ws - foothold_ws, planting),
            quat.nlerp(sensed.rot_ws, kept_rot, planting),
            locked,
        )

    def _hold(self, now: SensedMoment, away_ws: Array, kept_rot: Array, before: Array) -> Array:
        """How much of its lock is left to a foot, 0..1, that is `away_ws`, m, from its foothold."""
        gate = now.gate
        turned = quat.angle(now.sensed.rot_ws, kept_rot)
        near = gate.below(vec.length(away_ws), self.release_distance, band=DISTANCE_BAND)
        near *= gate.below(turned, self.release_angle, band=ANGLE_BAND)
        near = gate.choose(gate.below(1.0 - before, 0.0 * before, band=HOLD_BAND), near, 0.0 * near)
        step = smoothing.step_of_time(self.release_time, now.dt)
        return gate.choose(near, before, smoothing.move_towards(before, 0.0 * before, step))
