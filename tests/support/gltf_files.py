"""Small glTF files, made by hand: nodes, a skin, and animations with their arrays as text."""

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
COMPONENTS = {"f4": 5126, "i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}
Keys = Mapping[tuple[int, str], tuple[Any, Any, str]]
"""Times, s, values and interpolation by node and path."""


class Gltf:
    """A glTF file under construction."""

    def __init__(self, nodes: list[dict[str, Any]], **more: Any):
        self.content = b""
        children = {child for node in nodes for child in node.get("children", ())}
        tops = [node for node in range(len(nodes)) if node not in children]
        self.header: dict[str, Any] = {"asset": {"version": "2.0"}, "scenes": [{"nodes": tops}]}
        self.header |= {
            "nodes": nodes,
            "accessors": [],
            "bufferViews": [],
            "animations": [],
            **more,
        }

    def add(self, values: Any, dtype: str = "f4", **more: Any) -> int:
        """The index of a new accessor with these values."""
        array = np.asarray(values, f"<{dtype}")
        width = array.shape[1] if array.ndim > 1 else 1
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": array.nbytes}
        accessor = {"bufferView": len(self.header["bufferViews"]), "count": len(array)}
        accessor |= {"componentType": COMPONENTS[dtype], "type": TYPES[width], **more}
        self.content += array.tobytes()
        self.header["bufferViews"].append(view)
        self.header["accessors"].append(accessor)
        return len(self.header["accessors"]) - 1

    def animate(self, name: str, keys: Keys) -> "Gltf":
        """The same file with one more animation."""
        animation: dict[str, Any] = {"name": name, "samplers": [], "channels": []}
        for (node, path), (times, values, interpolation) in keys.items():
            output = values if isinstance(values, int) else self.add(values)
            target = {"node": node, "path": path}
            sampler = {"input": self.add(times), "output": output, "interpolation": interpolation}
            animation["channels"].append({"sampler": len(animation["samplers"]), "target": target})
            animation["samplers"].append(sampler)
        self.header["animations"].append(animation)
        return self

    def text(self) -> str:
        """The file, with its arrays inside."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.content).decode()
        buffers = [{"byteLength": len(self.content), "uri": uri}]
        return json.dumps({**self.header, "buffers": buffers})


def skinned_walker(places: Mapping[int, np.ndarray]) -> Gltf:
    """`walker` with a mesh: around each of its joints a square of two triangles, 2 cm wide.

    Args:
        places: from the space of each node at rest to the world, (4, 4).
    """
    file = walker()
    square = 0.01 * np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    joints = file.header["skins"][0]["joints"]
    vertices = np.concatenate([places[joint][:3, 3] + square for joint in joints])
    followed = np.zeros((len(vertices), 4))
    followed[:, 0] = np.repeat(np.arange(len(joints)), len(square))
    faces = np.array([0, 1, 2, 0, 2, 3]) + len(square) * np.arange(len(joints))[:, None]
    binds = np.stack([np.linalg.inv(places[joint]).T.ravel() for joint in joints])
    file.header["skins"][0]["inverseBindMatrices"] = file.add(binds)
    attributes = {
        "POSITION": file.add(vertices),
        "JOINTS_0": file.add(followed, "u1"),
        "WEIGHTS_0": file.add(np.tile([1.0, 0, 0, 0], (len(vertices), 1))),
    }
    primitive = {"attributes": attributes, "indices": file.add(faces.ravel(), "u2"), "material": 0}
    file.header["materials"] = [{"name": "cloth"}]
    file.header["meshes"] = [{"primitives": [primitive]}]
    file.header["nodes"].append({"name": "body", "mesh": 0, "skin": 0})
    file.header["scenes"][0]["nodes"].append(len(file.header["nodes"]) - 1)
    return file


def walker() -> Gltf:
    """A character of two legs under a turned and scaled node, which stands and moves along."""
    armature = {"name": "Armature", "rotation": [0.5, 0.5, 0.5, 0.5], "scale": [0.01] * 3}
    hips = {"name": "mixamorig:Hips", "translation": [0, 0, 95], "children": [2, 6]}
    nodes: list[dict[str, Any]] = [armature | {"children": [1]}, hips]
    for side, x in (("Left", 10), ("Right", -10)):
        bones = {"UpLeg": [x, 0, 0], "Leg": [0, 2, -45], "Foot": [0, -2, -42]}
        for bone, place in bones.items():
            node = {"name": f"mixamorig:{side}{bone}", "translation": place}
            nodes.append(node | {"children": [len(nodes) + 1]})
        nodes.append({"name": f"mixamorig:{side}ToeBase", "translation": [0, 12, -5]})
    file = Gltf(nodes, skins=[{"joints": list(range(1, 10))}])
    times = np.arange(12) / 30
    travel = np.stack([0 * times, 100 * times, 95 + 0 * times], axis=-1)
    bend = np.stack([np.sin(times), 0 * times, 0 * times, np.cos(times)], axis=-1)
    keys = {(1, "translation"): (times, travel, "LINEAR")}
    return file.animate("Walk", keys | {(3, "rotation"): (times, bend, "LINEAR")})
