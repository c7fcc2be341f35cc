"""What is wrong with feet in plain sight: how deep they are in the ground, how far they slide."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from fitting.analysis import measures
from fitting.analysis.placement import SLIDE_LIMIT, VISIBLE, Soles
from fitting.datasets.clips import Clip, contacts
from jaxik.world import body

IN_GROUND, SLIDES = (230, 30, 30), (214, 39, 214)  # colours, RGB


@dataclass(frozen=True)
class Sight:
    """What a viewer sees of each foot in each frame."""

    depth: Float64[np.ndarray, "frames legs"]
    """m in the ground, 0 above it and without any."""
    slide: Float64[np.ndarray, "frames legs"]
    """m, horizontal path of the ball since its stance began, beyond the animated one; 0 in a
    swing."""
    size: float = 1.0
    """Length of the legs relative to an adult's: what is visible is as many times as large."""

    @property
    def sunk(self) -> Float64[np.ndarray, "frames legs"]:
        """How far a foot is in the ground, 0..1; 1 where `placement` counts it."""
        return np.clip(self.depth / (VISIBLE * self.size), 0.0, 1.0)

    @property
    def slid(self) -> Float64[np.ndarray, "frames legs"]:
        """How far a standing foot has slid, 0..1; 1 at the limit of `placement`."""
        return np.clip(self.slide / (SLIDE_LIMIT * self.size), 0.0, 1.0)

    def colours(self, plain: tuple[int, int, int]) -> UInt8[np.ndarray, "frames legs 3"]:
        """The colour of each foot: plain, the redder the deeper, the more purple the further slid.

        Args:
            plain: of a foot with nothing wrong, RGB.
        """
        colours = np.full((*self.depth.shape, 3), plain, np.float64)
        for share, colour in ((self.slid, SLIDES), (self.sunk, IN_GROUND)):
            colours += share[..., None] * (np.array(colour) - colours)
        return np.round(colours).astype(np.uint8)


def seen(feet: Soles, motion: Clip, animated: Clip) -> Sight:
    """What a viewer sees of the feet of a motion.

    Args:
        feet: of the motion.
        motion: over the same frames.
        animated: whose slides are not counted.
    """
    depth = np.maximum(-np.nan_to_num(feet.gap), 0.0)
    steps = measures.horizontal_steps(motion.joints_ws(3), motion.cuts)
    steps = steps - measures.horizontal_steps(animated.joints_ws(3), animated.cuts)
    slide = np.zeros(depth.shape)
    for leg in range(len(motion.rig.names)):
        for first, last in contacts.runs(feet.stance[:, leg]):
            slide[first + 1 : last + 1, leg] = np.cumsum(steps[first:last, leg])
    slide[~feet.stance] = 0.0
    return Sight(depth, np.maximum(slide, 0.0), body.ratio(motion.rig))
