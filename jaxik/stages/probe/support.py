"""How much of a sole the ground supports, and where along the foot it would support more."""

import functools
from abc import abstractmethod

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxik.maths import parameter_tree, vec
from jaxik.maths.parameter_tree import Leaf, length, option, ratio
from jaxik.maths.smoothing import lerp, smoothstep
from jaxik.maths.struct import struct
from jaxik.stages.inputs import Inputs
from jaxik.world.terrain import Hit, cast

from .base import climb
from .swing import AbstractSwingProbe, Level

# In tenths of a sole, from the ball: the points of a sole, and how far it may slide.
SOLE = np.arange(-8, 3)
SLIDES = np.array([0, 1, -1, 2, -2, 3, -3, 4, -4])
LINE = np.arange(SOLE[0] + SLIDES.min(), SOLE[-1] + SLIDES.max() + 1)
EVEN, UNEVEN = 0.06, 0.14  # of the sole, from its plane: ground that supports it, and does not
BLOCKS = 4.0  # by which ground that sticks out counts against what supports
SLIDE_COST = 0.15  # of the sole that a slide by the whole of it has to gain
AHEAD = 0.1  # tenths of the sole, by which a place ahead counts as nearer: no two are equal
TOO_FAR = 6.0  # of the sole, more than any slide gains
FIFTH = 0.2  # of the sole, over which slides become too far
SHARE_BAND = 0.01  # of the sole
SAME_TREAD = 0.02  # m, from the height of a tread, within which ground is that tread


@struct
class Tread:
    """Ground on which a foot is already to land."""

    height: Float[Array, " legs"]
    """m, over the character's level."""
    preferred: Float[Array, " legs"]
    """How much more of a sole other ground has to support."""
    at_edge: Float[Array, " legs"]
    """Of the sole, that a place costs whose ball is at an edge."""


@struct
class Support:
    """What supports the sole at a foothold from which it slides."""

    slide: Float[Array, "*b legs"]
    """m, ahead."""
    share: Float[Array, "*b legs"]
    """0..1, of the sole."""
    height: Float[Array, "*b legs"]
    """m, of the ground below the ball over the character's level."""


class AbstractSupportedProbe(AbstractSwingProbe):
    """The parameters of soles that slide to ground that supports them.

    Eleven points of a sole, from heel to tip, look for ground on the plane on which it stands.
    Where less than `min_sole` of it has some, or the ball is on ground that is refused, such as a
    riser, the foot slides forward or back along itself to the nearest place that holds it, as
    people place their feet on stairs, on whatever tread that is. Ground that sticks out above the
    plane, as the stair behind a heel does, counts against the foot four times: on captured people a
    third of a sole hangs over an edge at times, but nothing cuts into it.

    A foot that is sent to a predicted foothold keeps its ball off edges by a tenth of its sole.
    Footholds that are predicted from a single frame stay: they are off by as much as a slide. In a
    swing the slide goes from that of the last foothold to that of the next.
    """

    layers: Leaf = parameter_tree.layers()
    min_sole: Leaf = ratio(
        0.65,
        0,
        1,
        "Share of a sole that the ground must support, or the foot slides to where it does.",
    )
    max_slide: Leaf = length(
        0.1, 0, 0.2, "How far a foot slides to better support; longer slides count less and less."
    )
    slide_to_support: bool = option(
        False, "Whether feet slide to better support, which takes three times as many rays."
    )

    @abstractmethod
    def ground_at(
        self, inputs: Inputs, level: Level, points_ws: Array, stood_on: bool = False
    ) -> Hit:
        """The ground above or below these points."""

    @abstractmethod
    def margin_at(self, level: Level, points_ws: Array) -> Array:
        """How much higher and lower than a step the ground may be there, m."""

    def better_support(
        self,
        inputs: Inputs,
        level: Level,
        footholds_ws: Float[Array, "ends legs 3"],
        ahead_ws: Float[Array, "ends legs 3"],
        foot_height: Array,
        known: Float[Array, " legs"],
        tread: Tread | None = None,
    ) -> Support:
        """How far each foot slides from footholds to better support.

        Args:
            inputs: the frame.
            level: of the character.
            footholds_ws: of the balls, m; their height says nothing.
            ahead_ws: unit, where the feet point there.
            foot_height: of the ankles over the soles, m.
            known: 0..1, whether a leg's feet may slide.
            tread: what each foot prefers; None has no preference.
        """
        rig, up, gate = inputs.rig, level.up_ws, inputs.gate
        rise = foot_height - self.ball_height
        ankle_to_ball = vec.safe_sqrt(rig.foot**2 - rise**2)
        sole = self.heel_length + ankle_to_ball + self.toe_length  # m
        tenth = 0.1 * sole

        foothold = self.ground_at(inputs, level, footholds_ws)
        margin = self.margin_at(level, footholds_ws)
        # From where a step up from the foothold or from the character's level ends, so that in a
        # gap its rims are seen, down to where a step down from the foothold ends.
        height = level.height(foothold.point)
        above = lerp(margin, jnp.where(height > 0, height, 0.0), foothold.found)
        below = lerp(-margin, height, foothold.found)
        steps = vec.scale(ahead_ws, tenth) * jnp.asarray(LINE, tenth.dtype)[:, None, None, None]
        starts = level.project(footholds_ws) + steps
        starts += vec.scale(up, self.max_step_up + above)
        reach = self.max_step_up + self.max_step_down + above - below
        line = cast(inputs.terrain, starts, reach + jnp.zeros_like(starts[..., 0]), self.layers)
        heights = level.height(line.point)  # (points ends legs)
        firm = line.found * self.trust_from(level.origin_ws, line, up, margin)
        heights, firm = vec.stacked_barrier(heights, firm)

        # All places in one array: one after another they made the program of `stride` 40 % longer.
        tenths = np.sort(SLIDES)[:, None, None]

        def at(values: Array, point: int = 0) -> Array:
            """Values at a point of the sole in each place, (places ends legs)."""
            first = int(SLIDES.min() - LINE[0]) + point
            return values[first : first + len(SLIDES)]

        share, blocked = jnp.zeros_like(at(heights)), jnp.zeros_like(at(heights))
        inside = jnp.ones_like(share)
        climbs = climb(at(line.normal), vec.scale(ahead_ws, tenth), up)
        for point in map(int, SOLE):
            above = at(heights, point) - at(heights) - climbs * point
            above *= vec.safe_divide(at(line.found, point), sole)
            block = smoothstep((above - EVEN) / (UNEVEN - EVEN))
            hollow = smoothstep((-above - EVEN) / (UNEVEN - EVEN))
            supported = at(line.found, point) * (1.0 - block - hollow)
            share += supported
            blocked += block
            if abs(point) == 1:
                inside *= supported
        (share,) = vec.stacked_barrier(share)
        share, blocked = share / len(SOLE), blocked / len(SOLE)
        slide = jnp.asarray(tenths, tenth.dtype) * tenth + jnp.zeros_like(share)
        lack = self.min_sole - at(firm) * (share - BLOCKS * blocked)
        detour = jnp.asarray(SLIDE_COST * 0.1 * np.abs(tenths - AHEAD), tenth.dtype)
        too_far = smoothstep((jnp.abs(slide) - self.max_slide) / (FIFTH * sole))
        too_far = jnp.where(tenths, lerp(jnp.ones_like(too_far), too_far, known), too_far)
        cost = jnp.where(lack > 0, lack, 0.0) + detour + TOO_FAR * too_far
        if tread is not None:
            off = jnp.abs(at(heights) - tread.height)
            elsewhere = smoothstep((off - SAME_TREAD) / SAME_TREAD)
            cost += tread.preferred * (1.0 - at(firm) * (1.0 - elsewhere))
            cost += tread.at_edge * (1.0 - inside)
        (cost,) = vec.stacked_barrier(cost)
        places = cost, slide, at(firm) * share, at(heights)

        def cheaper(nearer: tuple[Array, ...], farther: tuple[Array, ...]) -> tuple[Array, ...]:
            stays = gate.below(nearer[0], farther[0], band=SHARE_BAND)
            return tuple(gate.choose(stays, *x) for x in zip(nearer, farther, strict=True))

        nearest_first = [tuple(x[i] for x in places) for i in SLIDES - SLIDES.min()]
        return Support(*functools.reduce(cheaper, nearest_first)[1:])
