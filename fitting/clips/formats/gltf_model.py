"""What of a glTF file besides its motion is kept: its meshes, to be shown and written again."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64, Int64

from fitting.clips.clip import Clip, Model

from .gltf_document import DATA, Document

EVEN = 1e-3  # of a scale, by which it may differ between axes
TRIANGLES = 4  # mode of a primitive
MOST_VERTICES = 20_000  # of a surface on a page
GENERATOR = "jaxik"  # of files whose meshes are bones


def keep(
    document: Document,
    nodes: Mapping[str, int],
    places: Mapping[int, Float64[np.ndarray, "4 4"]],
    above: Float64[np.ndarray, "4 4"],
) -> Model | None:
    """The file of a skeleton, unless it is scaled differently along its axes, or one of ours.

    Our own files show no character, but bones. A file whose other parts are damaged is not kept.

    Args:
        document: the file.
        nodes: of the skeleton, by the names of its joints.
        places: from the space of each node at rest to the world.
        above: from the space in which the skeleton's root is placed to the world.

    Raises:
        ValueError: a buffer cannot be read.
    """
    scales = {name: _even_scale(places[node]) for name, node in nodes.items()}
    even = {name: scale for name, scale in scales.items() if scale is not None}
    asset = document.header.get("asset")
    is_ours = isinstance(asset, Mapping) and asset.get("generator") == GENERATOR
    if is_ours or len(even) < len(nodes) or _even_scale(above) is None:
        return None
    try:
        return Model(*_in_one_buffer(document), nodes, even, above)
    except (KeyError, IndexError, TypeError, AttributeError):
        return None


def _even_scale(matrix: Float64[np.ndarray, "4 4"]) -> float | None:
    """The scale of a transform, if it is the same along all axes and mirrors nothing."""
    linear = matrix[:3, :3]
    squares = linear.T @ linear
    scale = float(np.sqrt(np.trace(squares) / 3.0))
    is_even = np.abs(squares - scale**2 * np.eye(3)).max() <= EVEN * scale**2
    return scale if is_even and scale > 0 and np.linalg.det(linear) > 0 else None


def _in_one_buffer(document: Document) -> tuple[dict[str, Any], bytes]:
    """The header with all buffers, and pictures from beside the file, as one binary part."""
    header = copy.deepcopy(dict(document.header))
    content, starts = bytearray(), []
    for number in range(len(document.items("buffers"))):
        starts.append(_append(content, document.buffer(number)))
    views = header.setdefault("bufferViews", [])
    for view in views:
        view["byteOffset"] = starts[view["buffer"]] + view.get("byteOffset", 0)
        view["buffer"] = 0
    for image in header.get("images", []):
        uri = image.get("uri", DATA)
        path = document.folder / unquote(uri)
        if uri.startswith(DATA) or ".." in Path(unquote(uri)).parts or not path.is_file():
            continue
        picture = path.read_bytes()
        views.append({
            "buffer": 0, "byteOffset": _append(content, picture), "byteLength": len(picture),
        })  # fmt: skip
        del image["uri"]
        kind = "jpeg" if path.suffix.lower() in (".jpg", ".jpeg") else "png"
        image |= {"bufferView": len(views) - 1, "mimeType": f"image/{kind}"}
    header["buffers"] = [{"byteLength": len(content)}]
    return header, bytes(content)


def _append(content: bytearray, part: bytes) -> int:
    """Where a part begins that is appended, at a multiple of four bytes."""
    content += b"\0" * (-len(content) % 4)
    start = len(content)
    content += part
    return start


class Surface(NamedTuple):
    """The triangles of a skinned mesh, and the joints that they follow."""

    vertices: Float64[np.ndarray, "vertices 3"]
    """In the space of the mesh."""
    triangles: Int64[np.ndarray, "triangles 3"]
    followed: Int64[np.ndarray, "vertices 4"]
    """Slots."""
    weights: Float64[np.ndarray, "vertices 4"]
    """Of the slots; their sum is 1."""
    joints: tuple[int, ...]
    """Joint of the clip of each slot."""
    binds: Float64[np.ndarray, "slots 3 4"]
    """From the mesh to the space of the joint, in m."""


def surface(clip: Clip) -> Surface | None:
    """The mesh of a clip's character with at most `MOST_VERTICES`; None if it has none."""
    model = clip.model
    if model is None:
        return None
    document = Document(model.header, model.binary, Path(), len(model.binary))
    try:
        parts = [
            _part(clip, document, document.items("skins")[node["skin"]], primitive)
            for node in document.items("nodes")
            if "mesh" in node and "skin" in node
            for primitive in document.items("meshes")[node["mesh"]]["primitives"]
            if primitive.get("mode", TRIANGLES) == TRIANGLES
        ]
    except (ValueError, KeyError, IndexError, TypeError):  # compressed, sparse, or not in order
        return None
    return _simplified(_joined(parts)) if parts else None


def _part(clip: Clip, document: Document, skin: Mapping[str, Any], primitive: Any) -> Surface:
    """One primitive, each joint of its skin as a slot."""
    attributes, model = primitive["attributes"], clip.model
    assert model is not None
    vertices = document.array(attributes["POSITION"])
    followed = document.array(attributes["JOINTS_0"]).astype(np.int64)
    weights = document.array(attributes["WEIGHTS_0"])
    weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
    corners = np.arange(len(vertices))
    if "indices" in primitive:
        corners = document.array(primitive["indices"])[:, 0].astype(np.int64)
    names = {node: name for name, node in model.nodes.items()}
    names_of_slots = [names[node] for node in skin["joints"]]
    binds = np.tile(np.eye(4), (len(names_of_slots), 1, 1))
    if "inverseBindMatrices" in skin:
        binds = document.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    scales = np.array([model.scales[name] for name in names_of_slots])
    joints = tuple(clip.joint_names.index(name) for name in names_of_slots)
    if followed.max() >= len(joints) or corners.max() >= len(vertices):
        raise ValueError("a vertex follows a joint, or a triangle a vertex, that does not exist")
    triangles = corners[: len(corners) // 3 * 3].reshape(-1, 3)
    return Surface(
        vertices, triangles, followed, weights, joints, scales[:, None, None] * binds[:, :3]
    )


def _joined(parts: list[Surface]) -> Surface:
    """Several surfaces as one."""
    vertices = np.cumsum([0, *(len(part.vertices) for part in parts)])
    slots = np.cumsum([0, *(len(part.joints) for part in parts)])
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + n for part, n in zip(parts, vertices, strict=False)]),
        np.concatenate([part.followed + n for part, n in zip(parts, slots, strict=False)]),
        np.concatenate([part.weights for part in parts]),
        tuple(joint for part in parts for joint in part.joints),
        np.concatenate([part.binds for part in parts]),
    )


def _simplified(whole: Surface) -> Surface:
    """The surface with vertices that share a cell of a grid as one, with so few cells as it takes.

    Only vertices that mostly follow the same joint become one: an arm does not grow to the trunk.
    """
    low = whole.vertices.min(axis=0)
    cells = 2.0**14
    size = max(float(np.ptp(whole.vertices, axis=0).max()), 1e-9)
    main = whole.followed[np.arange(len(whole.weights)), whole.weights.argmax(axis=1)]
    while True:
        grid = np.floor((whole.vertices - low) * cells / size).astype(np.int64)
        keys = np.column_stack([grid, main])
        _, first, cell = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        if len(first) <= MOST_VERTICES:
            break
        cells /= 1.3
    triangles = cell.reshape(-1)[whole.triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    return whole._replace(
        vertices=whole.vertices[first], triangles=triangles,
        followed=whole.followed[first], weights=whole.weights[first],
    )  # fmt: skip
