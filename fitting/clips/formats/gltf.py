"""Reader of glTF 2.0 and GLB files: skinned characters and plain nodes with an animation.

All nodes above the skeleton, with their rotations, scales and motion, are part of it: positions
are those of the scene, in metres with y up, as the format has it. Meshes are kept as they are
(`gltf_model`), and read only to be shown; morph targets are not.
"""

import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from fitting.clips.clip import FASTEST, SLOWEST, Model, Recording, local_from_world
from fitting.runtime.validation import error_context

from .gltf_document import (
    BINARY,
    DATA,
    Document,
    Item,
    as_index,
    as_item,
    as_list,
    buffer_path,
    check_accessor,
    check_uncompressed,
)
from .gltf_model import keep

WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
ON_KEY = 1e-5  # s; times that are given with 32 bits are no more exact
LATEST = 1e6  # s
USUAL_RATE = 30.0  # Hz, of animations whose keys follow no rate
RATES = (8.0, 1000.0)  # Hz; keys outside are not frames
ON_GRID = 0.95  # of the keys, which follow a rate
OFF_GRID = 0.02  # of a frame; times of files are often rounded to milliseconds

DEFAULTS = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0,) * 3}
FLAT = 1e-6  # of a length; axes that are less apart have no direction of their own

SUFFIXES = (".glb", ".gltf")
PATHS = tuple(WIDTHS)
MOST_NUMBERS = 1_000_000  # frames times nodes, and keys, of small files; of others their bytes

KINDS = (BINARY, "gltf")
JSON_START = 20  # bytes, in the binary form


@dataclass(frozen=True, eq=False)
class Curve:
    """One property of a node over time."""

    path: str
    """Key of `WIDTHS`."""
    times: Float64[np.ndarray, " keys"]
    """Seconds, ascending."""
    values: Float64[np.ndarray, "keys width"]
    """Quaternions are xyzw."""
    interpolation: str
    """STEP, LINEAR or CUBICSPLINE."""
    slopes: tuple[Float64[np.ndarray, "keys width"], Float64[np.ndarray, "keys width"]] | None
    """Of a CUBICSPLINE: before and after each key, a second."""

    def at(self, times: Float64[np.ndarray, " frames"]) -> Float64[np.ndarray, "frames width"]:
        """The values at these times, s; before the first key and after the last they are theirs.

        A CUBICSPLINE is the Hermite spline of the glTF 2.0 specification, appendix C.
        """
        before = np.clip(
            np.searchsorted(self.times, times + ON_KEY, side="right") - 1, 0, len(self.times) - 1
        )
        after = np.minimum(before + 1, len(self.times) - 1)
        gap = self.times[after] - self.times[before]
        passed = times - self.times[before]
        fraction = np.divide(passed, gap, out=np.zeros_like(passed), where=gap > 0)
        fraction = np.clip(fraction, 0.0, 1.0)[:, None]
        start, end = self.values[before], self.values[after]
        if self.interpolation == "STEP":
            return start
        if self.slopes is not None:
            t, t2, t3 = fraction, fraction**2, fraction**3
            arriving, leaving = self.slopes
            return (
                (2 * t3 - 3 * t2 + 1) * start
                + gap[:, None] * (t3 - 2 * t2 + t) * leaving[before]
                + (3 * t2 - 2 * t3) * end
                + gap[:, None] * (t3 - t2) * arriving[after]
            )
        if self.path == "rotation":
            first, second = (_rotations(quats) for quats in (start, end))
            turn = (first.inv() * second).as_rotvec()  # of the shorter arc
            return (first * Rotation.from_rotvec(fraction * turn)).as_quat()
        return start + fraction * (end - start)


def _rotations(quats: np.ndarray) -> Rotation:
    return Rotation.from_quat(quats)


def read_curve(document: Document, sampler: Item, path: str) -> Curve:
    """The curve of a sampler.

    Raises:
        ValueError: its arrays are not those of a curve.
    """
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise ValueError(f"interpolation {interpolation!r}; wanted STEP, LINEAR or CUBICSPLINE")
    times = document.array(sampler.get("input"))
    if times.shape[1] != 1:
        raise ValueError(f"times have {times.shape[1]} numbers for each key; wanted one")
    times = times[:, 0]
    if (np.diff(times) < 0).any() or np.abs(times).max() > LATEST:
        raise ValueError(f"the times of a {path} are not in order, or beyond {LATEST:g} s")
    values = document.array(sampler.get("output"))
    per_key = 3 if interpolation == "CUBICSPLINE" else 1
    if values.shape != (len(times) * per_key, WIDTHS[path]):
        raise ValueError(
            f"a {path} has {values.shape[0]} x {values.shape[1]} numbers for {len(times)} keys; "
            f"wanted {len(times) * per_key} x {WIDTHS[path]}"
        )
    slopes = None
    if interpolation == "CUBICSPLINE":
        arriving, values, leaving = np.moveaxis(values.reshape(len(times), 3, -1), 1, 0)
        slopes = arriving, leaving
    if path == "rotation" and (np.linalg.norm(values, axis=-1) < 0.1).any():
        raise ValueError("a rotation is not a unit quaternion")
    return Curve(path, times, values, interpolation, slopes)


def frame_times(
    curves: list[Curve], fps: float | None, most: int
) -> tuple[Float64[np.ndarray, " frames"], float, tuple[str, ...]]:
    """The times at which an animation is sampled, s, the time of a frame, s, and remarks.

    Args:
        curves: of the animation.
        fps: Hz; None takes the rate at which its keys lie, or else `USUAL_RATE`.
        most: frames.

    Raises:
        ValueError: there would be more frames.
    """
    keys = np.unique(np.concatenate([curve.times for curve in curves]))
    keys = keys[np.diff(keys, prepend=-np.inf) > ON_KEY * 10]
    span = float(keys[-1] - keys[0])
    remarks = ()
    frame_time = 1.0 / fps if fps is not None else _time_of_frame(keys)
    if frame_time is None:
        frame_time = 1.0 / USUAL_RATE
        if len(keys) > 1:
            remarks = (f"its keys follow no frame rate; sampled at {USUAL_RATE:g} Hz",)
    if span / frame_time >= most:
        raise ValueError(
            f"{span:.4g} s at {1 / frame_time:.4g} frames per second; wanted at most {most} frames "
            "for a file of this size; give a lower fps=... in Python"
        )
    count = int(np.floor(span / frame_time + 0.01)) + 1
    return keys[0] + frame_time * np.arange(count), frame_time, remarks


def _time_of_frame(keys: Float64[np.ndarray, " keys"]) -> float | None:
    """The time, s, of which the gaps between most keys are multiples; None if there is none."""
    gaps = np.diff(keys)
    if not len(gaps):
        return None
    low, high = 1.0 / RATES[1], 1.0 / RATES[0]
    for gap in (float(np.median(gaps)), float(gaps.min())):
        if not low <= gap <= high:
            continue
        frames = np.round((keys - keys[0]) / gap)
        gap = float((keys - keys[0]) @ frames / (frames @ frames))  # the best for all keys
        off = np.abs((keys - keys[0]) / gap - np.round((keys - keys[0]) / gap))
        if (off < OFF_GRID).mean() >= ON_GRID:
            return gap
    return None


Curves = dict[tuple[int, str], Curve]
"""By node and path."""


@dataclass(frozen=True)
class Tree:
    """All nodes with their parents."""

    nodes: list[Item]
    parents: list[int]
    """-1 for those without."""

    @cached_property
    def order(self) -> list[int]:
        """All nodes, parents first and children in the file's order.

        Raises:
            ValueError: nodes are their own ancestors.
        """
        children: dict[int, list[int]] = {}
        for node, parent in enumerate(self.parents):
            children.setdefault(parent, []).append(node)
        ordered, waiting = [], children.get(-1, [])[::-1]
        while waiting:
            ordered.append(node := waiting.pop())
            waiting += reversed(children.get(node, []))
        if len(ordered) < len(self.nodes):
            raise ValueError("there are nodes that are their own ancestors")
        return ordered

    def with_ancestors(self, nodes: Iterable[int]) -> set[int]:
        """The nodes and all that are above them."""
        above: set[int] = set()
        for node in nodes:
            while node >= 0 and node not in above:
                above.add(node)
                node = self.parents[node]
        return above

    def names(self, nodes: list[int]) -> tuple[str, ...]:
        """Names of nodes, made unique."""
        names: dict[str, None] = {}
        for node in nodes:
            name = self.nodes[node].get("name")
            name = name if isinstance(name, str) and name.strip() else f"node_{node}"
            names[name if name not in names else f"{name}_{node}"] = None
        if len(names) < len(nodes):
            return tuple(f"node_{node}" for node in nodes)
        return tuple(names)


def read_tree(document: Document) -> Tree:
    """The nodes of a file.

    Raises:
        ValueError: a node has two parents.
    """
    nodes = document.items("nodes")
    parents = [-1] * len(nodes)
    for node, item in enumerate(nodes):
        for child in as_list(item.get("children", []), f"children of node {node}"):
            child = as_index(child, len(nodes), f"children of node {node}")
            if parents[child] >= 0:
                raise ValueError(f"node {child} has two parents, {parents[child]} and {node}")
            parents[child] = node
    return Tree(nodes, parents)


def find_joints(
    document: Document, tree: Tree, animated: set[int]
) -> tuple[list[int], tuple[str, ...]]:
    """The joints of the skeleton that an animation moves, parents first, and remarks.

    They are the joints of the skins that it moves, the nodes that it moves beside them, or all that
    it moves in a file without skins; what hangs from these, and the nodes between them. Of several
    separate skeletons the one with the most joints is taken.
    """
    ancestors = tree.with_ancestors(animated)
    skins = [
        {as_index(joint, len(tree.nodes), "joints of a skin") for joint in joints}
        for skin in document.items("skins")
        if (joints := as_list(skin.get("joints"), "the joints of a skin"))
    ]
    moved = [joints for joints in skins if joints & ancestors] or skins
    skinned = set().union(*moved)
    beside = animated - tree.with_ancestors(skinned)
    members = skinned | _hanging(tree, skinned | beside, animated)
    if not members:
        raise ValueError("no joints: neither a skin nor a node that the animation moves")
    below = [int(node in members) for node in range(len(tree.nodes))]  # members from a node on
    for node in reversed(tree.order):
        if tree.parents[node] >= 0:
            below[tree.parents[node]] += below[node]
    top = max((node for node in tree.order if tree.parents[node] < 0), key=below.__getitem__)
    inside = {top}
    for node in tree.order:
        if tree.parents[node] in inside and below[node]:
            inside.add(node)
            if top not in members and below[node] == below[top]:  # all of them are below this one
                inside, top = {node}, node
    remarks = []
    if skinned and (unskinned := beside & members & inside):
        remarks.append(f"{len(unskinned)} joints that no skin has are taken too, as they move")
    if others := len(members) - below[top]:
        remarks.append(f"{others} joints of other skeletons in the file are left out")
    return [node for node in tree.order if node in inside], tuple(remarks)


def _hanging(tree: Tree, tops: set[int], animated: set[int]) -> set[int]:
    """Nodes and all below them, without cameras, and without meshes that do not move themselves."""
    below: set[int] = set()
    for node in tree.order:
        if node in tops or tree.parents[node] in below:
            below.add(node)

    def is_joint(node: int) -> bool:
        item = tree.nodes[node]
        return not {"camera", "skin"} & set(item) and ("mesh" not in item or node in animated)

    return {node for node in below if is_joint(node)}


def world_transforms(
    tree: Tree, joints: list[int], curves: Curves, times: Float64[np.ndarray, " frames"]
) -> tuple[Float64[np.ndarray, "frames joints 3"], Float64[np.ndarray, "frames joints 4"]]:
    """World positions, and rotations wxyz, of joints below all their ancestors.

    Positions are exact with any scales on the way. A joint's axes are those that its x and y axes
    have in the world, made perpendicular; where a scale of 0 leaves none, scales do not count.

    Raises:
        ValueError: a transform is none, or goes beyond what numbers can hold.
    """
    needed = tree.with_ancestors(joints)
    places: dict[int, tuple[np.ndarray, np.ndarray, Rotation]] = {
        -1: (np.zeros((1, 3)), np.eye(3)[None], Rotation.identity(1))
    }
    with np.errstate(all="ignore"):
        for node in (node for node in tree.order if node in needed):
            offset, linear, turn = _local(tree, node, curves, times)
            above, above_linear, above_turn = places[tree.parents[node]]
            position = above + (above_linear @ offset[..., None])[..., 0]
            places[node] = position, above_linear @ linear, above_turn * turn
            if not all(np.isfinite(part).all() for part in places[node][:2]):
                name = tree.names([node])[0]
                raise ValueError(f"node {name} is moved or scaled beyond all bounds")
    frames = len(times)
    positions = [np.broadcast_to(places[joint][0], (frames, 3)) for joint in joints]
    rotations = [np.broadcast_to(_axes(*places[joint][1:]), (frames, 4)) for joint in joints]
    return np.stack(positions, axis=1), np.stack(rotations, axis=1)


def rest_places(tree: Tree) -> dict[int, Float64[np.ndarray, "4 4"]]:
    """From the space of each node at rest to the world; of -1, the world itself."""
    places = {-1: np.eye(4)}
    for node in tree.order:
        offset, linear, _ = _local(tree, node, {}, np.zeros(1))
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = linear[0], offset[0]
        places[node] = places[tree.parents[node]] @ local
    return places


def _axes(linear: np.ndarray, turn: Rotation) -> Float64[np.ndarray, "frames 4"]:
    """The rotation of a linear map, wxyz; `turn` where it has no two axes."""
    x, y = _unit(linear[..., 0]), _unit(linear[..., 1])
    y = y - np.sum(x * y, axis=-1, keepdims=True) * x
    height = np.linalg.norm(y, axis=-1)
    is_known = x.any(axis=-1) & (height > FLAT)
    matrices = np.broadcast_to(turn.as_matrix(), linear.shape).copy()
    x, y = x[is_known], y[is_known] / height[is_known, None]
    matrices[is_known] = np.stack([x, y, np.cross(x, y)], axis=-1)
    return Rotation.from_matrix(matrices).as_quat(scalar_first=True)


def _unit(axes: Float64[np.ndarray, "frames 3"]) -> Float64[np.ndarray, "frames 3"]:
    """Axes of length one, however long or short they were; zero stays zero."""
    largest = np.abs(axes).max(axis=-1, keepdims=True)
    axes = np.divide(axes, largest, out=np.zeros_like(axes), where=largest > 0)
    return axes / np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1.0)


def _local(
    tree: Tree, node: int, curves: Curves, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """A node's position, its rotation with scale as a matrix, and its rotation.

    They have one frame where nothing about the node is animated.
    """
    item = tree.nodes[node]
    if "matrix" in item:
        if any((node, path) in curves for path in WIDTHS):
            raise ValueError(f"node {node} has a matrix and is animated, which excludes each other")
        matrix = _numbers(item["matrix"], 16, f"the matrix of node {node}").reshape(4, 4).T
        return matrix[None, :3, 3], matrix[None, :3, :3], Rotation.identity(1)
    values = {}
    for path, width in WIDTHS.items():
        curve = curves.get((node, path))
        if curve is None:
            given = item.get(path, DEFAULTS[path])
            values[path] = _numbers(given, width, f"the {path} of node {node}")[None]
        else:
            values[path] = curve.at(times)
    quats = values["rotation"]
    if (np.abs(quats).max(axis=-1) < 1e-3).any():
        raise ValueError(f"the rotation of node {node} is not a unit quaternion")
    turn = Rotation.from_quat(quats)
    return values["translation"], turn.as_matrix() * values["scale"][:, None, :], turn


def _numbers(value: object, count: int, what: str) -> Float64[np.ndarray, " count"]:
    values = list(value) if isinstance(value, Iterable) and not isinstance(value, str) else []
    is_good = len(values) == count and all(type(number) in (int, float) for number in values)
    if not is_good or not all(abs(number) < 1e30 for number in values):
        raise ValueError(f"{what} is {str(value)[:60]}; wanted {count} finite numbers")
    return np.array(values, np.float64)


def read_gltf(path: Path, animation: str | None = None, fps: float | None = None) -> Recording:
    """The skeleton and one animation of a glTF file, in metres with y up.

    It is sampled at the rate at which its keys lie, or else at 30 Hz with a remark.

    Args:
        path: .glb, or .gltf with its buffers inside or beside it.
        animation: its name; None takes the only one.
        fps: frames per second at which it is sampled; None takes the file's.

    Raises:
        ValueError: with the file's name, where it is not glTF, has no such animation or several of
            which none was chosen, or uses sparse or compressed arrays for it.
    """
    with error_context(path):
        if fps is not None and not SLOWEST <= fps <= FASTEST:
            raise ValueError(f"fps is {fps}; wanted {SLOWEST:g} to {FASTEST:g}")
        document = Document.read(path)
        tree = read_tree(document)
        name, chosen = _choose(_animations(document), animation)
        curves = _curves(document, chosen, tree)
        joints, left_out = find_joints(document, tree, {node for node, _ in curves})
        nodes = len(tree.with_ancestors(joints))
        most = max(MOST_NUMBERS, document.size) // nodes
        times, frame_time, remarks = frame_times(list(curves.values()), fps, most)
        number_of = {joint: number for number, joint in enumerate(joints)}
        parents = tuple(number_of.get(tree.parents[joint], -1) for joint in joints)
        motion = world_transforms(tree, joints, curves, times)
        model = _model(document, tree, joints)
        rest = world_transforms(tree, joints, {}, times[:1])
    positions_ls, rotations_ls = local_from_world(parents, *motion)
    offsets_ls, rest_rotations_ls = local_from_world(parents, *rest)
    return Recording(
        tree.names(joints), parents, offsets_ls[0], positions_ls, rotations_ls, frame_time,
        metres_per_unit=1.0, up_axis="y", rest_rotations_ls=rest_rotations_ls[0],
        remarks=(*remarks, *left_out), model=model,
    )  # fmt: skip


def _model(document: Document, tree: Tree, joints: list[int]) -> Model | None:
    """What hangs on the skeleton, if anything does."""
    if not any("mesh" in node and "skin" in node for node in tree.nodes):
        return None
    with suppress(ValueError):  # the motion is good, and it is what was asked for
        places = rest_places(tree)
        named = dict(zip(tree.names(joints), joints, strict=True))
        return keep(document, named, places, places[tree.parents[joints[0]]])
    return None


def _animations(document: Document) -> dict[str, Item]:
    """By name, the animations that move nodes."""
    animations: dict[str, Item] = {}
    for number, animation in enumerate(document.items("animations")):
        channels = as_list(animation.get("channels", []), f"channels of animation {number}")
        targets = [_target(as_item(channel, "a channel")) for channel in channels]
        if any(target.get("path") in PATHS for target in targets):
            name = animation.get("name")
            name = name if isinstance(name, str) and name else f"animation {number}"
            animations[name if name not in animations else f"{name} {number}"] = animation
    return animations


def _choose(animations: dict[str, Item], name: str | None) -> tuple[str, Item]:
    """The animation of this name, or the only one.

    Raises:
        ValueError: there is none, or there are several; the message lists them.
    """
    known = ", ".join(map(repr, animations))
    if not animations:
        raise ValueError("no animation that moves nodes; wanted a skeleton with its motion")
    if name is None and len(animations) > 1:
        raise ValueError(
            f"{len(animations)} animations: {known}; choose one with animation=... (--animation)"
        )
    name = next(iter(animations)) if name is None else name
    if name not in animations:
        raise ValueError(f"no animation {name!r}; there are {known}")
    return name, animations[name]


def _target(channel: Item) -> Item:
    return as_item(channel.get("target", {}), "the target of a channel")


def _curves(document: Document, animation: Item, tree: Tree) -> Curves:
    """The curves of an animation; those of morph targets and of extensions are left out."""
    samplers = as_list(animation.get("samplers", []), "the samplers of an animation")
    curves: Curves = {}
    keys = 0
    for channel in animation["channels"]:
        target = _target(channel)
        path, node = target.get("path"), target.get("node")
        if path in PATHS and node is not None:
            node = as_index(node, len(tree.nodes), "nodes of a channel")
            number = as_index(channel.get("sampler"), len(samplers), "samplers of a channel")
            sampler = as_item(samplers[number], f"sampler {number}")
            with error_context(f"{path} of {tree.names([node])[0]}, node {node}"):
                curves[node, path] = read_curve(document, sampler, path)
            keys += len(curves[node, path].times)
        if keys > max(MOST_NUMBERS, document.size):
            raise ValueError(f"more keys than a file of {document.size} bytes can have")
    if not curves:
        raise ValueError("its animation moves no node")
    return curves


def checked(kind: str, content: bytes, folder: Path) -> bytes:
    """The content without its characters, whose meshes hang on skeletons.

    Args:
        kind: of the file: others than `KINDS` are left as they are.
        content: of the file.
        folder: in which it is.

    Raises:
        RefusalError: a mesh or an array is compressed, sparse or without bytes, or a file with
            bytes is missing.
        ValueError: a header that is not JSON.
    """
    if kind not in KINDS:
        return content
    text, rest = content, b""
    if kind == BINARY:
        end = JSON_START + int.from_bytes(content[12:16], "little")
        text, rest = content[JSON_START:end], content[end:]
    header = json.loads(text.decode("utf-8"))
    if not isinstance(header, dict):
        return content
    for number, buffer in enumerate(header.get("buffers", [])):
        if not (uri := buffer.get("uri", DATA)).startswith(DATA):
            buffer_path(folder, number, uri)
    for number, mesh in enumerate(header.get("meshes", [])):
        for primitive in mesh["primitives"]:
            check_uncompressed(f"mesh {number}", primitive.get("extensions", {}))
    for number, view in enumerate(header.get("bufferViews", [])):
        check_uncompressed(f"bufferView {number}", view.get("extensions", {}))
    for number, accessor in enumerate(header.get("accessors", [])):
        check_accessor(number, accessor)
    characters = [node for node in header.get("nodes", []) if "skin" in node and "mesh" in node]
    if not characters:
        return content
    for node in characters:
        del node["mesh"]
    text = json.dumps(header).encode()
    if kind != BINARY:
        return text
    text += b" " * (-len(text) % 4)
    size = JSON_START + len(text) + len(rest)
    head = content[:8] + size.to_bytes(4, "little") + len(text).to_bytes(4, "little")
    return head + content[16:JSON_START] + text + rest
