"""What a loader understood of a file, as data and as text."""

import json

import numpy as np

from . import contacts, edit
from .clip import Clip

JOINTS = ("hip", "knee", "ankle", "toe")


def describe(clip: Clip) -> dict:
    """What is known of a clip, as plain numbers, texts, lists and dicts; lengths in metres."""
    told: dict = {
        "file": clip.source,
        "frames": clip.frame_count,
        "seconds": clip.seconds,
        "fps": clip.fps,
        "raw_frame_time": clip.raw_frame_time,
        "raw_fps": 1.0 / clip.raw_frame_time,
        "scale": clip.scale,
        "up_axis": clip.up_axis,
        "body_height": clip.body_height,
        "joints": list(clip.joint_names),
        "dialect": clip.dialect,
        "joint_map": {},
        "legs": {},
        "warnings": list(clip.remarks),
    }
    first, last = edit.motion_span(clip)
    if first:
        told["warnings"].append(f"starts with a T-pose; the motion begins at frame {first}")
    if last < clip.frame_count - 1:
        told["warnings"].append(f"the last frame is repeated {clip.frame_count - 1 - last} times")
    if clip.measured is not None:
        told |= _describe_legs(clip)
        if popped := int(edit.pops(clip).sum()):
            told["warnings"].append(f"markers pop in {popped} frames")
    return told


def _describe_legs(clip: Clip) -> dict:
    rig = clip.rig
    own = clip.stance is not None
    stance = clip.stance_labels()
    joint_map = {"pelvis": clip.joint_names[rig.pelvis]}
    legs = {}
    for index, name in enumerate(rig.names):
        for part, joint in zip(JOINTS, rig.joints[index], strict=True):
            joint_map[f"{part}_{name}"] = clip.joint_names[joint]
        legs[name] = {
            "side": float(rig.side[index]),
            "thigh": float(rig.thigh[index]),
            "shin": float(rig.shin[index]),
            "foot": float(rig.foot[index]),
            "knee_axis": np.asarray(rig.knee_axis_ls[index]).tolist(),
            "ankle_from_foot": np.asarray(rig.ankle_from_foot[index]).tolist(),
            "contacts": len(contacts.runs(stance[:, index])),
            "contact_share": float(stance[:, index].mean()),
            "contacts_from": "file" if own else "motion",
        }
    return {"joint_map": joint_map, "legs": legs}


def as_text(told: dict) -> str:
    """The answer of `describe` as text for a terminal."""
    lines = [
        f"{told['file']}: {told['frames']} frames, {told['seconds']:.2f} s at {told['fps']:g} Hz "
        f"(frame time {told['raw_frame_time']:g} s is {told['raw_fps']:.6g} Hz)",
        f"  scale   {told['scale']:.6g} m per unit, {told['up_axis']} up; "
        f"body {told['body_height']:.3f} m high",
        f"  joints  {len(told['joints'])}: {', '.join(told['joints'])}",
    ]
    if told["legs"]:
        lines.append(f"  map     {told['dialect']}; pelvis {told['joint_map']['pelvis']}")
    for name, leg in told["legs"].items():
        joints = ", ".join(f"{part} {told['joint_map'][f'{part}_{name}']}" for part in JOINTS)
        axis = ", ".join(f"{value:.3f}" for value in leg["knee_axis"])
        lines += [
            f"  {name:<7} {joints}",
            f"          thigh {leg['thigh']:.3f} m, shin {leg['shin']:.3f} m, "
            f"foot {leg['foot']:.3f} m; knee opens about ({axis})",
            f"          stands {leg['contacts']} times, {leg['contact_share']:.0%} of the frames "
            f"(from the {leg['contacts_from']})",
        ]
    lines += [f"  note    {warning}" for warning in told["warnings"]]
    return "\n".join(lines)


def as_json(told: dict) -> str:
    """The answer of `describe` as JSON."""
    return json.dumps(told, indent=2)
