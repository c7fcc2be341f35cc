"""C3D files of known bodies: markers are put on joints whose places are known."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.datasets.clips import Clip

WIDTHS = {"KneeWidth": 104.0, "AnkleWidth": 70.0}  # mm
MEASURES = {letter + name: width for letter in "LR" for name, width in WIDTHS.items()}
RADIUS = 0.007  # m, of a marker
DEPTH = 0.15  # m, of the pelvis
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
