"""How much of a sole the ground supports, and where along the foot it would support more."""

from abc import abstractmethod

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxik.maths import parameter_tree, vec
from jaxik.maths.parameter_tree import Leaf, option, parameter
from jaxik.maths.smoothing import lerp, smoothstep
from jaxik.stages.inputs import Inputs
from jaxik.world.frame import Stride
from jaxik.world.terrain import Hit

from .base import foot_heading
from .limits import climb
from .swing import AbstractSwingProbe, Level

# In fifths of a sole, from the ball: the points of a sole, and how far it may slide.
SOLE = np.arange(-4, 2)
SLIDES = np.arange(-2, 3)
LINE = np.arange(SOLE[0] + SLIDES[0], SOLE[-1] + SLIDES[-1] + 1)
EVEN, UNEVEN = 0.3, 0.7  # fifths, from the plane of the sole: ground that supports it, and does not
SHARE_FADE = 0.10  # of the sole, over which a sole begins to slide
SAME_SHARE = 0.01  # of the sole, by which supports hardly differ
SLIDE_COST = 0.03  # of the sole, to be gained by a slide of a fifth of it
TOO_FAR = 2.0  # of the sole, more than any slide gains
HEIGHT_COST = 0.1  # of the sole, to be gained by a slide to ground a fifth of it higher or lower


class AbstractSupportedProbe(AbstractSwingProbe):
    """The parameters of soles that slide to ground that supports them.

    Six points of a sole, from heel to tip, look for ground on the plane on which the foot stands.
    Where less than `min_sole` of it has some, the foot slides forward or back along itself to where
    more has, if it can without a change of height, as people place their feet on stairs. Ground
    that sticks out above the plane, as the stair behind a heel does, counts against the foot: on
    captured people a third of a sole hangs over an edge at times, but nothing cuts into it.

    Only footholds that the animation gives are moved: a prediction is off by as much as a slide.
    In a swing the slide goes from that of the last foothold to that of the next.
    """

    layers: Leaf = parameter_tree.layers()
    min_sole: Leaf = parameter(
        0.65,
        unit="1",
        low=0.0,
        high=1.0,
        doc="Share of a sole that the ground must support, or the foot slides to where it does.",
    )
    max_slide: Leaf = parameter(
        0.10,
        unit="m",
        low=0.0,
        high=0.2,
        doc="How far a foot slides to better support; longer slides count less and less.",
    )
    slide_to_support: bool = option(
        False, doc="Whether feet slide to better support, which takes three times as many rays."
    )

    @abstractmethod
    def ground_at(
        self, inputs: Inputs, level: Level, points_ws: Array, stood_on: bool = False
    ) -> Hit:
        """The ground above or below these points."""

    def better_support(
        self, inputs: Inputs, level: Level, stride: Stride, foot_height: Array
    ) -> tuple[Float[Array, "2 legs 3"], Float[Array, "2 legs"]]:
        """How far each foot slides from its last and its next foothold, and what supports it there.

        Args:
            inputs: the frame.
            level: of the character.
            stride: with the footholds; predicted ones stay.
            foot_height: of the ankles over the soles, m.

        Returns:
            The slides, m, world space, and the shares of the soles that are supported after them.
        """
        rig, up = inputs.rig, level.up_ws
        ahead, _ = foot_heading(inputs, up)
        rise = foot_height - self.ball_height
        ankle_to_ball = vec.safe_sqrt(rig.foot**2 - rise**2)
        spacing = (self.heel_length + ankle_to_ball + self.toe_length) / 5.0
        fifths = vec.safe_divide(jnp.ones_like(spacing), spacing)  # in a metre

        steps = vec.scale(ahead, spacing) * jnp.asarray(LINE, spacing.dtype)[:, None, None, None]
        footholds_ws = jnp.stack([stride.last_ws, stride.next_ws])
        foothold = self.ground_at(inputs, level, footholds_ws)
        starts = foothold.point + steps + vec.scale(up, self.max_step_up)
        reach = self.max_step_up + self.max_step_down
        line = self.find(inputs, starts, reach, self.layers)  # (points ends legs)
        heights = level.height(line.point)

        def fit(slide: int) -> tuple[Array, Array]:
            """Shares of a sole that slides so far that are supported, and that are blocked."""
            ball = slide - LINE[0]
            share, blocked = jnp.zeros_like(heights[0]), jnp.zeros_like(heights[0])
            climbs = climb(line.normal[ball], vec.scale(ahead, spacing), up)
            for point in SOLE:
                above = heights[ball + point] - heights[ball] - climbs * float(point)
                above *= line.found[ball + point] * fifths
                block = smoothstep((above - EVEN) / (UNEVEN - EVEN))
                hollow = smoothstep((-above - EVEN) / (UNEVEN - EVEN))
                share += line.found[ball + point] * (1.0 - block - hollow) / len(SOLE)
                blocked += block / len(SOLE)
            return share, blocked

        shares, blocked = (jnp.stack(x) for x in zip(*(fit(int(x)) for x in SLIDES), strict=True))
        slides = spacing * jnp.asarray(SLIDES, spacing.dtype)[:, None, None]
        fits = shares - blocked  # (slides ends legs)
        enough = jnp.where(fits < self.min_sole, fits, self.min_sole)
        other_ground = jnp.abs(heights[SLIDES - LINE[0]] - heights[-LINE[0]])
        cost = (SLIDE_COST * jnp.abs(slides) + HEIGHT_COST * other_ground) * fifths
        too_far = TOO_FAR * smoothstep((jnp.abs(slides) - self.max_slide) * fifths)
        worth = enough - cost - too_far
        choice = jax.nn.softmax(worth / SAME_SHARE, axis=0)
        need = stride.known * foothold.found
        need *= smoothstep((self.min_sole - fits[-SLIDES[0]]) / SHARE_FADE)
        support = lerp(shares[-SLIDES[0]], jnp.sum(choice * shares, 0), need)
        slide = need * jnp.sum(choice * slides, 0)
        return vec.scale(ahead, slide), foothold.found * support
