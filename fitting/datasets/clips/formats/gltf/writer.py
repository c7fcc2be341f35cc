"""Writes clips as GLB: a skeleton with one animation, and if wanted the terrain beside it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.kinematics import local_from_world, world_from_local
from fitting.datasets.terrain.meshes import Mesh

FLOAT, UNSIGNED = 5126, 5125  # component types
MAGIC, VERSION = b"glTF", 2
STILL = 1e-6  # m; a joint that moves less against its parent needs no track of positions
TERRAIN = "terrain"
GREY = [0.6, 0.6, 0.6, 1.0]


class _Buffer:
    """The binary part of a file, and the accessors of its arrays."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, kind: str, *, with_range: bool = False) -> int:
        """Appends an array of 32-bit numbers, and returns the index of its accessor."""
        component = UNSIGNED if array.dtype.kind in "iu" else FLOAT
        array = array.astype("<u4" if component == UNSIGNED else "<f4")
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.content), "byteLength": array.nbytes}
        )
        self.content += array.tobytes()
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": component}
        accessor |= {"count": len(array), "type": kind}
        if with_range:
            columns = array.reshape(len(array), -1)
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def glb_bytes(clip: Clip, ground: Mesh | None = None) -> bytes:
    """A GLB file: metres, y up; each joint is a node under its own name, and all are one skin.

    Args:
        clip: any clip.
        ground: world space; a node of its own beside the skeleton.
    """
    buffer, joints = _Buffer(), len(clip.parents)
    rest = np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1))
    rest = rest if clip.rest_rotations_ls is None else clip.rest_rotations_ls
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": list(map(float, offset)), "rotation": _xyzw(rot).tolist()}
        for name, offset, rot in zip(clip.joint_names, clip.offsets_ls, rest, strict=True)
    ]
    for joint, parent in enumerate(clip.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    roots = [joint for joint, parent in enumerate(clip.parents) if parent < 0]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "jaxik"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": nodes,
        "skins": [{
            "name": "skeleton",
            "joints": list(range(joints)),
            "inverseBindMatrices": buffer.add(_inverse_bind_matrices(clip, rest), "MAT4"),
        }],
        "animations": [_animation(clip, buffer)],
    }  # fmt: skip
    if len(roots) == 1:
        document["skins"][0]["skeleton"] = roots[0]
    if ground is not None:
        document |= _ground(ground, buffer)
        nodes.append({"name": TERRAIN, "mesh": 0})
        document["scenes"][0]["nodes"].append(len(nodes) - 1)
    document |= {
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.content)}],
    }
    return _container(json.dumps(document, separators=(",", ":")).encode(), bytes(buffer.content))


def _container(text: bytes, content: bytes) -> bytes:
    """The header and the binary part as chunks of one file."""
    text += b" " * (-len(text) % 4)
    content += b"\0" * (-len(content) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text
    chunks += len(content).to_bytes(4, "little") + b"BIN\0" + content
    size = 12 + len(chunks)
    return MAGIC + VERSION.to_bytes(4, "little") + size.to_bytes(4, "little") + chunks


def _xyzw(wxyz: np.ndarray) -> np.ndarray:
    return np.roll(wxyz, -1, axis=-1)


def _inverse_bind_matrices(clip: Clip, rest: np.ndarray) -> np.ndarray:
    """From the space of the skeleton to that of each joint in the rest pose, columns first."""
    pose = (
        np.array(clip.offsets_ls[None]),
        np.array(rest[None]),
    )  # SciPy refuses read-only ones
    positions, rotations = world_from_local(clip.parents, *pose)
    # The rows of a rotation matrix are the columns of its inverse.
    columns = Rotation.from_quat(rotations[0], scalar_first=True).as_matrix()
    inverse = np.zeros((len(columns), 4, 4))
    inverse[:, :3, :3] = columns
    inverse[:, 3, :3] = -np.einsum("ji,jik->jk", positions[0], columns)
    inverse[:, 3, 3] = 1.0
    return inverse


def _animation(clip: Clip, buffer: _Buffer) -> dict[str, Any]:
    """Rotations of all joints, and positions of those that move against their parents."""
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    time = buffer.add(np.arange(clip.frame_count) / clip.fps, "SCALAR", with_range=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def add(joint: int, path: str, values: np.ndarray, kind: str) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": joint, "path": path}})
        samplers.append({"input": time, "output": buffer.add(values, kind)})

    for joint in range(len(clip.parents)):
        moves = np.abs(positions_ls[:, joint] - clip.offsets_ls[joint]).max() > STILL
        if moves:
            add(joint, "translation", positions_ls[:, joint], "VEC3")
        add(joint, "rotation", _xyzw(rotations_ls[:, joint]), "VEC4")
    return {"name": Path(clip.source).stem or "motion", "samplers": samplers, "channels": channels}


def _ground(ground: Mesh, buffer: _Buffer) -> dict[str, Any]:
    """A mesh, and its grey material that is seen from both sides."""
    primitive = {
        "attributes": {"POSITION": buffer.add(ground.vertices, "VEC3", with_range=True)},
        "indices": buffer.add(ground.faces.reshape(-1), "SCALAR"),
        "material": 0,
    }
    surface = {"baseColorFactor": GREY, "metallicFactor": 0.0}
    material = {"name": TERRAIN, "doubleSided": True, "pbrMetallicRoughness": surface}
    return {"meshes": [{"name": TERRAIN, "primitives": [primitive]}], "materials": [material]}
