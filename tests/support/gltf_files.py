"""Small glTF files, made by hand: nodes, a skin, and animations with their arrays as text."""

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
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
