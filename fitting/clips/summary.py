"""Summary of a clip: what the loader understood of a file, as data, text or JSON."""

import json
from typing import Any

import numpy as np

from . import contacts, edit
from .clip import Clip
from .joint_maps import LEG_ROLES
from .stances import stances_of

DOUBTFUL = 0.7  # probability of a stance, below which it is named
MOST_NAMED = 5  # of them

Summary = dict[str, Any]


def describe(clip: Clip) -> Summary:
    """What is known of a clip, including guesses and defects, as plain data.

    Lengths are metres, and heights of a leg are over its sole. `scale` is metres per unit of the
    file, `observed_frames` are those that are not masked, `joint_map` gives joint names by role.
    Among the `legs`, `side` is 1 left, -1 right and 0 neither, `knee_axis` a unit vector in knee
    space, `ankle_from_foot` a unit quaternion, wxyz, `contacts` the number of stances of which a
    frame was observed, `contact_share` their fraction of the observed frames, and `contacts_from`
    "contacts file", "file" or "motion".
    """
    warnings = list(clip.remarks)
    (first, last), (start, end) = edit.motion_span(clip), edit.observed_span(clip)
    if first > start:
        warnings.append(f"starts with a T-pose; the motion begins at frame {first}")
    if last < end:
        warnings.append(f"the last frame is repeated {end - last} times")
    if clip.measured_rig is not None and (jumps := int(edit.marker_jumps(clip).sum())):
        warnings.append(f"markers jump in {jumps} frames")
    if clip.measured_rig is not None and (text := _doubtful(clip)):
        warnings.append(text)
    return {
        "file": clip.source,
        "frames": clip.frame_count,
        "observed_frames": int(clip.observed.sum()),
        "seconds": clip.seconds,
        "fps": clip.fps,
        "raw_frame_time": clip.raw_frame_time,
        "raw_fps": 1.0 / clip.raw_frame_time,
        "scale": clip.scale,
        "up_axis": clip.up_axis,
        "body_height": clip.body_height,
        "joints": list(clip.joint_names),
        "dialect": clip.dialect,
        "joint_map": {} if clip.measured_rig is None else _joint_map(clip),
        "legs": {} if clip.measured_rig is None else _describe_legs(clip),
        "warnings": warnings,
    }


def _doubtful(clip: Clip) -> str:
    """The stances that the program found but that may be none; empty if all are sure."""
    doubtful = [
        (stance.probability, f"{leg} from {stance.text} ({stance.probability:.0%})")
        for leg, stances in stances_of(clip).items()
        for stance in stances
        if stance.probability is not None and stance.probability < DOUBTFUL
    ]
    if not doubtful:
        return ""
    named = [text for _, text in sorted(doubtful)[:MOST_NAMED]]
    rest = f" and {len(doubtful) - len(named)} more" if len(doubtful) > len(named) else ""
    return (
        f"these stances may be none: {', '.join(named)}{rest}; where one is wrong, correct it in a "
        "contacts file (--contacts prints it)"
    )


def _joint_map(clip: Clip) -> dict[str, str]:
    rig = clip.rig
    joint_map = {"pelvis": clip.joint_names[rig.pelvis]}
    for name, joints in zip(rig.names, rig.joints, strict=True):
        for role, joint in zip(LEG_ROLES, joints, strict=True):
            joint_map[f"{role}_{name}"] = clip.joint_names[joint]
    return joint_map


def _describe_legs(clip: Clip) -> Summary:
    rig, stance = clip.rig, clip.observed_stances()
    source = "motion" if clip.stance is None else "file"
    if clip.probability is not None:
        source = "contacts file"
    share = stance[clip.observed].sum(axis=0) / max(clip.observed.sum(), 1)
    return {
        name: {
            "side": float(rig.side[leg]),
            "thigh": float(rig.thigh[leg]),
            "shin": float(rig.shin[leg]),
            "foot": float(rig.foot[leg]),
            "ankle_height": float(rig.ankle_height[leg]),
            "ball_height": float(rig.ball_height[leg]),
            "knee_axis": np.asarray(rig.knee_axis_ls[leg]).tolist(),
            "ankle_from_foot": np.asarray(rig.ankle_from_foot[leg]).tolist(),
            "contacts": len(contacts.runs(stance[:, leg])),
            "contact_share": float(share[leg]),
            "contacts_from": source,
        }
        for leg, name in enumerate(rig.names)
    }


def contact_text(summary: Summary, leg: Summary) -> str:
    """How often and how long a foot stands."""
    observed = summary["observed_frames"]
    frames = "frames" if observed == summary["frames"] else f"{observed} observed frames"
    return (
        f"stands {leg['contacts']} times, {leg['contact_share']:.0%} of the {frames} "
        f"(from the {leg['contacts_from']})"
    )


def rows(summary: Summary) -> list[list[str]]:
    """A heading of one cell, then rows of a label, which may be empty, and a text."""
    joints, joint_map = summary["joints"], summary["joint_map"]
    lines = [
        [
            f"{summary['file']}: {summary['frames']} frames, {summary['seconds']:.2f} s at "
            f"{summary['fps']:g} Hz (frame time {summary['raw_frame_time']:g} s is "
            f"{summary['raw_fps']:.6g} Hz)"
        ],
        [
            "scale",
            f"{summary['scale']:.6g} m per unit, {summary['up_axis']} up; "
            f"body {summary['body_height']:.3f} m high",
        ],
        ["joints", f"{len(joints)}: {', '.join(joints)}"],
    ]
    if summary["legs"]:
        lines.append(["map", f"{summary['dialect']}; pelvis {joint_map['pelvis']}"])
    for name, leg in summary["legs"].items():
        names = ", ".join(f"{role} {joint_map[f'{role}_{name}']}" for role in LEG_ROLES)
        axis = ", ".join(f"{value:.3f}" for value in leg["knee_axis"])
        lines += [
            [name, names],
            [
                "",
                f"thigh {leg['thigh']:.3f} m, shin {leg['shin']:.3f} m, "
                f"foot {leg['foot']:.3f} m; knee opens about ({axis})",
            ],
            [
                "",
                f"ankle {leg['ankle_height']:.3f} m and ball {leg['ball_height']:.3f} m over "
                "the sole",
            ],
            ["", contact_text(summary, leg)],
        ]
    return lines + [["note", warning] for warning in summary["warnings"]]


def as_text(summary: Summary) -> str:
    """The summary as text for a pipe."""
    (heading,), *rest = rows(summary)
    return "\n".join([heading, *(f"  {label:<7} {text}" for label, text in rest)])


def as_json(summary: Summary) -> str:
    """The summary as JSON."""
    return json.dumps(summary, indent=2)
