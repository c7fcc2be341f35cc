"""Flight: when a character is in the air, from the motion of its feet alone.

Runners leave the ground for less than 0.2 s in each step; foot IK goes on there, for the next
foothold. In a jump it has to stop: feet that are pulled to the ground far below would stretch the
legs and pull the body down.
"""

import numpy as np
from jaxtyping import Float64

from . import contacts
from .clip import Clip

CLEARANCE = 0.03  # of a leg's length: a foot of a character in the air is higher above its floor
PEAK = 0.10  # of a leg's length, that the lowest foot of a jump reaches
SHORTEST = 0.25  # s, longer than the flight of a runner
LANDING = 0.1  # s before feet reach their floor, in which they prepare for the ground they meet
MOST_SPANS = 4  # that are listed


def grounded_track(clip: Clip) -> Float64[np.ndarray, " frames"]:
    """0..1 in each frame, 0 in the air: what the clip says, or else found from its feet.

    The floor is where feet stand, interpolated between stances. A clip in which no foot ever stands
    is on the ground all the time.
    """
    if clip.grounded is not None:
        return clip.grounded
    if clip.cuts:
        return np.concatenate([grounded_track(clip.select(piece)) for piece in clip.pieces])
    grounded = np.ones(clip.frame_count)
    stances = clip.stance_labels().any(axis=1)
    if not stances.any():
        return grounded
    rig = clip.rig
    soles = np.minimum(
        clip.joints_ws(2)[..., 1] - np.asarray(rig.ankle_height),
        clip.joints_ws(3)[..., 1] - np.asarray(rig.ball_height),
    ).min(axis=1)
    frames = np.arange(clip.frame_count)
    floor = np.interp(frames, frames[stances], soles[stances])
    height = (soles - floor) / float(np.mean(np.asarray(rig.thigh + rig.shin)))
    for first, last in contacts.runs((height > CLEARANCE) & ~stances):
        long_enough = last - first + 1 >= SHORTEST * clip.fps
        if long_enough and height[first : last + 1].max() > PEAK:
            grounded[first : last + 1 - round(LANDING * clip.fps)] = 0.0
    return grounded


def describe(clip: Clip) -> str:
    """When the clip is in the air, where foot IK leaves it alone; "" for one that never is."""
    spans = contacts.runs(grounded_track(clip) < 1.0)
    if not spans:
        return ""
    times = [f"{first / clip.fps:.2f} to {last / clip.fps:.2f}" for first, last in spans]
    more = f" and {len(spans) - MOST_SPANS} more" if len(spans) > MOST_SPANS else ""
    source = "found from its feet" if clip.grounded is None else "as its track says"
    return f"no foot IK in the air ({source}): {', '.join(times[:MOST_SPANS])} s{more}"
