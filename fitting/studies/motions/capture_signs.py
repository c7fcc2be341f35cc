"""What the clips of a fit show of captures that are not as they seem."""

from collections.abc import Sequence
from typing import NamedTuple

from fitting.analysis import measures, placement
from fitting.analysis.capture_signs import ground, lag
from fitting.analysis.capture_signs.ground import GroundOffset
from fitting.analysis.playback import Playback
from fitting.experiments.problems import ClipData

from .placed_motion import with_soles_of


class CaptureSigns(NamedTuple):
    """What one clip shows."""

    ground: GroundOffset
    """Of the captured soles from the ground, as its file has it."""
    lag: float
    """s, by which the capture is later than the fitted motion; 0 where that is not clear."""


def find(clips: Sequence[ClipData], playbacks: Sequence[Playback]) -> list[CaptureSigns]:
    """The signs of each clip.

    Args:
        clips: with whole skeletons; without them nothing is looked for.
        playbacks: of the same clips, with the fitted system.
    """
    return [
        CaptureSigns(_of_ground(clip), lag.measure(play))
        for clip, play in zip(clips, playbacks, strict=False)
    ]


def _of_ground(clip: ClipData) -> GroundOffset:
    captured = with_soles_of(clip.reference, clip.base)
    feet = placement.soles(captured, clip.base, clip.terrain)
    places = measures.soles(captured).mean(axis=2)[..., [0, 2]]
    return ground.measure(feet.gap, places, clip.reference.stance_labels())
