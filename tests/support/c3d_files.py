"""C3D files of known bodies: markers are put on joints whose places are known."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.clips import Clip

WIDTHS = {"KneeWidth": 104.0, "AnkleWidth": 70.0}  # mm
MEASURES = {letter + name: width for letter in "LR" for name, width in WIDTHS.items()}
RADIUS = 0.007  # m, of a marker
DEPTH = 0.15  # m, of the pelvis
BLOCK = 512  # bytes
INTEL, DEC, MIPS = 84, 85, 86
Places = dict[str, np.ndarray]


def plug_in_gait(clip: Clip) -> Places:
    """Markers, m, y up, on a body whose hips are 20 cm apart and whose pelvis stays upright.

    The pelvis' are where Harrington's regression, solved for them, wants them: the hips are
    0.33 PW + 7.3 mm to the side, so the pelvis is PW = 280.9 mm wide.
    """
    names = clip.joint_names
    at = {name: clip.positions_ws[:, names.index(name)] for name in names}
    width = (0.1 - 0.0073) / 0.33
    hips = (at["left_hip"] + at["right_hip"]) / 2
    front = hips + [0.0, 0.30 * width + 0.0109, 0.24 * DEPTH + 0.0099]
    places = {
        "LASI": front + [width / 2, 0.0, 0.0], "RASI": front - [width / 2, 0.0, 0.0],
        "LPSI": front + [0.04, 0.0, -DEPTH], "RPSI": front + [-0.04, 0.0, -DEPTH],
    }  # fmt: skip
    for side, letter, sign in (("left", "L", 1.0), ("right", "R", -1.0)):
        hip, knee, ankle = (at[f"{side}_{joint}"] for joint in ("hip", "knee", "ankle"))
        for ending, wand, top, joint, turned, breadth in (
            ("KNE", "THI", hip, knee, "hip", WIDTHS["KneeWidth"]),
            ("ANK", "TIB", knee, ankle, "knee", WIDTHS["AnkleWidth"]),
        ):
            rot = clip.rotations_ws[:, names.index(f"{side}_{turned}")]
            outwards = sign * Rotation.from_quat(rot, scalar_first=True).apply([1.0, 0.0, 0.0])
            offset = breadth / 2000 + RADIUS
            places[letter + ending] = joint + offset * outwards
            places[letter + wand] = (top + joint) / 2 + (offset + 0.05) * outwards
        places[f"{letter}TOE"] = at[f"{side}_toe"]
        places[f"{letter}HEE"] = ankle + [0.0, -0.05, -0.05]
    return places


def write_c3d(
    path: Path,
    places: Mapping[str, np.ndarray],
    *,
    rate: float = 60.0,
    point: Mapping[str, str] | None = None,
    measures: Mapping[str, float] | None = None,
    unit: float = 0.001,
    channels: int = 0,
) -> Path:
    """Writes markers, m, y up, as a file with z up; NaN are gaps.

    Args:
        path: file name.
        places: by label.
        rate: Hz.
        point: further parameters of the group POINT, in place of those for mm and z up.
        measures: of the group PROCESSING.
        unit: m.
        channels: analog ones, of four samples a frame.
    """
    import ezc3d

    content = ezc3d.c3d()
    stacked = (
        np.stack([place[:, [0, 2, 1]] * [1, -1, 1] for place in places.values()], axis=1) / unit
    )
    points = np.ones((4, len(places), len(stacked)))
    points[:3] = np.moveaxis(stacked, -1, 0).swapaxes(1, 2)
    content["parameters"]["POINT"]["RATE"]["value"] = [rate]
    content["parameters"]["POINT"]["LABELS"]["value"] = list(places)
    stated = {"UNITS": "mm", "X_SCREEN": "+X", "Y_SCREEN": "+Z"} if point is None else point
    for name, value in stated.items():
        content.add_parameter("POINT", name, value)
    for name, value in (measures or {}).items():
        content.add_parameter("PROCESSING", name, [value])
    content["data"]["points"] = points
    content["parameters"]["ANALOG"]["RATE"]["value"] = [4 * rate]
    content["parameters"]["ANALOG"]["LABELS"]["value"] = [f"force {n}" for n in range(channels)]
    content["data"]["analogs"] = np.ones((1, channels, 4 * len(stacked)))
    content["data"]["meta_points"]["residuals"] = np.where(np.isnan(points[:1]), -1.0, 1.0)
    content.write(str(path))
    return path


def write_bytes(
    path: Path,
    positions: np.ndarray,
    parameters: Mapping[str, Mapping[str, float | Sequence[str]]],
    processor: int = INTEL,
    scale: float = -1.0,
    *,
    samples: int = 0,
    word_3: int | None = None,
) -> Path:
    """Writes a file byte by byte, as the C3D User Guide says, for what ezc3d does not write.

    Args:
        path: file name.
        positions: (frames, points, 3), in the file's unit and axes; NaN are gaps.
        parameters: by group and name, beside `POINT:USED`, `SCALE` and `RATE`; numbers keep their
            type. The group "" is not there, only what belongs to it.
        processor: whose numbers it holds.
        scale: of integers; negative for floats.
        samples: analog values beside the points of each frame, all of them 1000.
        word_3: how many of them the header states; None is the truth.
    """
    order = ">" if processor == MIPS else "<"

    def floats(values: np.ndarray | Sequence[float]) -> bytes:
        if processor != DEC:
            return np.asarray(values, f"{order}f4").tobytes()
        return np.multiply(values, 4, dtype="<f4").view("<u2").reshape(-1, 2)[:, ::-1].tobytes()

    def entry(number: int, name: str, body: bytes) -> bytes:
        head = struct.pack("bb", len(name), number) + name.encode()
        return head + struct.pack(f"{order}H", 2 + len(body)) + body

    def parameter(number: int, name: str, value: float | Sequence[str]) -> bytes:
        if isinstance(value, int):
            body = struct.pack(f"{order}bbh", 2, 0, value)
        elif isinstance(value, float):
            body = struct.pack("bb", 4, 0) + floats([value])
        else:
            text = "".join(label.ljust(24) for label in value).encode()
            body = struct.pack("bbBB", -1, 2, 24, len(value)) + text
        return entry(number, name, body + b"\0")

    frames, count, _ = positions.shape
    point = {"USED": count, "SCALE": scale, "RATE": 60.0, **parameters.get("POINT", {})}
    groups = {**parameters, "POINT": point}
    section = bytes([1, 0x50, 0, processor])
    for number, (group, values) in enumerate(groups.items(), start=1):
        section += entry(-number, group, b"\0") if group else b""
        section += b"".join(parameter(number, name, value) for name, value in values.items())
    section += bytes(2)
    section += bytes(-len(section) % BLOCK)
    data = np.zeros((frames, 4 * count + samples))
    data[:, 4 * count :] = 1000.0
    lost = np.isnan(positions).any(axis=-1, keepdims=True)
    points = np.where(lost, [0.0, 0.0, 0.0, -1.0], np.insert(positions, 3, 0.0, axis=-1))
    if scale > 0:
        points[..., :3] /= scale
    data[:, : 4 * count] = points.reshape(frames, -1)
    header = bytearray(BLOCK)
    words = [count, samples if word_3 is None else word_3, 1, frames, 0]
    struct.pack_into(f"{order}5H", header, 2, *words)
    struct.pack_into(f"{order}2H", header, 16, 2 + len(section) // BLOCK, 1)
    header[:2], header[12:16] = b"\x02\x50", floats([scale])
    values = floats(data) if scale < 0 else np.round(data).astype(f"{order}i2").tobytes()
    path.write_bytes(bytes(header) + section + values)
    return path
