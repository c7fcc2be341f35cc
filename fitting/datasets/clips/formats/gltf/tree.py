"""The nodes of a glTF scene: their tree, which of them are joints, and their transforms."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from .document import Document, Item, as_index, as_list
from .sampling import WIDTHS, Curve

Curves = dict[tuple[int, str], Curve]
"""By node and path."""

DEFAULTS = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0,) * 3}
FLAT = 1e-6  # of a length; axes that are less apart have no direction of their own


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
        raise ValueError(f"the rotation of node {node} is no unit quaternion")
    turn = Rotation.from_quat(quats)
    return values["translation"], turn.as_matrix() * values["scale"][:, None, :], turn


def _numbers(value: object, count: int, what: str) -> Float64[np.ndarray, " count"]:
    values = list(value) if isinstance(value, Iterable) and not isinstance(value, str) else []
    is_good = len(values) == count and all(type(number) in (int, float) for number in values)
    if not is_good or not all(abs(number) < 1e30 for number in values):
        raise ValueError(f"{what} is {str(value)[:60]}; wanted {count} finite numbers")
    return np.array(values, np.float64)
