"""Clips as NumPy archives: this project's own format, and the files of the `blocks` benchmark.

An archive of our own holds every field of a `Clip`, so it loads exactly as it was saved. A `blocks`
file holds joint positions of two legs, once as captured and once as a flat animation.
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from fitting.datasets import archives
from fitting.datasets.clips import contacts
from fitting.datasets.clips.assemble import JointMotion, clip_from_joints
from fitting.datasets.clips.clip import TRACKS, Clip
from fitting.datasets.clips.leg_geometry import leg_rotations, unit
from fitting.datasets.clips.recording import FASTEST, FURTHEST, LONGEST, SHORTEST, SLOWEST
from fitting.datasets.clips.rigs import relative_size, with_soles
from fitting.runtime import files
from jaxik.world.skeleton import Rig

from .array_checks import Wanted, check_arrays
from .bvh import CHANNEL

Arrays = dict[str, np.ndarray]

FORMAT = "jaxik clip 1"
FPS = Wanted("number", low=SLOWEST, high=FASTEST)
FRAMES = Wanted("number", ("frames",), low=0.0, high=1.0, optional=True)
TRACK_ARRAYS = {
    "stance": Wanted("switch", ("frames", "legs"), optional=True),
    "mask": Wanted("switch", ("frames",), optional=True),
    "slide": FRAMES,
    "grounded": FRAMES,
    "weight": Wanted("number", ("frames", "legs"), low=0.0, high=1.0, optional=True),
}
RIG_ARRAYS = {
    "knee_axis_ls": Wanted("number", ("legs", 3), unit=True),
    "ankle_from_foot": Wanted("number", ("legs", 4), unit=True),
    "thigh": Wanted("number", ("legs",), low=0.0, high=LONGEST),
    "shin": Wanted("number", ("legs",), low=0.0, high=LONGEST),
    "foot": Wanted("number", ("legs",), low=0.0, high=LONGEST),
    "side": Wanted("number", ("legs",), low=-1.0, high=1.0),
    "present": Wanted("switch", ("legs",)),
}
RIG_JOINTS = {
    "joints": Wanted("integer", ("legs", 4), low=0.0),
    "pelvis": Wanted("integer", low=0.0),
}
# Measured where an older file does not have them.
SOLE = Wanted("number", ("legs",), low=-LONGEST, high=LONGEST, optional=True)
SOLE_ARRAYS = {"ankle_height": SOLE, "ball_height": SOLE}
CLIP_ARRAYS = {
    "joint_names": Wanted("text", ("joints",), distinct=True),
    "rig_names": Wanted("text", ("legs",), distinct=True, optional=True),
    "parents": Wanted("integer", ("joints",), low=-1.0),
    "positions_ws": Wanted("number", ("frames", "joints", 3), low=-FURTHEST, high=FURTHEST),
    "rotations_ws": Wanted("number", ("frames", "joints", 4), unit=True),
    "offsets_ls": Wanted("number", ("joints", 3), low=-FURTHEST, high=FURTHEST),
    "source": Wanted("text"),
    "up_axis": Wanted("text"),
    "remarks": Wanted("text", ("remarks",), may_be_empty=True),
    "dialect": Wanted("text", optional=True),
    "fps": FPS,
    "raw_frame_time": Wanted("number", low=1e-6, high=1e4),
    "scale": Wanted("number", low=1e-9, high=1e6),
    "rest_rotations_ls": Wanted("number", ("joints", 4), unit=True, optional=True),
    "channels": Wanted("text", ("joints",), optional=True),
    **TRACK_ARRAYS,
}
ARRAYS = ("offsets_ls", "positions_ws", "rotations_ws")
TEXTS = ("source", "up_axis")
NUMBERS = ("fps", "raw_frame_time", "scale")
OPTIONAL = ("dialect", "rest_rotations_ls", "channels")
VARIANTS = {"captured": "", "base": "base_"}  # prefix of their arrays in a blocks file
BLOCKS_ARRAYS = {
    "fps": FPS,
    "pelvis_rot": Wanted("number", ("frames", 4), unit=True),
    "foot_rot": Wanted("number", ("frames", 2, 4), unit=True),
    "stance": Wanted("label", ("frames", 2)),
}
BLOCKS_ROOT = Wanted("number", ("frames", 3), low=-FURTHEST, high=FURTHEST)
BLOCKS_JOINT = Wanted("number", ("frames", 2, 3), low=-FURTHEST, high=FURTHEST)
BLOCKS_JOINTS = ("hip", "knee", "ankle", "ball")


def write_npz(path: Path, clip: Clip, joints: Mapping[str, np.ndarray]) -> None:
    """Writes a clip as an NPZ archive, from which `read_npz` restores it exactly.

    The keys are `format`; the clip's fields by name (those that may be None only if they are set);
    the rig's fields as `rig_<field>`, where `rig_joints` are joint indices of shape (legs, 4).

    Args:
        path: file name.
        clip: any clip.
        joints: further arrays for other programs; `read_npz` ignores them.
    """
    content: Arrays = {
        "format": np.array(FORMAT),
        "joint_names": np.array(clip.joint_names),
        "parents": np.array(clip.parents),
        "remarks": np.array(clip.remarks, dtype=np.str_),
    }
    for name in (*ARRAYS, *TRACKS, *TEXTS, *NUMBERS, *OPTIONAL):
        if (value := getattr(clip, name)) is not None:
            content[name] = np.asarray(value)
    if (rig := clip.measured_rig) is not None:
        arrays = ("names", *RIG_ARRAYS, *RIG_JOINTS, *SOLE_ARRAYS)
        content |= {f"rig_{name}": np.asarray(getattr(rig, name)) for name in arrays}
    content |= joints

    def fill(temporary: Path) -> None:
        with temporary.open("wb") as file:  # given a name, NumPy would append a suffix
            np.savez_compressed(file, **content)  # pyright: ignore[reportArgumentType]

    files.write(path, fill)


def read_npz(path: Path, variant: str) -> Clip:
    """The clip in an archive.

    Args:
        path: an archive written by `write_npz`, or a `blocks` file.
        variant: of a `blocks` file: "captured" or "base".

    Raises:
        ValueError: neither kind of file, arrays missing, misshapen or not finite, or no such
            variant.
    """
    content = archives.read_arrays(path)
    if "format" in content:
        if variant != "captured":
            raise ValueError(f"{path}: only blocks files have the variant {variant!r}")
        return _read_saved_clip(path, content)
    if "base_pelvis" in content or "leg_lengths" in content:
        if variant not in VARIANTS:
            raise ValueError(f"{path}: no variant {variant!r}; there are {list(VARIANTS)}")
        return _read_blocks(path, content, variant)
    raise ValueError(
        f"{path}: wanted a clip saved by save_clip or a blocks file; it has {sorted(content)}"
    )


def is_blocks_file(path: str | Path) -> bool:
    """Whether a file belongs to the `blocks` benchmark, with a captured clip and its flat base."""
    return Path(path).suffix.lower() == ".npz" and "base_pelvis" in archives.array_names(Path(path))


def _read_saved_clip(path: Path, content: Arrays) -> Clip:
    if str(content["format"]) != FORMAT:
        raise ValueError(f"{path}: wanted the format {FORMAT!r}, got {str(content['format'])!r}")
    wanted = dict(CLIP_ARRAYS)
    if "rig_names" in content:
        of_rig = RIG_ARRAYS | RIG_JOINTS | SOLE_ARRAYS
        wanted |= {f"rig_{name}": array for name, array in of_rig.items()}
    sizes = check_arrays(path, content, wanted)
    _check_tree(path, content, sizes["joints"])
    rest = content.get("rest_rotations_ls")
    return Clip(
        joint_names=tuple(map(str, content["joint_names"])),
        parents=tuple(map(int, content["parents"])),
        **{name: content[name].astype(np.float64) for name in ARRAYS},
        fps=float(content["fps"]),
        raw_frame_time=float(content["raw_frame_time"]),
        source=str(content["source"]),
        scale=float(content["scale"]),
        up_axis=str(content["up_axis"]),
        dialect=str(content["dialect"]) if "dialect" in content else None,
        measured_rig=_read_rig(content) if "rig_names" in content else None,
        **{name: content[name] for name in TRACK_ARRAYS if name in content},
        remarks=tuple(map(str, content["remarks"])),
        rest_rotations_ls=rest.astype(np.float64) if rest is not None else None,
        channels=tuple(map(str, content["channels"])) if "channels" in content else None,
    )


def _check_tree(path: Path, content: Arrays, joints: int) -> None:
    """ValueError unless the joints form a skeleton whose joints the legs name."""
    if (axis := str(content["up_axis"])) not in ("y", "z"):
        raise ValueError(f"{path}: up_axis is {axis!r}; wanted 'y' or 'z'")
    late = np.flatnonzero(content["parents"] >= np.arange(joints))
    if len(late):
        joint = int(late[0])
        raise ValueError(
            f"{path}: parents has {content['parents'][joint]} at [{joint}]; "
            "wanted an earlier joint, or -1 for a root"
        )
    for channels in content.get("channels", ()):
        if odd := [word for word in str(channels).split() if not CHANNEL.fullmatch(word)]:
            raise ValueError(f"{path}: channels has {odd[0]!r}; wanted such as Xposition")
    if "rig_names" not in content:
        return
    named = np.append(content["rig_joints"], content["rig_pelvis"])
    if (named >= joints).any():
        raise ValueError(f"{path}: rig_joints and rig_pelvis name {named.max()} of {joints} joints")
    for name in ("rig_thigh", "rig_shin"):
        shortest = content[name][content["rig_present"]].min(initial=LONGEST)
        if shortest < SHORTEST:
            raise ValueError(
                f"{path}: {name} has a bone of {shortest:g} m; wanted {SHORTEST:g} to {LONGEST:g}"
            )


def _read_rig(content: Arrays) -> Rig:
    arrays = {name: content[f"rig_{name}"] for name in RIG_ARRAYS}
    joints = tuple((int(h), int(k), int(a), int(t)) for h, k, a, t in content["rig_joints"])
    known = all(f"rig_{name}" in content for name in SOLE_ARRAYS)
    unknown = np.zeros(len(joints))
    arrays |= {name: content[f"rig_{name}"] if known else unknown for name in SOLE_ARRAYS}
    numbers = {name: array for name, array in arrays.items() if array.dtype != bool}
    dtype = np.result_type(np.float32, *numbers.values())  # one for all, as JAX mixes none
    arrays |= {name: array.astype(dtype) for name, array in numbers.items()}
    with jax.enable_x64(True):
        rig = Rig(
            **jax.device_put(arrays),
            names=tuple(map(str, content["rig_names"])),
            joints=joints,
            pelvis=int(content["rig_pelvis"]),
        )
    return rig if known else _measure_soles(content, rig)


def _measure_soles(content: Arrays, rig: Rig) -> Rig:
    positions_ws, stance = content["positions_ws"], content.get("stance")
    if stance is None:
        balls = positions_ws[:, [leg[3] for leg in rig.joints]]
        size = relative_size(positions_ws, rig.joints)
        stance = contacts.detect_stances(balls, float(content["fps"]), size)
    return with_soles(rig, positions_ws, content["rotations_ws"], stance)


def _read_blocks(path: Path, content: Arrays, variant: str) -> Clip:
    """Joint positions of two legs, left first; thigh and shin get the rotations they imply."""
    prefix = VARIANTS[variant]
    keys = [f"{prefix}{joint}" for joint in BLOCKS_JOINTS]
    joints = {f"{prefix}pelvis": BLOCKS_ROOT, **dict.fromkeys(keys, BLOCKS_JOINT)}
    check_arrays(path, content, joints | BLOCKS_ARRAYS)
    pelvis = content[f"{prefix}pelvis"].astype(np.float64)
    hip, knee, ankle, ball = (content[key].astype(np.float64) for key in keys)
    pelvis_rot = _normalised(content["pelvis_rot"])
    foot_rot = _normalised(content["foot_rot"])
    names, parents, positions, rotations = ["pelvis"], [-1], [pelvis], [pelvis_rot]
    left_ws = unit(hip[:, 0] - hip[:, 1])
    for leg, side in enumerate(("left", "right")):
        names += [f"{side}_{joint}" for joint in ("hip", "knee", "ankle", "toe")]
        parents += [0, len(names) - 4, len(names) - 3, len(names) - 2]
        positions += [joint[:, leg] for joint in (hip, knee, ankle, ball)]
        rotations += leg_rotations(hip[:, leg], knee[:, leg], ankle[:, leg], left_ws)
        rotations += [foot_rot[:, leg], foot_rot[:, leg]]
    motion = JointMotion(
        tuple(names), tuple(parents), np.stack(positions, axis=1), np.stack(rotations, axis=1),
        content["stance"].astype(bool), float(content["fps"]),
    )  # fmt: skip
    return clip_from_joints(motion, path.name)


def _normalised(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions in float64; the norms of stored float32 values are slightly off."""
    rotations = rotations.astype(np.float64)
    return rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)
