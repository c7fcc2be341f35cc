"""Stage 8: feet that foot IK has moved together keep a distance sideways."""

from abc import abstractmethod

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxik.maths import quat, smoothing, vec
from jaxik.maths.parameter_tree import Leaf, Rule, half_life, length
from jaxik.maths.struct import struct
from jaxik.world.frame import Sensed
from jaxik.world.skeleton import Rig

from .inputs import SensedMoment
from .lock import Hold

DISTANCE_BAND = 0.01  # m
STEEPEST = 0.5  # cosine of the steepest slope along which a foot moves


class AbstractSeparation(Rule):
    """Keeps feet from crossing and from standing on each other."""

    def init(self, rig: Rig) -> PyTree:
        """Memory before the first frame; None for a rule that goes by each frame alone."""
        return None

    @abstractmethod
    def advance(
        self, now: SensedMoment, foothold_ws: Array, hold: Hold, state: PyTree
    ) -> tuple[PyTree, Float[Array, "legs 3"] | None]:
        """Memory after this frame, and how far each foot moves, m, world space; None for no foot.

        Args:
            now: the sensed frame.
            foothold_ws: where each foot would stand without a lock, m.
            hold: how locks change the footholds.
            state: memory after the frame before.
        """


class NoSeparation(AbstractSeparation):
    """Feet go where animation, ground and locks put them."""

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hold: Hold, state: None
    ) -> tuple[None, None]:
        return None, None


@struct
class SeparationState:
    """How far each foot has given way."""

    offset_ws: Float[Array, "legs 3"]
    """m, horizontal."""


class FootSeparation(AbstractSeparation):
    """Keeps feet of opposite sides apart, across the heading of the character.

    Locks and scaled strides can bring feet nearer to each other than the animation does. With x to
    the left, a left foot i and a right foot j are short of `min(distance, a_i - a_j) - (x_i - x_j)`
    where a is the animation and x the foothold with its lock, whose left turns with strides that
    are turned. So no pair of feet is asked to be further apart than animated: legs that the
    animation crosses stay crossed.

    The swinging foot of a pair gives way by as much as is missing, two swinging feet share it.
    Where several feet are near, the largest move counts. Feet that stand or are locked do not move:
    they keep the offset with which they came down, so that none slides. A swinging foot fades to
    its offset, and after it has lifted off back to none, with `half_life`. The move is horizontal;
    on a slope it follows the ground. Feet in the middle of a body do not take part.
    """

    distance: Leaf = length(
        0.1,
        0,
        0.3,
        "Distance sideways between the ankles of opposite feet below which they give way.",
        per_leg=False,
    )
    half_life: Leaf = half_life(0.04, "Time in which a swinging foot covers half its way aside.")

    def init(self, rig: Rig) -> SeparationState:
        return SeparationState(jnp.zeros_like(rig.knee_axis_ls))

    def advance(
        self, now: SensedMoment, foothold_ws: Array, hold: Hold, state: SeparationState
    ) -> tuple[SeparationState, Float[Array, "legs 3"]]:
        sensed, side = now.sensed, now.sensed.side
        left_ws, animated_left_ws = _lefts(sensed)
        before = sensed.carry.turn(state.offset_ws)
        held = 1.0 - (1.0 - hold.locked) * (1.0 - sensed.contact.weight)

        kept = held * vec.dot(before, left_ws)
        placed = vec.dot(foothold_ws + hold.offset_ws, left_ws)
        animated = vec.dot(sensed.unscaled_ankle_ws, animated_left_ws)
        wanted = now.gate.clip(
            _apart(animated, animated, side),
            jnp.asarray(-jnp.inf, side.dtype),
            self.distance,
            band=DISTANCE_BAND,
        )
        missing = wanted - _apart(placed, placed + kept, side)
        zero = jnp.zeros_like(missing)
        missing = now.gate.clip(missing, zero, zero + jnp.inf, band=DISTANCE_BAND)
        active = sensed.load
        free = 1.0 - held
        moves = active * free  # so that a foot with hardly any weight hardly gives way
        share = vec.safe_divide(moves[:, None], free[:, None] + moves[None, :])
        opposed = jnp.where(side[:, None] * side[None, :] < 0, active[None, :], 0.0)
        move = now.gate.maximum(opposed * share * missing, band=DISTANCE_BAND)

        goal = vec.scale(left_ws, side * move)
        fraction = now.progress(smoothing.fraction_of_half_life(self.half_life, now.dt))
        offset = before + vec.scale(goal - before, (1.0 - held) * fraction)
        normal, up = sensed.ground.ankle.normal, sensed.leg_up_ws
        facing = now.gate.clip(
            vec.dot(normal, up),
            jnp.asarray(STEEPEST, side.dtype),
            jnp.ones((), side.dtype),
            band=0.01,
        )
        climb = -sensed.foothold.found * vec.dot(offset, normal) / facing
        return SeparationState(offset), offset + vec.scale(up, climb)


def _lefts(sensed: Sensed) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """To the left of the feet, and of the animation on its turned pelvis, unit, world space."""
    left_ws = -sensed.slope.right_ws
    if sensed.turn is None:
        return left_ws, left_ws
    turns = jnp.stack([sensed.turn.feet, sensed.turn.pelvis])
    feet_ws, pelvis_ws = quat.rotate(quat.from_axis_angle(sensed.up_ws, turns), left_ws)
    return feet_ws, pelvis_ws


def _apart(x: Array, others: Array, side: Array) -> Float[Array, "legs legs"]:
    """How far each foot at `x` is on its own side of each other, m, both measured to the left."""
    return side[:, None] * (x[:, None] - others[None, :])
