"""Readers of motion files, one module per format, and the table that maps suffixes to them.

To add a format:

1. Write a module here with a function that takes a `pathlib.Path` and returns a
   `clips.recording.Recording`: joint names, parents, rest offsets, local positions and local
   rotations, in the file's own unit and axes. The docstring of `Recording` states each field. Do
   not guess scale, up axis, frame rate or legs; `clips.assemble` does that for all formats.
2. Raise `ValueError` with the path, and for a text format the line number, where the file is not
   what its suffix promises. `bvh.read_bvh` is a complete example.
3. Add the suffix and the function to `READERS` below. `load_clip`, its messages and every command
   that takes a clip then accept the format.
4. If a joint naming convention is new, add a line to `clips.joint_roles.DIALECTS`.

`tests/datasets/test_clip_formats.py` adds a format of a few lines and loads a clip with it;
`tests/datasets/test_clips_bvh.py` shows what a reader should be tested for.

`npz` differs: an archive holds a complete clip, so its reader returns a `Clip`, not a `Recording`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from fitting.datasets.clips.recording import Recording

from .asfamc import read_asfamc
from .bvh import read_bvh

READERS: Mapping[str, Callable[[Path], Recording]] = {
    ".bvh": read_bvh,
    ".amc": read_asfamc,
}
