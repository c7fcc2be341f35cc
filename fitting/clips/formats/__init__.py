"""Readers of motion files, one module per format, and the table that maps suffixes to them.

A reader takes a `pathlib.Path` and returns a `clips.clip.Recording`, in the file's own unit
and axes. The strings below the fields of `Recording` (in the source, or in the API reference) state
what each field holds. A reader raises `ValueError` with the path, and for a text format the line
number, where the file is not what its suffix promises. `bvh.read_bvh` is a complete example.

The suffix and the function go into `READERS` below; `load_clip`, its messages and every command
that takes a clip then accept the format. "How to add a clip format" in fitting/clips/README.md has
all steps, with an example.

`saving.save_clip` writes clips, as `npz` or by the modules named `writer`.

`npz` differs: an archive holds a complete clip, so its reader returns a `Clip`, not a `Recording`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

from fitting.clips.clip import Recording

from .asfamc import read_asfamc
from .bvh import read_bvh
from .gltf import read_gltf
from .markers import READERS as OF_POINTS
from .markers import read_marked

READERS: Mapping[str, Callable[[Path], Recording]] = {
    ".bvh": read_bvh,
    ".amc": read_asfamc,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    **dict.fromkeys(OF_POINTS, read_marked),
}
