"""The systems that exist elsewhere, as choices of rules."""

from .contact import HeightContact
from .foot import PitchRollFoot
from .lean import SlopeLean
from .leg import TwoBone
from .lock import OffsetLock
from .pelvis import LowestPelvis
from .pipeline import FootIK
from .probe import FootProbe
from .target import SlopeTarget


def record() -> FootIK:
    """The game's foot-IK parameter record (systems.md, 4), for a 1.8 m adult."""
    return FootIK(
        probe=FootProbe(),
        contact=HeightContact(),
        target=SlopeTarget(),
        lean=SlopeLean(),
        lock=OffsetLock(),
        pelvis=LowestPelvis(),
        leg=TwoBone(),
        foot=PitchRollFoot(),
    )
