"""C3D files: markers become joints.

`structure` reads the bytes, `markers` what is known of the points, `marker_sets` makes joint
centres of them, `plug_in_gait` those of Vicon's lower-body marker set, and `reader` puts a
`Recording` together.

Start with `reader.read_c3d`.
"""

from .marker_sets import joint_name as joint_name
from .reader import draft_marker_map as draft_marker_map
from .reader import read_c3d as read_c3d
