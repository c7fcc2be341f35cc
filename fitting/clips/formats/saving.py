"""`save_clip`: writes a clip in the format that the file's suffix selects."""

import csv
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fitting.clips.clip import Clip
from fitting.runtime import files

from .bvh import bvh_text, check_one_root
from .gltf_writer import Triangles, glb_bytes
from .npz import write_npz

SUFFIXES = (".npz", ".bvh", ".glb", ".csv")
NAMED = 5  # joints, in a warning

TIME = "time_s"
AXES = "xyz"
DIGITS = 7  # after the point


def save_clip(
    path: str | Path,
    clip: Clip,
    *,
    joints: Mapping[str, np.ndarray] | None = None,
    ground: Triangles | None = None,
) -> None:
    """Writes a clip as NPZ, BVH, GLB or CSV; the file appears complete or not at all.

    From an NPZ, `load_clip` restores the clip exactly. A BVH has the hierarchy, channels, unit,
    axes and frame time of the BVH that the clip came from; of other clips it is in centimetres
    with y up. If a joint needs more channels than it had, a warning says so. A GLB (glTF 2.0) holds
    a skeleton with one animation, in metres with y up; of a clip from a glTF file with a skinned
    mesh, it is that file with another animation. A CSV has a row for each frame.

    Args:
        path: file name; its suffix selects the format.
        clip: any clip.
        joints: further arrays for other programs, in an NPZ; `load_clip` ignores them.
        ground: in a GLB, a mesh beside the skeleton.

    Raises:
        ValueError: the file cannot be written, its suffix is another, or the format cannot hold
            this clip.
    """
    path = Path(path)
    check_clip_file(path, clip)
    match path.suffix.lower():
        case ".bvh":
            text, changed = bvh_text(clip)
            files.write_text(path, text)
            if changed and clip.channels is not None:
                warnings.warn(_changed_text(path, changed), stacklevel=2)
        case ".glb":
            content = glb_bytes(clip, ground)
            files.write(path, lambda temporary: temporary.write_bytes(content))
        case ".csv":
            files.write(path, lambda temporary: write_csv(temporary, clip))
        case _:
            write_npz(path, clip, joints or {})


def check_clip_file(path: Path, clip: Clip | None = None, *, with_ground: bool = False) -> None:
    """Checks, before anything is computed, that `save_clip` can write here.

    Args:
        path: file name.
        clip: None checks the name only.
        with_ground: whether a mesh is written too.

    Raises:
        ValueError: it cannot.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: wanted a name that ends in {', '.join(SUFFIXES)}")
    if with_ground and suffix != ".glb":
        raise ValueError(f"{path}: only a .glb can hold the terrain beside the motion")
    files.check_output_file(path)
    if clip is not None and suffix == ".bvh":
        check_one_root(path, clip)


def _changed_text(path: Path, changed: tuple[str, ...]) -> str:
    names = ", ".join(changed[:NAMED]) + (", ..." if len(changed) > NAMED else "")
    return (
        f"{path}: joints have other channels than in the file that came in, as theirs cannot hold "
        f"this motion: {names}"
    )


def columns(clip: Clip) -> list[str]:
    """The header: `time_s`, the root's `root_x_m` to `root_qz`, then `<joint>_x_m` and so on.

    The root's rotation is the unit quaternion from `root_qw` to `root_qz`.
    """
    root = [f"root_{axis}_m" for axis in AXES] + [f"root_q{axis}" for axis in "wxyz"]
    joints = [f"{name}_{axis}_m" for name in clip.joint_names for axis in AXES]
    return [TIME, *root, *joints]


def write_csv(path: Path, clip: Clip) -> None:
    """Writes the table, in world space with y up, metres and seconds; rotations wxyz."""
    root = clip.parents.index(-1)
    time = np.arange(clip.frame_count)[:, None] / clip.fps
    parts = [time, clip.positions_ws[:, root], clip.rotations_ws[:, root]]
    parts.append(clip.positions_ws.reshape(clip.frame_count, -1))
    table = np.concatenate(parts, axis=1) + 0.0
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns(clip))
        writer.writerows([f"{value:.{DIGITS}f}" for value in row] for row in table.tolist())
