"""A game engine's binary foot-IK parameter record: its bytes, a CSV form, and its parameters.

The layout is little-endian: u8 knee axis at 0x0, flags in bits 0-2 at 0x1 (bits 3-7 are padding),
two bytes of padding, 31 consecutive f32 from 0x04 to 0x7c, and from 0x80 a tail of unknown length.
Everything that is read is kept, so that writing gives the same bytes again. Only this package knows
the record's spelling and units; `Reading` says how fields that are open to doubt are understood.

`layout` has the bytes, `parameters` their meaning, `table` the CSV form. Start with `layout`.
"""

from .layout import FLAG_NAMES as FLAG_NAMES
from .layout import FLAGS as FLAGS
from .layout import FLOAT_NAMES as FLOAT_NAMES
from .layout import FLOATS as FLOATS
from .layout import KNEE_AXIS_NAMES as KNEE_AXIS_NAMES
from .layout import PARAMETERS as PARAMETERS
from .layout import SIZE as SIZE
from .layout import Record as Record
from .layout import besides_parameters as besides_parameters
from .layout import from_bytes as from_bytes
from .layout import knee_axis as knee_axis
from .layout import to_bytes as to_bytes
from .parameters import Reading as Reading
from .parameters import dropped as dropped
from .parameters import from_ik as from_ik
from .parameters import to_ik as to_ik
from .parameters import with_knee_axis as with_knee_axis
from .table import COLUMNS as COLUMNS
from .table import from_csv as from_csv
from .table import to_csv as to_csv
