"""Motion clips: reading, understanding, editing and saving them.

A clip goes through three stages. A reader in `formats` turns a file into a `Recording`, in the
file's own unit and axes. `assemble` finds scale, up axis, frame rate and legs, and measures the
rig. The result is a `Clip`, in metres with y up, which `edit` changes and `save_clip` stores.

What is not here: the flat animation below a captured motion (`fitting.datasets.flat_animation`) and
the frames that the foot IK pipeline takes (`fitting.datasets.clip_frames`).

Start with `clip.Clip` and `load.load_clip`. To add a file format read `formats`; to add a joint
naming convention, `joints`.
"""

from .clip import Clip as Clip
from .formats.saving import save_clip as save_clip
from .load import load_clip as load_clip
