"""Stage 4: rays that find the ground under each foot.

`base` has the abstract rules, what all share, and which ground is refused, `games` the rules of
ozz, Unreal, Mec and the record, `stride` the one that looks ahead to the next foothold. To write a
rule, start with `base.AbstractProbe`, or with `base.AbstractLimitedProbe`.
"""

from .base import AbstractLimitedProbe as AbstractLimitedProbe
from .base import AbstractProbe as AbstractProbe
from .base import climb as climb
from .base import foot_heading as foot_heading
from .base import make_rays as make_rays
from .base import no_hit as no_hit
from .base import toe_point as toe_point
from .games import CornerProbe as CornerProbe
from .games import FootProbe as FootProbe
from .games import RootProbe as RootProbe
from .stride import StrideProbe as StrideProbe
