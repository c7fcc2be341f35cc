"""`load_clip`: opens a motion file with the reader that its suffix selects."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fitting.runtime.declarations import key, keys
from fitting.runtime.validation import check_file

from . import edit, formats
from .assemble import clip_from_recording
from .clip import Clip, Recording
from .formats.asfamc import read_asfamc
from .formats.gltf import SUFFIXES as GLTF
from .formats.gltf import read_gltf
from .formats.markers import draft_marker_map, is_marked, joint_name, read_marked
from .formats.npz import read_npz
from .joint_maps import read_joint_map, template
from .skating import TRAVELS, Travel
from .stances import contacts_path, load_stances

JointMap = Mapping[str, str] | str | Path
"""Role to joint name, see `joint_maps.find_roles`; or a file that `clips.joint_maps` reads."""


@dataclass(frozen=True, kw_only=True)
class ClipOptions:
    """What the user knows better than a motion file; None leaves it to be read or guessed.

    The fields are arguments of `load_clip`.
    """

    joints: Path | Mapping[str, str] | None = key(
        None,
        "Which joint of reference and base is which: a map of joints.",
        wanted="a file, or a table of joint names by role",
    )
    scale: float | None = key(
        None, "Metres per unit of reference and base; left out, guessed.", "", 1e-9, 1e6
    )
    up: Literal["y", "z"] | None = key(None, "Up axis of reference and base; left out, guessed.")
    asf: Path | None = key(None, "The skeleton of an .amc, where it is not beside it.")
    animation: str | None = key(None, "Which animation of a .glb or .gltf that has several.")
    travel: Travel | None = key(
        None,
        "Whether the roots of reference and base are moved so that standing feet stay put, or left,"
        " or moved where the clip is clearly a cycle in place; left out, auto.",
    )
    sole: float | None = key(
        None,
        "Height of the balls of reference and base over their soles; left out, measured or"
        " estimated.",
        "m",
        0,
        10,
    )

    def of_file(self, path: Path) -> "ClipOptions":
        """Those that a file of this format takes, where several files share the options."""
        suffix = path.suffix.lower()
        if _is_saved_clip(path):
            return ClipOptions(sole=self.sole)
        other = [("asf", {".amc"}), ("animation", GLTF)]
        taken = {name: None for name, suffixes in other if suffix not in suffixes}
        return ClipOptions(**(self.given | taken))

    @property
    def given(self) -> dict[str, Any]:
        """The options that are not None, by name."""
        values = {name: getattr(self, name) for name in keys(ClipOptions)}
        return {name: value for name, value in values.items() if value is not None}

    def check_use(self, files: Iterable[Path], where: str) -> None:
        """Raises ValueError for an option that none of these files takes.

        Args:
            files: clips that share the options.
            where: what they belong to, for the message.
        """
        taken = {name for file in files for name in self.of_file(file).given}
        if unused := sorted(set(self.given) - taken):
            raise ValueError(
                f"{where}: {unused[0]} is of no use: an .npz states all but --sole itself, only an "
                ".amc has an .asf, and only a .glb or .gltf an animation to choose"
            )


AS_FOUND = ClipOptions()
"""All is recognised or guessed."""


def load_clip(
    path: str | Path,
    *,
    asf: str | Path | None = None,
    scale: float | None = None,
    fps: float | None = None,
    up: str | None = None,
    joints: JointMap | None = None,
    animation: str | None = None,
    travel: str | None = None,
    sole: float | None = None,
    contacts: str | Path | bool = True,
) -> Clip:
    """Reads a motion file as a clip in metres with y up.

    Those of joints with rotations are BVH, AMC (with its ASF), glTF and GLB, those of places alone
    C3D, TRC, CSV and NPY; an NPZ is a saved clip, or has an array `positions` (frames, joints, 3),
    at best with `names` and `fps`.

    Args:
        path: the file; its suffix selects the format.
        asf: skeleton of an AMC file; None looks for it in the same folder.
        scale: metres per unit of the file. None takes it from the file if it states one (ASF), and
            otherwise the unit that makes the legs most similar to an adult's.
        fps: frames per second; None takes the file's, rounded to the nearest common rate. A glTF
            animation is sampled at this rate, and any other plays as fast as it says.
        up: "y" or "z"; None takes the axis along which the pelvis is above the feet.
        joints: role to joint name, see `joint_maps.find_roles`, or a joint map, see
            `clips.joint_maps`; None recognises the names. Of a C3D, TRC, CSV or NPY file it names
            markers, see `clips.formats.markers.read_marked`.
        animation: which animation of a glTF file; None takes the only one.
        travel: "stances" moves the root so that standing feet stay where they stand, "none" leaves
            it, and "auto", or None, moves it in a cycle that is clearly in place.
        sole: m, of the balls of flat feet over their soles; None measures it over a floor at height
            0, or estimates it from the feet's length.
        contacts: a contacts file, see `clips.stances`; True takes the one beside the clip, if there
            is one, and False none.

    Returns:
        The clip; its `remarks` list every guess. A file without recognised legs loads, and its
        `rig` raises.

    Raises:
        ValueError: no such file, an unknown format, a file that is not what its suffix promises
            (with the line, for text formats), an argument out of range or of another format, or
            names in `joints` that the file lacks; or a contacts file that is damaged or belongs
            to another clip.
    """
    path = Path(path)
    _check_arguments(path, asf, animation)
    if isinstance(joints, str | Path):
        joints = read_joint_map(Path(joints))
    _check_values(scale, fps, up, travel)
    stated: dict[str, Any] = {
        "scale": scale,
        "fps": fps,
        "up": up,
        "joints": joints,
        "travel": travel,
    }
    if _is_saved_clip(path):
        arguments = {**stated, "animation": animation}
        if unused := [name for name, value in arguments.items() if value is not None]:
            raise ValueError(f"{path}: {unused} do not apply to .npz clips, which state all that")
        return edit.on_floor(with_contacts(read_npz(path), path, contacts), 0.0, sole)
    if is_marked(path):
        recording = read_marked(path, joints, scale)
        if joints is not None:  # which named markers
            stated["joints"] = {role: joint_name(role) for role in joints}
    else:
        recording = _read(path, asf, animation, fps)
    clip = clip_from_recording(recording, path.name, **stated)
    return edit.on_floor(with_contacts(clip, path, contacts), 0.0, sole)


def with_contacts(clip: Clip, path: Path, contacts: str | Path | bool = True) -> Clip:
    """The clip of a file with the stances of its contacts file.

    Args:
        clip: as its own file has it.
        path: that file.
        contacts: as for `load_clip`, which also says what is raised.
    """
    if isinstance(contacts, bool):
        beside = contacts_path(path)
        return load_stances(beside, clip) if contacts and beside.exists() else clip
    return load_stances(Path(contacts), clip)


def _is_saved_clip(path: Path) -> bool:
    """Whether a file is an archive that states all of a clip."""
    return path.suffix.lower() == ".npz" and not is_marked(path)


def _check_values(
    scale: float | None, fps: float | None, up: str | None, travel: str | None
) -> None:
    if up not in (None, "y", "z"):
        raise ValueError(f"up is {up!r}; wanted 'y' or 'z'")
    if travel not in (None, *TRAVELS):
        raise ValueError(f"travel is {travel!r}; wanted one of {', '.join(TRAVELS)}")
    for name, value in (("scale", scale), ("fps", fps)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}; wanted a number above 0")


def _check_arguments(path: Path, asf: str | Path | None, animation: str | None) -> None:
    """ValueError for no such file, an unknown format, or an argument of another format."""
    suffix = path.suffix.lower()
    if suffix not in (*formats.READERS, ".npz"):
        raise ValueError(f"{path}: wanted a {', '.join(formats.READERS)} or .npz file")
    check_file(path)
    if asf is not None and suffix != ".amc":
        raise ValueError(f"{path}: only an .amc has its skeleton in an .asf; got {asf}")
    if animation is not None and suffix not in (*GLTF, ".npz"):
        raise ValueError(f"{path}: only glTF files have an animation to choose, {animation!r}")


def _read(
    path: Path, asf: str | Path | None, animation: str | None, fps: float | None = None
) -> Recording:
    """The contents of a file that holds joints."""
    if path.suffix.lower() in GLTF:
        return read_gltf(path, animation, fps)
    if asf is not None:
        return read_asfamc(path, Path(asf))
    return formats.READERS[path.suffix.lower()](path)


def draft_joint_map(path: Path, options: ClipOptions) -> str:
    """A joint map of a clip to be edited, with the best guess and all that it can name.

    Args:
        path: the file.
        options: how it is read; a map among them is of no use.

    Raises:
        ValueError: as of `load_clip`, or the file is an NPZ, which takes no map.
    """
    if _is_saved_clip(path):
        raise ValueError(f"{path}: an .npz states which joint is which, and takes no joint map")
    if is_marked(path):
        check_file(path)
        return draft_marker_map(path)
    _check_arguments(path, options.asf, options.animation)
    recording = _read(path, options.asf, options.animation)
    return template(recording.names, recording.parents, path.name)
