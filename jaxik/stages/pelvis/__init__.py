"""Stage 9: how far the body sinks or rises so that its legs can reach the ground.

`base` has the abstract rule and its memory, `games` the rules of ozz, Unreal, Mec and the record,
`people` those modelled on people. To write a rule, start with `base.AbstractPelvis`, or with
`people.AbstractFollowingPelvis`, which needs no more than a goal.
"""

from .base import AbstractPelvis as AbstractPelvis
from .base import PelvisMoment as PelvisMoment
from .base import PelvisState as PelvisState
from .base import mean_height as mean_height
from .base import requested_heights as requested_heights
from .base import rise_to_length as rise_to_length
from .games import CapsulePelvis as CapsulePelvis
from .games import LegLengthPelvis as LegLengthPelvis
from .games import LowestPelvis as LowestPelvis
from .people import AbstractFollowingPelvis as AbstractFollowingPelvis
from .people import ReachPelvis as ReachPelvis
from .people import SupportPelvis as SupportPelvis
