"""Stage 7: locks that keep standing feet in place in the world.

`base` has the abstract rule, `offset` the lock of the record, `plant` that of Mec. To write a rule,
start with `base.AbstractLock`.
"""

from .base import AbstractLock as AbstractLock
from .base import Hold as Hold
from .base import NoLock as NoLock
from .offset import LockState as LockState
from .offset import OffsetLock as OffsetLock
from .plant import PlantLock as PlantLock
from .plant import PlantState as PlantState
