"""Motion clips: reading, understanding, editing and saving them.

A clip goes through three stages. A reader in `formats` turns a file into a `Recording`, in the
file's own unit and axes. `assemble` finds scale, up axis, frame rate and legs, and measures the
rig. The result is a `Clip`, in metres with y up, which `edit` changes and `save_clip` stores.
`contacts` says when feet stand, `clip_frames` turns a clip into the input of the foot IK pipeline.

The flat animation below a captured motion is in `fitting.motion.flat_animation`.

Start with `clip.Clip` and `load.load_clip`. To add a file format read `formats`; to add a joint
naming convention, `joint_maps`.
"""

from .clip import Clip as Clip
from .formats.saving import save_clip as save_clip
from .load import load_clip as load_clip
