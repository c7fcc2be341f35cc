"""Writes clips as GLB: a skeleton with one animation, and if wanted the terrain beside it.

A clip from a glTF file with a skinned mesh keeps all that is in it, but for its animations. Of
other clips, some programs, Unreal Engine among them, make a skeleton only of a mesh that hangs on
it: each bone is an octahedron from a joint to its child, as wide as in Blender, and moves with it.
"""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from fitting.clips.clip import Clip, Model, continuous, local_from_world, world_from_local
from fitting.clips.rigs import rotation, unit

from .gltf_model import GENERATOR

COMPONENTS = {"<f4": 5126, "<u4": 5125, "<u2": 5123}
MAGIC, VERSION = b"glTF", 2
BODY = "body"
STILL = 1e-6  # m; a joint that moves less against its parent needs no track of positions
TERRAIN = "terrain"
GREY = [0.6, 0.6, 0.6, 1.0]

Triangles = tuple[Float64[np.ndarray, "vertices 3"], Int64[np.ndarray, "faces 3"]]
"""Vertices, m, and their indices in each face."""

THICKEST, WIDTH = 0.15, 0.08  # of a bone's length: from its joint, and across to each side
SHORTEST = 1e-6  # m; a shorter bone has no direction
LONELY = np.array([0.0, 0.1, 0.0])  # m, of the bone of a skeleton that has none
# Corners: the joint, four around the bone, the child. Counterclockwise from outside.
RING = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
FACES = np.array(
    [[0, 1 + (k + 1) % 4, 1 + k] for k in range(4)]
    + [[5, 1 + k, 1 + (k + 1) % 4] for k in range(4)]
)


class _Buffer:
    """The binary part of a file, and the accessors of its arrays."""

    def __init__(self, content: bytes = b"", header: dict[str, Any] | None = None) -> None:
        header = {} if header is None else header
        self.content = bytearray(content) + b"\0" * (-len(content) % 4)
        self.views: list[dict[str, Any]] = header.setdefault("bufferViews", [])
        self.accessors: list[dict[str, Any]] = header.setdefault("accessors", [])

    def add(self, array: np.ndarray, kind: str, *, with_range: bool = False) -> int:
        """Appends numbers of 16 bits as they are, others in 32; returns the accessor's index."""
        whole = "<u2" if array.dtype == np.uint16 else "<u4"
        dtype = whole if array.dtype.kind in "iu" else "<f4"
        array = array.astype(dtype)
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.content), "byteLength": array.nbytes}
        )
        self.content += array.tobytes()
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": COMPONENTS[dtype],
        }
        accessor |= {"count": len(array), "type": kind}
        if with_range:
            columns = array.reshape(len(array), -1)
            accessor |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def glb_bytes(clip: Clip, ground: Triangles | None = None) -> bytes:
    """A GLB file: metres, y up; each joint is a node under its own name, and all are one skin.

    A mesh of bones hangs on the skin, as some programs take no skeleton without a mesh.

    Args:
        clip: any clip.
        ground: world space; a node of its own beside the skeleton.
    """
    if clip.model is not None:
        return _model_bytes(clip, clip.model, ground)
    buffer, joints = _Buffer(), len(clip.parents)
    rest = np.tile([1.0, 0.0, 0.0, 0.0], (joints, 1))
    rest = rest if clip.rest_rotations_ls is None else clip.rest_rotations_ls
    at_rest = _rest_pose(clip, rest)
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": list(map(float, offset)), "rotation": _xyzw(rot).tolist()}
        for name, offset, rot in zip(clip.joint_names, clip.offsets_ls, rest, strict=True)
    ]
    for joint, parent in enumerate(clip.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    roots = [joint for joint, parent in enumerate(clip.parents) if parent < 0]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": nodes,
        "skins": [{
            "name": "skeleton",
            "joints": list(range(joints)),
            "inverseBindMatrices": buffer.add(_inverse_bind_matrices(*at_rest), "MAT4"),
        }],
        "meshes": [_body(at_rest[0], clip.parents, buffer)],
        "animations": [_animation(clip, buffer)],
    }  # fmt: skip
    if len(roots) == 1:
        document["skins"][0]["skeleton"] = roots[0]
    beside = [{"name": BODY, "mesh": 0, "skin": 0}]
    if ground is not None:
        mesh, document["materials"] = _ground(ground, buffer)
        document["meshes"].append(mesh)
        beside.append({"name": TERRAIN, "mesh": 1})
    document["scenes"][0]["nodes"] += range(joints, joints + len(beside))
    nodes += beside
    document |= {
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.content)}],
    }
    return _container(json.dumps(document, separators=(",", ":")).encode(), bytes(buffer.content))


def _model_bytes(clip: Clip, model: Model, ground: Triangles | None) -> bytes:
    """The file from which a clip came with the clip as its only animation."""
    document = copy.deepcopy(dict(model.header))
    buffer = _Buffer(model.binary, document)
    nodes = document["nodes"]
    document["animations"] = [_animation_of_model(clip, model, nodes, buffer)]
    if ground is not None:
        materials, meshes = document.setdefault("materials", []), document.setdefault("meshes", [])
        mesh, grey = _ground(ground, buffer, len(materials))
        materials += grey
        meshes.append(mesh)
        nodes.append({"name": TERRAIN, "mesh": len(meshes) - 1})
        document["scenes"][document.get("scene", 0)].setdefault("nodes", []).append(len(nodes) - 1)
    document["buffers"] = [{"byteLength": len(buffer.content)}]
    return _container(json.dumps(document, separators=(",", ":")).encode(), bytes(buffer.content))


def _animation_of_model(
    clip: Clip, model: Model, nodes: list[dict[str, Any]], buffer: _Buffer
) -> dict[str, Any]:
    """The clip in the nodes of the file: each joint below its parent, with the scales there."""
    above_scale = float(np.cbrt(np.linalg.det(model.above[:3, :3])))
    above = Rotation.from_matrix(model.above[:3, :3] / above_scale)
    tracks = _Tracks(clip, buffer)
    for joint, (name, parent) in enumerate(zip(clip.joint_names, clip.parents, strict=True)):
        if name not in model.nodes:  # a ball of the foot that the file lacks
            continue
        node, turn = nodes[model.nodes[name]], rotation(clip.rotations_ws[:, joint])
        if parent < 0:
            origin, parent_turn, scale = model.above[:3, 3], above, above_scale
        else:
            origin, scale = clip.positions_ws[:, parent], model.scales[clip.joint_names[parent]]
            parent_turn = rotation(clip.rotations_ws[:, parent])
        offset = parent_turn.inv().apply(clip.positions_ws[:, joint] - origin) / scale
        local = (parent_turn.inv() * turn).as_quat(scalar_first=True)
        if "matrix" in node:  # which excludes an animation
            del node["matrix"]
            node["scale"] = [model.scales[name] / scale] * 3
            node |= {"translation": offset[0].tolist(), "rotation": _xyzw(local[0]).tolist()}
        rest = np.array(node.get("translation", [0.0, 0.0, 0.0]))
        if np.abs(offset - rest).max() * scale > STILL:
            tracks.add(model.nodes[name], "translation", offset, "VEC3")
        tracks.add(model.nodes[name], "rotation", _xyzw(continuous(local)), "VEC4")
    return tracks.animation


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


def _rest_pose(
    clip: Clip, rest: np.ndarray
) -> tuple[Float64[np.ndarray, "joints 3"], Float64[np.ndarray, "joints 4"]]:
    """Places and rotations of all joints in the space of the skeleton."""
    pose = np.array(clip.offsets_ls[None]), np.array(rest[None])  # SciPy refuses read-only ones
    positions, rotations = world_from_local(clip.parents, *pose)
    return positions[0], rotations[0]


def _body(places: np.ndarray, parents: tuple[int, ...], buffer: _Buffer) -> dict[str, Any]:
    """The bones as a mesh that follows the joints."""
    vertices, faces, owners = bone_mesh(places, parents)
    followed = np.zeros((len(owners), 4), np.uint16)
    followed[:, 0] = owners
    weights = np.tile([1.0, 0.0, 0.0, 0.0], (len(owners), 1))
    attributes = {
        "POSITION": buffer.add(vertices, "VEC3", with_range=True),
        "JOINTS_0": buffer.add(followed, "VEC4"),
        "WEIGHTS_0": buffer.add(weights, "VEC4"),
    }
    indices = buffer.add(faces.reshape(-1), "SCALAR")
    return {"name": BODY, "primitives": [{"attributes": attributes, "indices": indices}]}


def _inverse_bind_matrices(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """From the space of the skeleton to that of each joint in the rest pose, columns first."""
    # The rows of a rotation matrix are the columns of its inverse.
    columns = rotation(rotations).as_matrix()
    inverse = np.zeros((len(columns), 4, 4))
    inverse[:, :3, :3] = columns
    inverse[:, 3, :3] = -np.einsum("ji,jik->jk", positions, columns)
    inverse[:, 3, 3] = 1.0
    return inverse


def _animation(clip: Clip, buffer: _Buffer) -> dict[str, Any]:
    """Rotations of all joints, and positions of those that move against their parents."""
    positions_ls, rotations_ls = local_from_world(
        clip.parents, clip.positions_ws, clip.rotations_ws
    )
    tracks = _Tracks(clip, buffer)
    for joint in range(len(clip.parents)):
        moves = np.abs(positions_ls[:, joint] - clip.offsets_ls[joint]).max() > STILL
        if moves:
            tracks.add(joint, "translation", positions_ls[:, joint], "VEC3")
        tracks.add(joint, "rotation", _xyzw(rotations_ls[:, joint]), "VEC4")
    return tracks.animation


class _Tracks:
    """An animation under construction, with a key in each frame of a clip."""

    def __init__(self, clip: Clip, buffer: _Buffer) -> None:
        self.buffer = buffer
        self.time = buffer.add(np.arange(clip.frame_count) / clip.fps, "SCALAR", with_range=True)
        name = Path(clip.source).stem or "motion"
        self.animation: dict[str, Any] = {"name": name, "samplers": [], "channels": []}

    def add(self, node: int, path: str, values: np.ndarray, kind: str) -> None:
        """A property of a node, one value for each frame."""
        samplers = self.animation["samplers"]
        target = {"node": node, "path": path}
        self.animation["channels"].append({"sampler": len(samplers), "target": target})
        samplers.append({"input": self.time, "output": self.buffer.add(values, kind)})


def _ground(
    ground: Triangles, buffer: _Buffer, material: int = 0
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A mesh, and its materials, the first of which has this number: grey, seen from both sides."""
    vertices, faces = ground
    primitive = {
        "attributes": {"POSITION": buffer.add(vertices, "VEC3", with_range=True)},
        "indices": buffer.add(faces.reshape(-1), "SCALAR"),
        "material": material,
    }
    surface = {"baseColorFactor": GREY, "metallicFactor": 0.0}
    grey = {"name": TERRAIN, "doubleSided": True, "pbrMetallicRoughness": surface}
    return {"name": TERRAIN, "primitives": [primitive]}, [grey]


def bone_mesh(
    joints_ms: Float64[np.ndarray, "joints 3"], parents: tuple[int, ...]
) -> tuple[
    Float64[np.ndarray, "vertices 3"], Int64[np.ndarray, "faces 3"], Int64[np.ndarray, " vertices"]
]:
    """Vertices, m, faces, counterclockwise from outside, and the joint that each vertex follows.

    Args:
        joints_ms: places of the joints in the rest pose, m.
        parents: index of each joint's parent, -1 at the root.
    """
    ends = [(parent, joints_ms[joint]) for joint, parent in enumerate(parents) if parent >= 0]
    bones = [(parent, end - joints_ms[parent]) for parent, end in ends]
    bones = [(parent, bone) for parent, bone in bones if np.linalg.norm(bone) > SHORTEST]
    bones = bones or [(0, LONELY)]
    vertices = [joints_ms[parent] + _octahedron(bone) for parent, bone in bones]
    faces = [FACES + number * len(RING) + 2 * number for number in range(len(bones))]
    owners = np.repeat([parent for parent, _ in bones], len(RING) + 2)
    return np.concatenate(vertices), np.concatenate(faces), owners


def _octahedron(bone: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "corners 3"]:
    """The corners of a bone that begins at the origin."""
    across = unit(np.cross(bone, np.eye(3)[np.argmin(np.abs(bone))]))
    both = np.stack([across, np.cross(unit(bone), across)])
    ring = THICKEST * bone + WIDTH * np.linalg.norm(bone) * RING @ both
    return np.concatenate([[0.0 * bone], ring, [bone]])
