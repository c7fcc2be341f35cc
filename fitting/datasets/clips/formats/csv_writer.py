"""Writes clips as CSV tables: a row for each frame, with the time and all joint positions."""

import csv
from pathlib import Path

import numpy as np

from fitting.datasets.clips.clip import Clip

TIME = "time_s"
AXES = "xyz"
DIGITS = 7  # after the point


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
