"""Coloured line segments over frames, of which everything that moves is drawn."""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8

Colour: TypeAlias = tuple[int, int, int]
"""RGB, 0..255."""


class Lines(NamedTuple):
    """Segments in each frame; what is not there in a frame has no length."""

    points: Float[np.ndarray, "frames lines 2 3"]
    """m, both ends."""
    colours: UInt8[np.ndarray, "frames lines 2 3"]
    """RGB of both ends."""


def lines(
    starts: Float[np.ndarray, "frames *n 3"],
    ends: Float[np.ndarray, "frames *n 3"],
    colours: Colour | UInt8[np.ndarray, "frames *n 3"],
) -> Lines:
    """Lines between points, m, in one colour or a colour for each."""
    points = np.stack([starts, ends], axis=-2)
    each = np.broadcast_to(np.asarray(colours, np.uint8), starts.shape)
    both = np.broadcast_to(each[..., None, :], points.shape)
    frames = len(points)
    return Lines(points.reshape(frames, -1, 2, 3), both.reshape(frames, -1, 2, 3).copy())


def crosses(
    points: Float[np.ndarray, "frames n 3"],
    present: Float[np.ndarray, "frames n"],
    arm: float,
    colour: Colour,
) -> Lines:
    """A cross of three lines at each point that is present.

    Args:
        points: m.
        present: above a half where there is something to show.
        arm: m, half the length of a line.
        colour: of all.
    """
    arms = arm * np.eye(3) * (present > 0.5)[..., None, None]
    return lines(points[..., None, :] - arms, points[..., None, :] + arms, colour)


def joined(*parts: Lines) -> Lines:
    """Lines side by side, over the same frames."""
    return Lines(*(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True)))
