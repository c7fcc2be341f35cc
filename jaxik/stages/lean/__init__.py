"""Stage 6: how the body leans on slopes.

`base` has the abstract rule, `slope` the lean of the record, which tilts the whole body, `spine`
that of people, which bends the spine. To write a rule, start with `base.AbstractLean`.
"""

from .base import AbstractLean as AbstractLean
from .base import Lean as Lean
from .base import LeanState as LeanState
from .base import NoLean as NoLean
from .slope import SlopeLean as SlopeLean
from .spine import SpineLean as SpineLean
