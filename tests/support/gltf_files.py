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
        self.header: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scenes": [{"nodes": tops}], "nodes": nodes,
            "accessors": [], "bufferViews": [], "animations": [], **more,
        }  # fmt: skip

    def add(self, values: Any, dtype: str = "f4", **more: Any) -> int:
        """The index of a new accessor with these values."""
        array = np.asarray(values, f"<{dtype}")
        width = array.shape[1] if array.ndim > 1 else 1
        self.header["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.content), "byteLength": array.nbytes}
        )
        self.content += array.tobytes()
        self.header["accessors"].append(
            {"bufferView": len(self.header["bufferViews"]) - 1, "count": len(array)}
            | {"componentType": COMPONENTS[dtype], "type": TYPES[width]} | more
        )  # fmt: skip
        return len(self.header["accessors"]) - 1

    def animate(self, name: str, keys: Keys) -> "Gltf":
        """The same file with one more animation."""
        animation: dict[str, Any] = {"name": name, "samplers": [], "channels": []}
        for (node, path), (times, values, interpolation) in keys.items():
            output = values if isinstance(values, int) else self.add(values)
            target = {"node": node, "path": path}
            animation["channels"].append({"sampler": len(animation["samplers"]), "target": target})
            animation["samplers"].append(
                {"input": self.add(times), "output": output, "interpolation": interpolation}
            )
        self.header["animations"].append(animation)
        return self

    def text(self) -> str:
        """The file, with its arrays inside."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.content).decode()
        buffers = [{"byteLength": len(self.content), "uri": uri}]
        return json.dumps({**self.header, "buffers": buffers})


def walker() -> Gltf:
    """A character of two legs under a turned and scaled node, which stands and moves along."""
    nodes: list[dict[str, Any]] = [
        {"name": "Armature", "children": [1], "rotation": [0.5, 0.5, 0.5, 0.5], "scale": [0.01] * 3}
    ]
    nodes.append({"name": "mixamorig:Hips", "translation": [0, 0, 95], "children": [2, 6]})
    for side, x in (("Left", 10), ("Right", -10)):
        first = len(nodes)
        nodes += [
            {"name": f"mixamorig:{side}UpLeg", "translation": [x, 0, 0], "children": [first + 1]},
            {"name": f"mixamorig:{side}Leg", "translation": [0, 2, -45], "children": [first + 2]},
            {"name": f"mixamorig:{side}Foot", "translation": [0, -2, -42], "children": [first + 3]},
            {"name": f"mixamorig:{side}ToeBase", "translation": [0, 12, -5]},
        ]
    file = Gltf(nodes, skins=[{"joints": list(range(1, 10))}])
    times = np.arange(12) / 30
    travel = np.stack([0 * times, 100 * times, 95 + 0 * times], axis=-1)
    bend = np.stack([np.sin(times), 0 * times, 0 * times, np.cos(times)], axis=-1)
    return file.animate(
        "Walk",
        {(1, "translation"): (times, travel, "LINEAR"), (3, "rotation"): (times, bend, "LINEAR")},
    )
