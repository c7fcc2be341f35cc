"""`load_clip`: opens a motion file with the reader that its suffix selects."""

from collections.abc import Mapping
from pathlib import Path

from fitting.runtime.validation import check_file

from . import formats
from .assemble import Overrides, clip_from_recording
from .clip import Clip
from .formats.asfamc import read_asfamc
from .formats.npz import read_npz


def load_clip(
    path: str | Path,
    *,
    asf: str | Path | None = None,
    scale: float | None = None,
    fps: float | None = None,
    up: str | None = None,
    joints: Mapping[str, str] | None = None,
    variant: str = "captured",
) -> Clip:
    """Reads a BVH, AMC (with its ASF) or NPZ file as a clip in metres with y up.

    Args:
        path: the file; its suffix selects the format.
        asf: skeleton of an AMC file; None looks for it in the same folder.
        scale: metres per unit of the file. None takes it from the file if it states one (ASF), and
            otherwise the unit that makes the legs most similar to an adult's.
        fps: frames per second; None takes the file's, rounded to the nearest common rate.
        up: "y" or "z"; None takes the axis along which the pelvis is above the feet.
        joints: role to joint name, see `joint_roles.find_roles`; None recognises the names.
        variant: which clip of a file of the `blocks` benchmark: "captured" or "base", the flat
            animation.

    Returns:
        The clip; its `remarks` list every guess. A file without recognised legs loads, and its
        `rig` raises.

    Raises:
        ValueError: no such file, an unknown format, a file that is not what its suffix promises
            (with the line, for text formats), an argument out of range or of another format, or
            names in `joints` that the file lacks.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (*formats.READERS, ".npz"):
        raise ValueError(f"{path}: wanted a {', '.join(formats.READERS)} or .npz file")
    check_file(path)
    overrides = Overrides(scale, fps, up, joints)
    if suffix == ".npz":
        arguments = {"asf": asf, **vars(overrides)}
        if unused := [name for name, value in arguments.items() if value is not None]:
            raise ValueError(f"{path}: {unused} do not apply to .npz clips, which state all that")
        return read_npz(path, variant)
    if variant != "captured":
        raise ValueError(f"{path}: only blocks .npz files have the variant {variant!r}")
    if asf is not None and suffix == ".amc":
        recording = read_asfamc(path, Path(asf))
    else:
        recording = formats.READERS[suffix](path)
    return clip_from_recording(recording, path.name, overrides)
