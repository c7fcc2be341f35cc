"""Swings that the start of a clip cuts off, on ground that is higher where they began.

Such a foot has left a foothold that the clip does not show. Without it, the foot swings at the
height of its next foothold: down stairs, through those that it comes from.
"""

from dataclasses import replace

import jax
import numpy as np

import jaxik
from jaxik.world.terrain import Terrain

from .clips import contacts
from .clips.clip import Clip
from .ground_path import SKY, heights_under


def with_cut_off_swings(frames: jaxik.Frame, clip: Clip, terrain: Terrain) -> jaxik.Frame:
    """The frames with the footholds that feet have left before the clip or a piece of it begins.

    Each is as far behind the next one as the foot's first whole swing goes, on the line over the
    ball in the first frame, if the ground there is higher than at the next one. Lower ground does
    not count: where ground was made of a clip's footholds, it is not known there.

    Args:
        frames: of the clip.
        clip: y up.
        terrain: y up.
    """
    stance, balls_ws = clip.stance_labels(), clip.joints_ws(3)
    last_ws, fraction = np.array(frames.stride.last_ws), np.array(frames.stride.fraction)
    swings = [
        (slice(piece.start, piece.start + len(swing.fraction)), leg, swing)
        for piece in clip.pieces
        for leg in range(stance.shape[1])
        if (swing := contacts.cut_off_swing(balls_ws[piece, leg], stance[piece, leg])) is not None
    ]
    if not swings:
        return frames
    ends_ws = np.array([[swing.last_ws, swing.next_ws] for _, _, swing in swings])
    for (before, leg, swing), (last, following) in zip(
        swings, heights_under(terrain, ends_ws, SKY), strict=True
    ):
        if last > following:
            last_ws[before, leg], fraction[before, leg] = swing.last_ws, swing.fraction
    stride = replace(
        frames.stride, last_ws=jax.device_put(last_ws), fraction=jax.device_put(fraction)
    )
    return replace(frames, stride=stride)
