"""Clips in NumPy archives: our own format, and the `blocks` benchmark of joint positions."""

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.joint_roles import find_roles
from fitting.datasets.clips.recording import continuous, local_from_world
from fitting.datasets.clips.rigs import hinges, measure_rig, unit
from fitting.runtime.files import write
from jaxik.world.skeleton import Rig

FORMAT = "jaxik clip 1"
ARRAYS = ("offsets_ls", "positions_ws", "rotations_ws")
OPTIONAL = ("stance", "mask", "slide")
TEXTS = ("source", "up_axis")
NUMBERS = ("fps", "raw_frame_time", "scale")
RIG_ARRAYS = ("knee_axis_ls", "ankle_from_foot", "thigh", "shin", "foot", "side", "present")
VARIANTS = {"captured": "", "base": "base_"}
BLOCKS = ("fps", "pelvis", "pelvis_rot", "foot_rot", "stance")
PARTS = ("hip", "knee", "ankle", "ball")


def save_clip(
    path: str | Path, clip: Clip, *, joints: Mapping[str, np.ndarray] | None = None
) -> None:
    """Writes a clip as NPZ, which `load_clip` gives back exactly; never half a file.

    `joints` are further arrays for other programs, which `load_clip` passes over.

    Keys: `format`; the clip's fields under their own names (`stance`, `mask`, `slide`, `dialect`
    where there are any); the rig's as `rig_<field>`, `rig_joints` being (legs, 4) joint indices.
    """
    path = Path(path)
    content: dict[str, np.ndarray] = {
        "format": np.array(FORMAT),
        "joint_names": np.array(clip.joint_names),
        "parents": np.array(clip.parents),
        "remarks": np.array(clip.remarks, dtype=np.str_),
    }
    for name in (*ARRAYS, *OPTIONAL, *TEXTS, *NUMBERS, "dialect"):
        if (value := getattr(clip, name)) is not None:
            content[name] = np.asarray(value)
    if clip.measured is not None:
        content |= {f"rig_{name}": np.asarray(getattr(clip.measured, name)) for name in RIG_ARRAYS}
        content["rig_names"] = np.array(clip.measured.names)
        content["rig_joints"] = np.array(clip.measured.joints)
        content["rig_pelvis"] = np.array(clip.measured.pelvis)
    content |= joints or {}

    def fill(temporary: Path) -> None:
        with temporary.open("wb") as file:  # an open file, for NumPy adds a suffix to a name
            np.savez_compressed(file, **content)  # pyright: ignore[reportArgumentType]

    write(path, fill)


def read_npz(path: Path, variant: str) -> Clip:
    """A clip of our own format, or a variant ("captured", "base") of a `blocks` file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = dict(archive)
    except Exception as error:  # zipfile, zlib and NumPy each have their own
        raise ValueError(f"{path}: wanted a NumPy archive of plain arrays ({error})") from None
    if "format" in content:
        if variant != "captured":
            raise ValueError(f"{path}: only blocks files have the variant {variant!r}")
        return _own(path, content)
    if "base_pelvis" in content or "leg_lengths" in content:
        if variant not in VARIANTS:
            raise ValueError(f"{path}: no variant {variant!r}; there are {list(VARIANTS)}")
        return _blocks(path, content, variant)
    raise ValueError(
        f"{path}: wanted a clip saved by save_clip or a blocks file; it has {sorted(content)}"
    )


def is_blocks_file(path: str | Path) -> bool:
    """Whether a file is of the blocks benchmark, which holds a captured clip and its base."""
    if Path(path).suffix.lower() != ".npz" or not Path(path).is_file():
        return False
    try:
        with np.load(path, allow_pickle=False) as archive:
            return "base_pelvis" in archive.files
    except Exception:  # whatever is wrong with it, reading it says so
        return False


def _own(path: Path, content: dict[str, np.ndarray]) -> Clip:
    if str(content["format"]) != FORMAT:
        raise ValueError(f"{path}: wanted the format {FORMAT!r}, got {str(content['format'])!r}")
    needed = {"joint_names", "parents", "remarks", *ARRAYS, *TEXTS, *NUMBERS}
    if "rig_names" in content:
        needed |= {f"rig_{name}" for name in (*RIG_ARRAYS, "joints", "pelvis")}
    _check(path, content, needed)
    rig = None
    if "rig_names" in content:
        with jax.enable_x64(True):
            rig = Rig(
                **{name: jax.device_put(content[f"rig_{name}"]) for name in RIG_ARRAYS},
                names=tuple(map(str, content["rig_names"])),
                joints=tuple(
                    (int(h), int(k), int(a), int(t)) for h, k, a, t in content["rig_joints"]
                ),
                pelvis=int(content["rig_pelvis"]),
            )
    return Clip(
        joint_names=tuple(map(str, content["joint_names"])),
        parents=tuple(map(int, content["parents"])),
        offsets_ls=content["offsets_ls"],
        positions_ws=content["positions_ws"],
        rotations_ws=content["rotations_ws"],
        fps=float(content["fps"]),
        raw_frame_time=float(content["raw_frame_time"]),
        source=str(content["source"]),
        scale=float(content["scale"]),
        up_axis=str(content["up_axis"]),
        dialect=str(content["dialect"]) if "dialect" in content else None,
        measured=rig,
        stance=content.get("stance"),
        mask=content.get("mask"),
        slide=content.get("slide"),
        remarks=tuple(map(str, content["remarks"])),
    )


def _check(path: Path, content: dict[str, np.ndarray], needed: set[str]) -> None:
    if missing := sorted(needed - set(content)):
        raise ValueError(f"{path}: without the arrays {missing}; it has {sorted(content)}")
    for name in needed:
        if content[name].dtype.kind == "f" and not np.isfinite(content[name]).all():
            raise ValueError(f"{path}: {name} has numbers that are not finite")


def _blocks(path: Path, content: dict[str, np.ndarray], variant: str) -> Clip:
    """Joint positions of two legs, left first, with the rotations that they imply."""
    prefix = VARIANTS[variant]
    keys = [f"{prefix}{part}" for part in PARTS]
    _check(path, content, {*BLOCKS, f"{prefix}pelvis", *keys})
    pelvis = content[f"{prefix}pelvis"].astype(np.float64)
    frames = len(pelvis)
    wanted = {key: (frames, 2, 3) for key in keys}
    wanted |= {"pelvis_rot": (frames, 4), "foot_rot": (frames, 2, 4), "stance": (frames, 2)}
    for key, shape in wanted.items():
        if content[key].shape != shape:
            raise ValueError(f"{path}: {key} is {content[key].shape}; wanted {shape}")
    hip, knee, ankle, ball = (content[key].astype(np.float64) for key in keys)
    pelvis_rot = _unit_rotations(content["pelvis_rot"])
    foot_rot = _unit_rotations(content["foot_rot"])
    names, parents, positions, rotations = ["pelvis"], [-1], [pelvis], [pelvis_rot]
    left_ws = unit(hip[:, 0] - hip[:, 1])
    for leg, side in enumerate(("left", "right")):
        names += [f"{side}_{part}" for part in ("hip", "knee", "ankle", "toe")]
        parents += [0, len(names) - 4, len(names) - 3, len(names) - 2]
        positions += [part[:, leg] for part in (hip, knee, ankle, ball)]
        rotations += leg_rotations(hip[:, leg], knee[:, leg], ankle[:, leg], left_ws)
        rotations += [foot_rot[:, leg], foot_rot[:, leg]]
    return clip_from_joints(
        tuple(names), tuple(parents), np.stack(positions, axis=1), np.stack(rotations, axis=1),
        float(content["fps"]), path.name, content["stance"].astype(bool),
    )  # fmt: skip


def _unit_rotations(rotations: np.ndarray) -> np.ndarray:
    """Float64 quaternions at length one, the norms of stored float32 being a little off."""
    rotations = rotations.astype(np.float64)
    return rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)


def leg_rotations(
    hip: np.ndarray, knee: np.ndarray, ankle: np.ndarray, left_ws: np.ndarray
) -> list[np.ndarray]:
    """World rotations, wxyz, of thigh and shin known by their ends, each of shape (frames, 4).

    Joint axes: y from the child up to the joint, x left along the hinge of the knee, z forward; so
    a turn about +x flexes the knee.
    """
    hinge = hinges(hip, knee, ankle, left_ws)
    turns = []
    for upper, lower in ((hip, knee), (knee, ankle)):
        y = unit(upper - lower)
        x = unit(hinge - y * np.sum(hinge * y, axis=-1, keepdims=True))
        axes = np.stack([x, y, np.cross(x, y)], axis=-1)
        turns.append(Rotation.from_matrix(axes).as_quat(scalar_first=True))
    return turns


def clip_from_joints(
    names: tuple[str, ...],
    parents: tuple[int, ...],
    positions_ws: np.ndarray,
    rotations_ws: np.ndarray,
    fps: float,
    source: str,
    stance: np.ndarray,
    joints: Mapping[str, str] | None = None,
) -> Clip:
    """A clip in our units from joints in world space.

    Its legs are named as in the dialect "jaxik", or by `joints`, see `find_roles`.
    """
    rotations_ws = continuous(rotations_ws)
    positions_ls, _ = local_from_world(parents, positions_ws, rotations_ws)
    roles = find_roles(names, parents, joints)
    rig = measure_rig(roles, positions_ws, rotations_ws, stance)
    return Clip(
        names, parents, np.median(positions_ls, axis=0), positions_ws, rotations_ws, fps, 1.0 / fps,
        source, 1.0, "y", roles.dialect, rig, stance=stance,
    )  # fmt: skip
