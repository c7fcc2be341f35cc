"""The lock of Mec: a foot stays where it first found ground."""

from math import inf

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import Leaf, duration, rate, ratio, switch, threshold
from jaxik.maths.struct import place, struct
from jaxik.stages.inputs import SensedMoment
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import cast

from .base import LEAST, AbstractLock, Hold

DISTANCE_BAND = 0.01  # m
ANGLE_BAND = 0.035  # rad, 2 degrees
HOLD_BAND = 0.1


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
