"""What passes between Blender and jaxik: files of motion, ground and bones. Needs no Blender.

Inside the add-on everything is in the axes and units of the scene; in the files it is in metres
with y up. Matrices act on columns.
"""

import json
import struct
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np

TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
ROLES = ("hip", "knee", "ankle", "toe")
SIDES = ("left", "right")
TINY = 1e-9  # of a scale: bones are hidden by such
FLOAT, WHOLE_FILE = 5126, 0  # of glTF


class Refusal(Exception):
    """What cannot be used, in one line for the user."""


class Motion(NamedTuple):
    """Where bones are, in the world."""

    names: list[str]
    parents: list[int]
    """-1 at roots; parents come first."""
    positions: np.ndarray
    """(frames, bones, 3)."""
    rotations: np.ndarray
    """(frames, bones, 3, 3), without scale."""


class Solution(NamedTuple):
    """What jaxik makes of a motion."""

    motion: Motion
    contacts: dict[str, np.ndarray]
    """By leg, (frames,): 1 where its foot stands, 0 where it swings."""
    pelvis: int
    """Number of its bone."""


def rigid(matrices: np.ndarray) -> np.ndarray:
    """The rotations, (..., 3, 3), of linear maps: their y axes stay, as bones lie along these.

    Raises:
        Refusal: a map mirrors.
    """
    if (np.linalg.det(matrices) < -(TINY**3)).any():
        raise Refusal("the armature or a bone has a negative scale; apply it first")
    x, y = matrices[..., 0], matrices[..., 1]
    lengths = np.linalg.norm(matrices, axis=-2).min(axis=-1)[..., None]
    y = y / np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), TINY)
    x = x - np.sum(x * y, axis=-1, keepdims=True) * y
    x = x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), TINY)
    turns = np.stack([x, y, np.cross(x, y)], axis=-1)
    return np.where(lengths[..., None] > TINY, turns, np.eye(3))


def quaternions(turns: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) as quaternions wxyz, (..., 4)."""
    rows = np.moveaxis(turns, (-2, -1), (0, 1))
    (a, b, c), (d, e, f), (g, h, i) = rows
    products = np.array([  # 4 q qᵀ; any row is a multiple of q
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ])  # fmt: skip
    largest = np.argmax(np.einsum("kk...->k...", products), axis=0)
    quats = np.take_along_axis(products, largest[None, None], axis=0)[0]
    return np.moveaxis(quats / np.linalg.norm(quats, axis=0), 0, -1)


def matrices(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz, (..., 4), as rotations (..., 3, 3)."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def relative(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Positions and rotations of bones in the space of their parents; of roots in the world."""
    positions, rotations = motion.positions.copy(), motion.rotations.copy()
    for bone, parent in enumerate(motion.parents):
        if parent >= 0:
            inverse = motion.rotations[:, parent].swapaxes(-1, -2)
            offset = motion.positions[:, bone] - motion.positions[:, parent]
            positions[:, bone] = (inverse @ offset[..., None])[..., 0]
            rotations[:, bone] = inverse @ motion.rotations[:, bone]
    return positions, rotations


def y_up(motion: Motion, metres: float) -> Motion:
    """A motion of the scene as files have it.

    Args:
        motion: of the scene.
        metres: of one unit of the scene.
    """
    turned = motion.positions @ TO_Y_UP.T * metres
    return motion._replace(positions=turned, rotations=TO_Y_UP @ motion.rotations)


def z_up(motion: Motion, metres: float) -> Motion:
    """The opposite of `y_up`."""
    turned = motion.positions @ TO_Y_UP / metres
    return motion._replace(positions=turned, rotations=TO_Y_UP.T @ motion.rotations)


def write_clip(path: Path, motion: Motion, rest: Motion, rate: float) -> None:
    """Writes a motion as GLB, a node for each bone.

    Args:
        path: of the file.
        motion: in metres, y up.
        rest: the same bones at rest, in one frame.
        rate: frames per second.
    """
    frames, bones = motion.positions.shape[:2]
    positions, rotations = relative(motion)
    rest_positions, rest_rotations = relative(rest)
    quats, rest_quats = (
        np.roll(quaternions(turns), -1, axis=-1) for turns in (rotations, rest_rotations)
    )
    times = np.arange(frames) / rate
    content = bytearray()
    accessors = []

    def add(values: np.ndarray, kind: str, **limits: list[float]) -> int:
        accessors.append({
            "bufferView": WHOLE_FILE, "byteOffset": len(content), "componentType": FLOAT,
            "count": frames, "type": kind, **limits,
        })  # fmt: skip
        content.extend(values.astype("<f4").tobytes())
        return len(accessors) - 1

    clock = add(times, "SCALAR", min=[0.0], max=[float(np.float32(times[-1]))])
    samplers, channels, nodes = [], [], []
    for bone, name in enumerate(motion.names):
        nodes.append({
            "name": name,
            "translation": rest_positions[0, bone].tolist(),
            "rotation": rest_quats[0, bone].tolist(),
        })  # fmt: skip
        if children := [child for child, above in enumerate(motion.parents) if above == bone]:
            nodes[-1]["children"] = children
        of_bone = [("translation", "VEC3", positions), ("rotation", "VEC4", quats)]
        for path_of_node, kind, values in of_bone:
            samplers.append({"input": clock, "output": add(values[:, bone], kind)})
            target = {"node": bone, "path": path_of_node}
            channels.append({"sampler": len(samplers) - 1, "target": target})
    # Below one node, as of skeletons with several roots only one would be read.
    roots = [bone for bone, parent in enumerate(motion.parents) if parent < 0]
    nodes.append({"children": roots})
    header = {
        "asset": {"version": "2.0", "generator": "jaxik for Blender"},
        "scene": 0, "scenes": [{"nodes": [bones]}], "nodes": nodes,
        "animations": [{"channels": channels, "samplers": samplers}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": len(content)}],
        "buffers": [{"byteLength": len(content)}],
    }  # fmt: skip
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    parts = [(b"JSON", text), (b"BIN\0", bytes(content))]
    body = b"".join(struct.pack("<I4s", len(part), kind) + part for kind, part in parts)
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


def write_ground(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Writes a mesh as PLY; vertices (n, 3) in metres, y up, triangles (m, 3) by number."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, triangles
    path.write_bytes(head.encode() + vertices.astype("<f4").tobytes() + faces.tobytes())


def write_map(path: Path, bones: dict[str, str]) -> None:
    """Writes which bone is which, by role."""
    lines = [f"{role} = {json.dumps(name, ensure_ascii=False)}\n" for role, name in bones.items()]
    path.write_text("".join(lines), encoding="utf-8")


def read_map(text: str) -> dict[str, str]:
    """Which bone is which, by role, of pelvis and two legs; "" where jaxik does not know."""
    known = tomllib.loads(text)
    return {role: known.get(role, "") for role in roles()}


def roles() -> list[str]:
    """The roles of pelvis and two legs, `hip_left` among them."""
    return ["pelvis", *(f"{role}_{side}" for side in SIDES for role in ROLES)]


def required() -> list[str]:
    """The roles that have to be there: a foot may end at its ankle."""
    return [role for role in roles() if not role.startswith("toe")]


def read_solution(path: Path, motion: Motion) -> Solution:
    """What `jaxik run` has written of a motion's bones; in metres, y up."""
    with np.load(path) as content:
        if "contact" not in content:
            raise Refusal("jaxik is older than this add-on; update it, or let it write the add-on")
        order = [content["joint_names"].tolist().index(name) for name in motion.names]
        legs, pelvis = content["rig_names"].tolist(), int(content["rig_pelvis"])
        contacts = dict(zip(legs, content["contact"].T, strict=True))
        rotations = matrices(content["rotations_ws"][:, order])
        motion = motion._replace(positions=content["positions_ws"][:, order], rotations=rotations)
    return Solution(motion, contacts, order.index(pelvis))
