"""Strides scaled for a character that is faster or slower than its animation, before the probe."""

from jaxtyping import Array, Float

from jaxik.maths import vec
from jaxik.maths.parameter_tree import Leaf, Rule, ratio
from jaxik.world.frame import heading

from .inputs import Inputs

SCALE_BAND = 0.02


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
    """

    min_scale: Leaf = ratio(0.4, 0, 1, "Shortest strides, as a part of the animated ones.")
    max_scale: Leaf = ratio(1.5, 1, 2.5, "Longest strides, as a multiple of the animated ones.")
    width: Leaf = ratio(1, 0, 1, "How much the width of steps is scaled with their length.")

    def sense(self, inputs: Inputs) -> Float[Array, "legs 3"] | None:
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
