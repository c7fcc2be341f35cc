"""Stage 3: where each foot would stand, with the ground's height smoothed over time."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from . import ease, quat, vec
from .frame import UP, Contact, Foothold, Frame, Ground
from .gate import AbstractGate
from .rule import parameter
from .skeleton import Rig

HEIGHT_BAND = 0.01  # m


class AbstractTarget(eqx.Module):
    """Places footholds."""

    @abstractmethod
    def init(self, rig: Rig, dtype: Any) -> Any:
        """Memory before the first frame."""

    @abstractmethod
    def sense(
        self, frame: Frame, up_ws: Array, ground: Ground, contact: Contact, gate: AbstractGate
    ) -> Foothold:
        """The foothold that this frame alone asks for."""

    @abstractmethod
    def advance(
        self, foothold: Foothold, dt: Array, state: Any, started: Array, gate: AbstractGate
    ) -> tuple[Any, Float[Array, " legs"]]:
        """How far along up each foothold is moved by memory and limits, m."""


class TargetState(eqx.Module):
    """Smoothed height of the ground under each foot."""

    height: Float[Array, " legs"]  # m, along up


class SlopeTarget(AbstractTarget):
    """Keeps the animated lift over the ground and the sole exact on a slope.

    The ankle goes to `I + u (l + h (1/(n·u) - 1))` (ozz's construction with the animated lift `l`
    added): on a slope the ankle of a sole that lies flat is `h / (n·u)` above the hit. The height
    follows the ground with one half-life up and one down; the ankle stays between two heights in
    model space. Where no ground was found the foothold is the animation's own.
    """

    min_ankle_height: Array = parameter(-0.30, unit="m", low=-1.0, high=0.5)
    max_ankle_height: Array = parameter(0.55, unit="m", low=0.0, high=1.5)
    foot_height: Array = parameter(0.08, unit="m", low=0.0, high=0.2)
    max_slope: Array = parameter(1.0471975512, unit="rad", low=0.1, high=1.5)
    rise_half_life: Array = parameter(0.0, unit="s", low=0.002, high=0.5, scale="log")
    fall_half_life: Array = parameter(0.0, unit="s", low=0.002, high=0.5, scale="log")

    def init(self, rig: Rig, dtype: Any) -> TargetState:
        return TargetState(jnp.zeros(rig.side.shape, dtype))

    def sense(
        self, frame: Frame, up_ws: Array, ground: Ground, contact: Contact, gate: AbstractGate
    ) -> Foothold:
        hit = ground.ankle
        steepest = jnp.cos(self.max_slope)
        cosine = gate.clip(vec.dot(hit.normal, up_ws), steepest, jnp.ones_like(steepest), band=0.01)
        standing = hit.point + vec.scale(up_ws, self.foot_height * (1.0 / cosine - 1.0))
        ankle_ws = frame.world_from_model.apply(frame.pose.ankle.pos)
        animated = ankle_ws - vec.scale(up_ws, contact.lift)
        point_ws = gate.choose(hit.found[..., None], standing, animated)
        model_up = quat.rotate(frame.world_from_model.rot, vec.constant(UP, up_ws))
        climb = vec.dot(model_up, up_ws)
        base = vec.dot(point_ws - frame.world_from_model.pos, model_up)
        return Foothold(
            point_ws, vec.dot(point_ws, up_ws), base + contact.lift * climb, climb, hit.found
        )

    def advance(
        self,
        foothold: Foothold,
        dt: Array,
        state: TargetState,
        started: Bool[Array, ""],
        gate: AbstractGate,
    ) -> tuple[TargetState, Float[Array, " legs"]]:
        gap = foothold.height - state.height
        rising = gate.above(gap, jnp.zeros_like(gap), band=HEIGHT_BAND)
        share = gate.choose(
            rising,
            ease.share_of_half_life(self.rise_half_life, dt),
            ease.share_of_half_life(self.fall_half_life, dt),
        )
        height = ease.approach(state.height, foothold.height, jnp.where(started, share, 1.0))
        rise = height - foothold.height
        ankle = foothold.ankle_height_ms + rise * foothold.climb
        kept = gate.clip(ankle, self.min_ankle_height, self.max_ankle_height, band=HEIGHT_BAND)
        return TargetState(height), rise + (kept - ankle)
