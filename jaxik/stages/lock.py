"""Stage 6: feet that keep their place in the world while they stand."""

from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import Leaf, Rule, half_life_parameter, parameter, switch
from jaxik.maths.struct import struct
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import cast

from .inputs import SensedMoment

DISTANCE_BAND = 0.01  # m
COSINE_BAND = 0.03  # about 2 degrees at a right angle
SPEED_BAND = 0.05  # m/s
FACTOR_BAND = 0.05


@struct
class Hold:
    """What locks make of the footholds."""

    offset_ws: Float[Array, "legs 3"]  # m, kept from the foothold
    rot_ws: Float[Array, "legs 4"]  # of the ankles
    locked: Float[Array, " legs"]  # 1 where the foot keeps its place


class AbstractLock(Rule):
    """Keeps feet in place."""

    @abstractmethod
    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame."""

    @abstractmethod
    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: PyTree
    ) -> tuple[PyTree, Hold]:
        """Memory after this frame, and what each foot keeps."""


class NoLock(AbstractLock):
    """Feet follow their footholds."""

    def init(self, rig: Rig) -> None:
        return None

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: None
    ) -> tuple[None, Hold]:
        free = jnp.zeros_like(foothold_ws)
        sensed = now.sensed
        return None, Hold(free, sensed.rot_ws, jnp.zeros_like(sensed.foothold.found))


@struct
class LockState:
    """Which feet are locked, and how far from the animation that holds them."""

    locked: Float[Array, " legs"]  # 0 or 1
    factor: Float[Array, " legs"]  # 0..1, rises while locked, decays after release
    offset: Float[Array, "legs 3"]  # m, along the platform's axes
    foothold: Float[Array, "legs 3"]  # m, of the frame before, in the platform's space
    ball: Float[Array, "legs 3"]  # m, likewise
    ahead: Float[Array, "legs 3"]  # unit, where the foot pointed as it locked, platform's axes


class OffsetLock(AbstractLock):
    """Takes the foothold's own displacement out of the target while the foot is locked.

    The target is the foothold plus an offset. Locked, the offset loses the foothold's displacement
    since the frame before (as seen from a moving platform), so the foot stays while its lift still
    follows the animation; released, the offset decays. Neither edge pops. With `hold_ball` on it is
    the ball's displacement along the ground that is taken out, so that the ball stays while the
    heel rises.

    A foot locks when the contact says planted and it is slower than `max_speed`; it is released
    when the contact says lifted, or early: when staying would bend or straighten the knee too far,
    when hip to place leaves hip to animated ankle by more than `release_cone`, when the offset
    grows beyond `release_distance`, when the animated foot points elsewhere by `release_heading`,
    or when it would move faster than `release_speed`. A released foot locks again once its factor
    is at most `relock_threshold`.
    """

    enabled: Leaf = switch(True, doc="Whether planted feet are locked in place.")
    hold_ball: Leaf = switch(
        False, doc="Whether a lock holds the ball only, so that the heel can rise."
    )
    release_min_angle: Leaf = parameter(
        0.8726646260,
        unit="rad",
        low=0.0,
        high=1.8,
        kind="threshold",
        doc="A lock lets go if it would bend the knee below this interior angle.",
    )
    release_max_angle: Leaf = parameter(
        3.0019663134,
        unit="rad",
        low=2.0,
        high=3.1415926536,
        kind="threshold",
        doc="A lock lets go if it would open the knee beyond this interior angle.",
    )
    release_cone: Leaf = parameter(
        0.4363323130,
        unit="rad",
        low=0.0,
        high=1.5,
        kind="threshold",
        doc="A lock lets go if the leg would leave its animated direction by this angle.",
    )
    release_distance: Leaf = parameter(
        0.20,
        unit="m",
        low=0.0,
        high=0.5,
        kind="threshold",
        doc="A lock lets go if the foot would be this far from its foothold.",
    )
    release_heading: Leaf = parameter(
        3.1415926536,
        unit="rad",
        low=0.1,
        high=3.1415926536,
        kind="threshold",
        doc="A lock lets go if the animated foot points away by this angle.",
    )
    release_speed: Leaf = parameter(
        float("inf"),
        unit="m/s",
        low=0.0,
        high=3.0,
        kind="threshold",
        doc="A lock lets go if the foot would otherwise move faster than this.",
    )
    relock_threshold: Leaf = parameter(
        0.20,
        unit="1",
        low=0.0,
        high=1.0,
        kind="threshold",
        doc="A released foot can lock again once its lock has faded to this weight.",
    )
    max_speed: Leaf = parameter(
        float("inf"),
        unit="m/s",
        low=0.0,
        high=3.0,
        kind="threshold",
        doc="A foot locks only while it is slower than this.",
    )
    lock_half_life: Leaf = half_life_parameter(
        0.05, doc="Time in which a new lock reaches half its hold."
    )
    unlock_half_life: Leaf = half_life_parameter(
        0.10, doc="Time in which a released foot covers half its way back to the foothold."
    )

    def init(self, rig: Rig) -> LockState:
        each = jnp.zeros_like(rig.side)
        spread = jnp.zeros_like(rig.knee_axis_ls)
        return LockState(each, each, spread, spread, spread, spread)

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: LockState
    ) -> tuple[LockState, Hold]:
        sensed, gate = now.sensed, now.gate
        up, platform = sensed.leg_up_ws, sensed.platform
        moved = foothold_ws - platform.apply(state.foothold)
        slid = vec.reject(sensed.ball_ws - platform.apply(state.ball), up)
        slid += vec.scale(up, vec.dot(moved, up))
        moved = jnp.where(now.started, jnp.where(self.hold_ball, slid, moved), 0.0)
        before = quat.rotate(platform.rot, state.offset)
        pointed = quat.rotate(platform.rot, state.ahead)
        pointed = gate.choose(state.locked[..., None], pointed, sensed.ahead_ws)
        stays = self._may_stay(now, foothold_ws, hip_ws, before - moved)
        stays = stays * self._goes_along(now, moved, pointed)
        starts = stays * self._may_start(now, moved, state.factor)

        one, zero = jnp.ones_like(state.locked), jnp.zeros_like(state.locked)
        locked = gate.choose(starts, one, state.locked)
        locked = gate.choose(stays, locked, zero)

        on = smoothing.fraction_of_half_life(self.lock_half_life, now.dt)
        off = smoothing.fraction_of_half_life(self.unlock_half_life, now.dt)
        risen = smoothing.lerp(state.factor, one, on)
        factor = gate.choose(locked, risen, smoothing.lerp(state.factor, zero, off))
        held = before - vec.scale(moved, risen)
        decayed = vec.scale(before, 1.0 - off)
        offset_ws = gate.choose(locked[..., None], held, decayed)
        into_platform = platform.inverse()
        after = LockState(
            locked,
            factor,
            quat.rotate(into_platform.rot, offset_ws),
            into_platform.apply(foothold_ws),
            into_platform.apply(sensed.ball_ws),
            quat.rotate(into_platform.rot, pointed),
        )
        return after, Hold(offset_ws, sensed.rot_ws, locked)

    def _may_start(self, now: SensedMoment, moved: Array, factor: Array) -> Array:
        sensed, gate = now.sensed, now.gate
        speed = vec.safe_divide(vec.length(moved), now.dt)
        calm = gate.below(speed, self.max_speed, band=SPEED_BAND)
        recovered = gate.below(factor, self.relock_threshold, band=FACTOR_BAND)
        return sensed.contact.planted * calm * recovered * sensed.foothold.found

    def _may_stay(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, offset_ws: Array
    ) -> Array:
        """1 where nothing releases a foot that would keep its place."""
        sensed, gate = now.sensed, now.gate
        place = foothold_ws + offset_ws + vec.scale(sensed.leg_up_ws, sensed.foothold.lift)
        leg = place - hip_ws
        squares = sensed.thigh**2 + sensed.shin**2
        cosine = vec.safe_divide(squares - vec.dot(leg, leg), 2.0 * sensed.thigh * sensed.shin)
        cosine = gate.clip(cosine, -jnp.ones_like(cosine), jnp.ones_like(cosine), band=COSINE_BAND)
        bent = gate.below(cosine, jnp.cos(self.release_min_angle), band=COSINE_BAND)
        short = gate.above(cosine, jnp.cos(self.release_max_angle), band=COSINE_BAND)

        animated = sensed.ankle_ws - sensed.hip_ws
        spans = vec.length(leg) * vec.length(animated)
        alignment = vec.safe_divide(vec.dot(leg, animated), spans, otherwise=1.0)
        ahead = gate.above(alignment, jnp.cos(self.release_cone), band=COSINE_BAND)

        near = gate.below(vec.length(offset_ws), self.release_distance, band=DISTANCE_BAND)
        works = jnp.where(self.enabled & (sensed.weight > 0), 1.0, 0.0)
        return bent * short * ahead * near * works * (1.0 - sensed.contact.lifted)

    def _goes_along(self, now: SensedMoment, moved: Array, pointed: Array) -> Array:
        """1 where the animated foot turns and moves little enough for one that keeps its place."""
        sensed, gate = now.sensed, now.gate
        alignment = vec.dot(pointed, sensed.ahead_ws)
        along = gate.above(alignment, jnp.cos(self.release_heading), band=COSINE_BAND)
        # Half a turn is as far as a foot can point elsewhere.
        along = jnp.where(self.release_heading < jnp.pi, along, 1.0)
        speed = vec.safe_divide(vec.length(moved), now.dt)
        return along * gate.below(speed, self.release_speed, band=SPEED_BAND)


@struct
class PlantState:
    """Where planted feet stand."""

    locked: Float[Array, " legs"]  # 0 or 1
    share: Float[Array, " legs"]  # 0..1, how much planting counts
    foothold: Float[Array, "legs 3"]  # m, in the platform's space
    clearance: Float[Array, " legs"]  # m, of that foothold over the ground below it
    rot: Float[Array, "legs 4"]  # of the ankles, along the platform's axes


class PlantLock(AbstractLock):
    """Keeps a foot where and how it first found ground until its ray finds none (Mec).

    The place follows the ground below it, looked at again in every frame. How much planting counts
    moves at `plant_speed` towards `plant_weight`: set that to 0 or 1 between steps to disable or
    enable planting over time, or leave the speed endless to set it at once. Follows a platform.
    """

    plant: Leaf = switch(True, doc="Whether a foot stays where it first found ground.")
    plant_weight: Leaf = parameter(
        1.0, unit="1", low=0.0, high=1.0, doc="How much a planted foot keeps its place, 0 to 1."
    )
    plant_speed: Leaf = parameter(
        float("inf"),
        unit="1/s",
        low=0.1,
        high=20.0,
        scale="log",
        doc="Rate at which planting moves to its weight; infinite sets it at once.",
    )

    def init(self, rig: Rig) -> PlantState:
        each = jnp.zeros_like(rig.side)
        spread = jnp.zeros_like(rig.knee_axis_ls)
        upright = jnp.broadcast_to(quat.identity(rig.side.dtype), (*rig.side.shape, 4))
        return PlantState(each, each, spread, each, upright)

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hip_ws: Array, state: PlantState
    ) -> tuple[PlantState, Hold]:
        sensed, gate = now.sensed, now.gate
        up, platform, rays = sensed.leg_up_ws, sensed.platform, sensed.ground.rays
        before = state.locked
        kept_ws = gate.choose(before[..., None], platform.apply(state.foothold), foothold_ws)
        kept_rot = quat.nlerp(sensed.rot_ws, platform.apply_rot(state.rot), before)

        hit = cast(
            now.terrain, kept_ws + vec.scale(up, rays.above), rays.above + rays.below, rays.layers
        )
        over_ground = vec.dot(kept_ws - hit.point, up)
        clearance = gate.choose(before, state.clearance, over_ground * hit.found)
        followed = hit.point + vec.scale(up, clearance)
        planted_ws = gate.choose(hit.found[..., None], followed, kept_ws)

        locked = jnp.where(self.plant, sensed.foothold.found, 0.0)
        step = now.progress(smoothing.step_of_speed(self.plant_speed, now.dt))
        share = smoothing.move_towards(state.share, self.plant_weight, step)
        counts = locked * share
        held = Hold(
            vec.scale(planted_ws - foothold_ws, counts),
            quat.nlerp(sensed.rot_ws, kept_rot, counts),
            locked,
        )
        into_platform = platform.inverse()
        after = PlantState(
            locked,
            share,
            into_platform.apply(planted_ws),
            clearance,
            into_platform.apply_rot(kept_rot),
        )
        return after, held
