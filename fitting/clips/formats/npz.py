"""Clips as NumPy archives: of all fields of a `Clip`, or of the joint positions of two legs.

An archive of fields loads exactly as it was saved. One of positions may hold two motions, as
captured and, with `BASE` before the names of its arrays, the flat animation below it.
"""

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import jax
import numpy as np

from fitting.clips import contacts
from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.clips.clip import FASTEST, FURTHEST, LONGEST, SHORTEST, SLOWEST, TRACKS, Clip
from fitting.clips.rigs import leg_rotations, relative_size, unit, with_soles
from fitting.runtime import files
from fitting.runtime.validation import QUOTED, in_one_line, why_unreadable
from jaxik.world.skeleton import Rig

from .bvh import CHANNEL

ArraysByName = Mapping[str, np.ndarray]
Kind = Literal["text", "integer", "number", "switch", "label"]

DTYPES: dict[Kind, str] = {
    "text": "U",
    "integer": "iu",
    "number": "fiu",
    "switch": "b",
    "label": "bfiu",
}
WORDS = {"U": "text", "i": "integers", "u": "integers", "f": "numbers", "b": "switches"}
NOT_UNIT = 0.01  # off a length of 1, at most

Arrays = dict[str, np.ndarray]

FORMAT = "jaxik clip 1"
ARRAYS = ("offsets_ls", "positions_ws", "rotations_ws")
TEXTS = ("source", "up_axis")
NUMBERS = ("fps", "raw_frame_time", "scale")
OPTIONAL = ("dialect", "rest_rotations_ls", "channels")
BASE = "base_"
LEG_JOINTS = ("hip", "knee", "ankle", "ball")

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
MAX_BYTES = 2**31  # of all arrays together, unpacked


@dataclass(frozen=True)
class Wanted:
    """An array of an archive."""

    kind: Kind
    shape: tuple[int | str, ...] = ()
    """Names stand for sizes that are the same in all arrays of the archive."""
    low: float = -np.inf
    high: float = np.inf
    unit: bool = False
    """Whether the last axis holds unit vectors or unit quaternions."""
    distinct: bool = False
    may_be_empty: bool = False
    optional: bool = False


def check_arrays(path: Path, content: ArraysByName, wanted: Mapping[str, Wanted]) -> dict[str, int]:
    """The sizes of the named axes.

    Args:
        path: of the archive, for messages.
        content: its arrays.
        wanted: what they have to be, those first that give the axes their sizes.

    Raises:
        ValueError: an array is missing, or is something else; it says which, and what was wanted.
    """
    required = {name for name, array in wanted.items() if not array.optional}
    if missing := sorted(required - set(content)):
        raise ValueError(f"{path}: without the arrays {missing}; it has {sorted(content)}")
    sizes: dict[str, int] = {}
    for name, array in wanted.items():
        if name in content and (problem := _problem(content[name], array, sizes)):
            raise ValueError(f"{path}: {name} {problem}")
    return sizes


def _problem(array: np.ndarray, wanted: Wanted, sizes: dict[str, int]) -> str:
    """What is wrong with an array, empty if nothing is; adds to the sizes."""
    if array.dtype.kind not in DTYPES[wanted.kind]:
        kind = WORDS.get(array.dtype.kind, str(array.dtype))
        return f"holds {kind}; wanted {WORDS[DTYPES[wanted.kind][0]]}"
    if array.ndim == len(wanted.shape):
        named = zip(wanted.shape, array.shape, strict=True)
        for axis, size in named:
            if isinstance(axis, str):
                sizes.setdefault(axis, size)
    expected = tuple(
        sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in wanted.shape
    )
    if array.shape != expected:
        return f"is {array.shape}; wanted {_words(wanted.shape)}, here {_words(expected)}"
    if 0 in array.shape and not wanted.may_be_empty:
        return f"is empty, {array.shape}; wanted {_words(wanted.shape)}"
    if array.dtype.kind in "fiu":
        return _problem_of_values(array, wanted)
    if wanted.distinct and len(np.unique(array)) < array.size:
        values, counts = np.unique(array, return_counts=True)
        return f"has {str(values[counts > 1][0])!r} more than once"
    return ""


def _problem_of_values(array: np.ndarray, wanted: Wanted) -> str:
    unknown = ~np.isfinite(array)
    if unknown.any():
        value = array[unknown].flat[0]
        return f"has {value:g}{_place(unknown, wanted)}; wanted finite numbers"
    outside = (array < wanted.low) | (array > wanted.high)
    if outside.any():
        value = array[outside].flat[0]
        return f"has {value:g}{_place(outside, wanted)}; wanted {wanted.low:g} to {wanted.high:g}"
    if wanted.unit:
        lengths = np.linalg.norm(np.clip(array, -2.0, 2.0), axis=-1)  # without overflow
        off = np.abs(lengths - 1) > NOT_UNIT
        if off.any():
            return f"has a length of {lengths[off].flat[0]:.4g}{_place(off, wanted)}; wanted 1"
    return ""


def _place(chosen: np.ndarray | np.bool_, wanted: Wanted) -> str:
    """Where the first of the chosen entries is, and what the axes are."""
    if chosen.ndim == 0:
        return ""
    place = [int(index) for index in np.argwhere(chosen)[0]]
    return f" at {place} of {_words(wanted.shape[: chosen.ndim])}"


def _words(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))})" if shape else "a single value"


FPS = Wanted("number", low=SLOWEST, high=FASTEST)
FRAMES = Wanted("number", ("frames",), low=0.0, high=1.0, optional=True)
OF_LEGS = Wanted("number", ("frames", "legs"), low=0.0, high=1.0, optional=True)
TRACK_ARRAYS = {
    "stance": Wanted("switch", ("frames", "legs"), optional=True),
    "mask": Wanted("switch", ("frames",), optional=True),
    "slide": FRAMES,
    "grounded": FRAMES,
    "weight": OF_LEGS,
    "probability": OF_LEGS,
    "left_out": Wanted("switch", ("frames", "legs"), optional=True),
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
POSITION_ARRAYS = {
    "fps": FPS,
    "pelvis_rot": Wanted("number", ("frames", 4), unit=True),
    "foot_rot": Wanted("number", ("frames", 2, 4), unit=True),
    "stance": Wanted("label", ("frames", 2)),
}
ROOT_POSITIONS = Wanted("number", ("frames", 3), low=-FURTHEST, high=FURTHEST)
LEG_POSITIONS = Wanted("number", ("frames", 2, 3), low=-FURTHEST, high=FURTHEST)


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


def read_npz(path: Path) -> Clip:
    """The clip in an archive, as captured where it holds a flat animation, too.

    Args:
        path: an archive written by `write_npz`, or one of joint positions.

    Raises:
        ValueError: neither kind of file, or arrays missing, misshapen or not finite.
    """
    content = read_arrays(path)
    if "format" in content:
        return _read_saved_clip(path, content)
    if "pelvis_rot" in content:
        return _read_positions(path, content, "")
    raise ValueError(
        f"{path}: wanted a clip saved by save_clip, or joint positions; it has {sorted(content)}"
    )


def read_base(path: Path) -> Clip:
    """The flat animation that an archive holds below its captured clip; see `holds_base`.

    Raises:
        ValueError: arrays are missing, misshapen or not finite.
    """
    return _read_positions(path, read_arrays(path), BASE)


def holds_base(path: str | Path) -> bool:
    """Whether a file holds a captured clip and the flat animation below it."""
    return Path(path).suffix.lower() == ".npz" and f"{BASE}pelvis" in array_names(Path(path))


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
    tracks: Any = {name: content[name] for name in TRACK_ARRAYS if name in content}
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
        **tracks,
        remarks=tuple(map(str, content["remarks"])),
        rest_rotations_ls=rest.astype(np.float64) if rest is not None else None,
        channels=tuple(map(str, content["channels"])) if "channels" in content else None,
        start=0.0,  # whatever it was cut from
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


def _read_positions(path: Path, content: Arrays, prefix: str) -> Clip:
    """Joint positions of two legs, left first; thigh and shin get the rotations they imply."""
    keys = [f"{prefix}{joint}" for joint in LEG_JOINTS]
    joints = {f"{prefix}pelvis": ROOT_POSITIONS, **dict.fromkeys(keys, LEG_POSITIONS)}
    check_arrays(path, content, joints | POSITION_ARRAYS)
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


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays in an archive. Nothing is unpickled.

    Raises:
        ValueError: no archive, something else than plain arrays in it, or arrays that take more
            than `MAX_BYTES`, of which none is read then.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            for entry in archive.infolist() if size <= MAX_BYTES else ():
                _check_claim(archive, entry)
        if size <= MAX_BYTES:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return {name: _with_common_floats(array) for name, array in arrays.items()}
    except Exception as error:  # zipfile, zlib and NumPy each raise their own
        what = in_one_line(error, QUOTED)
        raise ValueError(f"{path}: wanted a NumPy archive of plain arrays ({what})") from None
    raise ValueError(f"{path}: its arrays take {size} bytes; wanted {MAX_BYTES} at most")


def read_array(path: Path) -> np.ndarray:
    """The array in an `.npy`. Nothing is unpickled.

    Raises:
        ValueError: it is not a plain array, or claims to be longer than it is.
    """
    try:
        with path.open("rb") as file:
            _check_header(file, path.name, path.stat().st_size)
            file.seek(0)
            return np.load(file, allow_pickle=False)
    except Exception as error:  # NumPy raises its own
        what = in_one_line(error, QUOTED)
        raise ValueError(f"{path}: wanted a NumPy array ({what})") from None


def _with_common_floats(array: np.ndarray) -> np.ndarray:
    """The array, with 64 bits where it has floats of another width than 32 or 64."""
    if array.dtype.kind != "f" or array.dtype in (np.float32, np.float64):
        return array
    with np.errstate(over="ignore"):  # infinity is refused later
        return array.astype(np.float64)


def _check_claim(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    with archive.open(entry) as file:
        _check_header(file, entry.filename, entry.file_size)


def _check_header(file: IO[bytes], name: str, size: int) -> None:
    """ValueError for an array that says that it is longer than it is: NumPy would make room."""
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"{name} is not a plain array")
    shape, _, dtype = HEADERS[version](file)
    if (claim := math.prod(shape) * dtype.itemsize) > size:
        raise ValueError(f"{name} says {claim} bytes and has {size}")


def array_names(path: Path) -> list[str]:
    """The names of the arrays in an archive; none if it is not an archive."""
    if why_unreadable(path):
        return []
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return list(arrays.files)
    except Exception:  # reading the arrays will report what is wrong
        return []
