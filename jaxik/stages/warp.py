"""Stage 3: strides scaled and turned for a character that moves otherwise than its animation."""

import dataclasses
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxik.maths import quat, vec
from jaxik.maths.parameter_tree import Leaf, Rule, angle, duration, ratio
from jaxik.maths.smoothing import clip_to_one, fraction_of_half_life, lerp
from jaxik.world.frame import UP, Frame, Turn, heading
from jaxik.world.skeleton import Rig, Transform

from .inputs import Inputs, Moment

SCALE_BAND = 0.02
ANGLE_BAND = 0.035  # rad, 2 degrees
RIGHT_ANGLE = 0.5 * math.pi


class StrideWarp(Rule):
    """Scales strides with the speed of the character, so that standing feet do not skate.

    The root of a character that is k times as fast as its animation (`Frame.stride_scale`) moves by
    k times the animated way. A foot that stands in the animation stands here too if its horizontal
    offset from the root is scaled by k: `k p + k f = k (p + f)` is constant where the animated
    `p + f` is. The offset is that of the ball, and the whole foot moves with it. Where the frame
    tells no scale, nothing happens.

    With `width` 1 this is exact in turns too, and steps become wider as they become longer. With 0
    only the part of the offset along the velocity is scaled, as "stride warping" does in Unreal
    Engine: steps keep their width, but feet skate as far as the root sways or turns. Locomotion
    systems after Johansen (2009) adapt strides in this way too. Pelvis and heels then follow as
    far as longer strides need them to.

    A character that moves in another direction than its animation (`Frame.orientation`) has its
    feet turned about the root's up by that angle, up to `max_angle`, the pelvis by
    `pelvis_share` of it, and the spine back by as much, which leaves the shoulders as animated:
    Unreal's *Orientation Warping*, whose *Distributed Bone Orientation Alpha* is this share. Beyond
    a right angle the turn falls again, to none for a character that goes backward. It follows with
    `half_life`, also in the air and without foot IK, where it is none.
    """

    min_scale: Leaf = ratio(0.4, 0, 1, "Shortest strides, as a part of the animated ones.")
    max_scale: Leaf = ratio(1.5, 1, 2.5, "Longest strides, as a multiple of the animated ones.")
    width: Leaf = ratio(1, 0, 1, "How much the width of steps is scaled with their length.")

    max_angle: Leaf = angle(
        1.5, 0, RIGHT_ANGLE, "Largest angle by which the feet are turned.", per_leg=False
    )
    pelvis_share: Leaf = ratio(
        0.5, 0, 1, "Part of the feet's turn that the pelvis makes.", per_leg=False
    )
    half_life: Leaf = duration(
        0.1,
        0.002,
        0.5,
        "Time in which the feet turn half of their way.",
        scale="log",
        per_leg=False,
    )

    def init(self, rig: Rig) -> Float[Array, ""]:
        """Memory before the first frame: the feet's turn, rad."""
        return jnp.zeros((), rig.side.dtype)

    def sense(self, inputs: Inputs) -> Float[Array, ""] | None:
        """The turn that the feet are to have, rad; None, which costs nothing, where none does."""
        frame = inputs.frame
        if frame.orientation is None:
            return None
        turn = frame.orientation
        turn -= 2.0 * jnp.pi * jnp.round(turn / (2.0 * jnp.pi))
        turn = jnp.where(turn > RIGHT_ANGLE, jnp.pi - turn, turn)
        turn = jnp.where(turn < -RIGHT_ANGLE, -jnp.pi - turn, turn)
        turn = inputs.gate.clip(turn, -self.max_angle, self.max_angle, band=ANGLE_BAND)
        weight = vec.sum_last(jnp.where(inputs.rig.present, frame.weight, 0.0))
        return turn * frame.grounded * clip_to_one(weight)

    def advance(
        self, now: Moment, goal: Float[Array, ""] | None, state: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Turn | None]:
        """Memory after this frame, and how the body is turned."""
        if goal is None:
            return state, None
        fraction = now.progress(fraction_of_half_life(self.half_life, now.dt))
        turn = lerp(state, goal, fraction)
        return turn, Turn(self.pelvis_share * turn, turn)

    def offset(self, inputs: Inputs) -> Float[Array, "legs 3"] | None:
        """How far each foot moves, m, world space; None, which costs nothing, where none does."""
        frame, up_ws = inputs.frame, inputs.terrain.leg_up_ws
        if frame.stride_scale is None:
            return None
        scale = inputs.gate.clip(
            frame.stride_scale, self.min_scale, self.max_scale, band=SCALE_BAND
        )
        ball = frame.world_from_model.apply(frame.pose.toe.pos)
        # What does not bear the body keeps its height over the floor as well.
        offset = ball - frame.world_from_model.pos
        body_up_ws = inputs.terrain.up_ws
        height = (1.0 - inputs.bearing) * vec.dot(offset, body_up_ws)
        offset = vec.reject(offset - vec.scale(body_up_ws, height), up_ws)
        ahead_ws, _ = heading(frame.world_from_model, up_ws)
        way = vec.normalize(vec.reject(frame.velocity_ws, up_ws), ahead_ws)
        across = vec.reject(offset, way)
        scaled = offset - vec.scale(across, 1.0 - self.width)
        return vec.scale(scaled, scale - 1.0)


def with_turned_pelvis(frame: Frame, turn: Turn) -> Frame:
    """The single frame with its legs on the turned pelvis."""
    legs = frame.weight.shape[-1]
    pose = frame.pose.transformed(about_up(turn.pelvis).repeat(legs))
    return dataclasses.replace(frame, pose=pose)


def with_turned_feet(frame: Frame, bearing: Array, turn: Turn) -> Frame:
    """The single frame on its turned pelvis, with feet that bear turned all the way."""
    rest = about_up((turn.feet - turn.pelvis) * bearing * jnp.ones_like(frame.weight))
    pose = frame.pose
    pose = dataclasses.replace(pose, ankle=rest @ pose.ankle, toe=rest @ pose.toe)
    return dataclasses.replace(frame, pose=pose)


def about_up(turn: Float[Array, "*b"]) -> Transform:
    """Turns about the root's up, model space, by these angles, rad."""
    up = vec.constant(UP, turn)
    return Transform(jnp.zeros((*turn.shape, 3), turn.dtype), quat.from_axis_angle(up, turn))
