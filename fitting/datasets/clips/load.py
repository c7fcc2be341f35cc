"""From a file to a `Clip`: reads it, then finds its scale, up axis, rate and legs."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from . import contacts
from .clip import Clip
from .formats.asfamc import INCH, find_asf, read_asfamc
from .formats.bvh import read_bvh
from .formats.npz import read_npz
from .joint_roles import Roles, find_roles
from .recording import UP_FROM_Z_UP, Recording, place
from .rigs import measure_rig

RATES = (24, 25, 30, 48, 50, 60, 72, 75, 90, 100, 120, 144, 150, 180, 200, 240, 250, 300, 360, 480)
RATE_TOLERANCE = 0.005  # relative: 23.976 becomes 24, the raw frame time is kept
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": INCH, "ft": 12 * INCH, "ASF unit": INCH / 0.45}
LEG = 0.84  # m, thigh and shin of an adult
FAR_OFF = 1.5  # times: a leg length that no unit brings this near to an adult's is remarked


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
    """Reads a BVH, AMC (with its ASF) or NPZ file.

    Args:
        path: the file; its suffix says the format.
        asf: skeleton of an AMC; None looks beside it.
        scale: metres per unit. None takes it from the ASF, or for BVH the unit that makes the legs
            most like an adult's (stated in `remarks`).
        fps: frames per second; None takes the file's, snapped to the nearest usual rate.
        up: "y" or "z"; None takes the axis along which the pelvis is over the feet.
        joints: roles by hand, see `roles.find_roles`; None recognises them.
        variant: of a `blocks` NPZ: "captured" or "base".

    Errors: ValueError for files that cannot be understood, with file and line for text formats;
    and, where `joints` are given, for names that are not there. A file without recognised legs
    loads; its `rig` raises.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".bvh", ".amc", ".npz"):
        raise ValueError(f"{path}: wanted a .bvh, .amc or .npz file")
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    if up not in (None, "y", "z"):
        raise ValueError(f"up is {up!r}; wanted 'y' or 'z'")
    for name, value in (("scale", scale), ("fps", fps)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}; wanted a number above 0")
    if kind == ".npz":
        given = {"asf": asf, "scale": scale, "fps": fps, "up": up, "joints": joints}
        if used := [name for name, value in given.items() if value is not None]:
            raise ValueError(f"{path}: an .npz clip is understood already; {used} do not apply")
        return read_npz(path, variant)
    if variant != "captured":
        raise ValueError(f"{path}: only blocks .npz files have the variant {variant!r}")
    if kind == ".amc":
        recording = read_asfamc(path, Path(asf) if asf is not None else find_asf(path))
    else:
        recording = read_bvh(path)
    return understand(recording, path.name, scale, fps, up, joints)


def understand(
    recording: Recording,
    source: str,
    scale: float | None = None,
    fps: float | None = None,
    up: str | None = None,
    joints: Mapping[str, str] | None = None,
) -> Clip:
    """A recording as a clip; arguments as in `load_clip`."""
    remarks = list(recording.remarks)
    roles: Roles | None = None
    try:
        roles = find_roles(recording.names, recording.parents, joints)
    except ValueError as error:
        if joints is not None:
            raise ValueError(f"{source}: {error}") from None
        remarks.append("no legs recognised; name them with joints=...")
    if scale is None:
        scale = recording.metres_per_unit or _guess_scale(recording, roles, remarks)
    recording = recording.scaled(scale)
    up = up or _guess_up(recording, roles, remarks)
    if up == "z":
        recording = recording.turned(UP_FROM_Z_UP)
    rate = fps or _snap(recording.frame_time, remarks)
    positions_ws, rotations_ws = place(
        recording.parents, recording.positions_ls, recording.rotations_ls
    )
    rig = None
    if roles is not None:
        toes = [leg.joints[3] for leg in roles.legs]
        stance = contacts.stance_labels(positions_ws[:, toes], rate)
        for leg, stands in zip(roles.legs, stance.T, strict=True):
            if not stands.any():
                remarks.append(f"the {leg.name} foot never stands; its axes are a guess")
        rig = measure_rig(roles, positions_ws, rotations_ws, stance)
    return Clip(
        recording.names, recording.parents, recording.offsets_ls, positions_ws, rotations_ws,
        float(rate), recording.frame_time, source, float(scale), up,
        roles.dialect if roles else None, rig, remarks=tuple(remarks),
    )  # fmt: skip


def _snap(frame_time: float, remarks: list[str]) -> float:
    """The usual rate next to a frame time, or the rate itself where none is near."""
    rate = 1.0 / frame_time
    usual = min(RATES, key=lambda known: abs(known - rate))
    if abs(usual - rate) > RATE_TOLERANCE * usual:
        remarks.append(f"the rate {rate:.6g} Hz is not a usual one and was kept")
        return rate
    if abs(usual - rate) > 0.0005 * usual:
        remarks.append(f"the frame time {frame_time:g} s is {rate:.6g} Hz; taken as {usual} Hz")
    return float(usual)


def _leg_length(recording: Recording, roles: Roles | None) -> float:
    """Thigh and shin in file units; without legs, the longest way from the root to a leaf."""
    lengths = np.median(np.linalg.norm(recording.positions_ls, axis=-1), axis=0)
    if roles is not None:
        legs = [lengths[list(leg.joints[1:3])].sum() for leg in roles.legs]
        return float(np.mean(legs))
    reach = np.zeros(len(lengths))
    for joint, parent in enumerate(recording.parents):
        reach[joint] = 0.0 if parent < 0 else reach[parent] + lengths[joint]
    return float(reach.max())


def _guess_scale(recording: Recording, roles: Roles | None, remarks: list[str]) -> float:
    """Metres per unit: the unit in which the legs are most like an adult's."""
    leg = _leg_length(recording, roles)
    if leg == 0.0:
        remarks.append("scale not recognised, as no bone has a length; taken as metres")
        return 1.0
    unit = min(UNITS, key=lambda name: abs(np.log(leg * UNITS[name] / LEG)))
    metres = leg * UNITS[unit]
    sure = roles is not None and 1 / FAR_OFF < metres / LEG < FAR_OFF
    doubt = "" if sure else "; doubtful, give scale=..."
    remarks.append(f"scale guessed: legs of {leg:.4g} units in {unit} are {metres:.3f} m{doubt}")
    return UNITS[unit]


def _guess_up(recording: Recording, roles: Roles | None, remarks: list[str]) -> str:
    """The axis along which the pelvis is over the ankles; without legs, the body's longer one."""
    positions, _ = place(recording.parents, recording.positions_ls, recording.rotations_ls)
    if roles is None:
        extent = np.median(np.ptp(positions, axis=1), axis=0)
        return "z" if extent[2] > 2 * extent[1] else "y"
    ankles = positions[:, [leg.joints[2] for leg in roles.legs]].mean(axis=1)
    rise = np.median(positions[:, roles.pelvis] - ankles, axis=0)
    if max(rise[1], rise[2]) < 0.5 * np.linalg.norm(rise):
        remarks.append("the pelvis is not over the feet along y or z; give up=...")
    return "z" if rise[2] > rise[1] else "y"
