"""Reader of glTF 2.0 and GLB files: skinned characters and plain nodes with an animation.

All nodes above the skeleton, with their rotations, scales and motion, are part of it: positions
are those of the scene, in metres with y up, as the format has it. Meshes, materials and morph
targets are not read.
"""

from pathlib import Path

from fitting.datasets.clips.kinematics import local_from_world
from fitting.datasets.clips.recording import FASTEST, SLOWEST, Recording
from fitting.runtime.validation import error_context

from .document import Document, Item, as_index, as_item, as_list
from .sampling import WIDTHS, frame_times, read_curve
from .tree import Curves, Tree, find_joints, read_tree, world_transforms

SUFFIXES = (".glb", ".gltf")
PATHS = tuple(WIDTHS)
MOST_NUMBERS = 1_000_000  # frames times nodes, and keys, of small files; of others their bytes


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
        document = Document(path)
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
        rest = world_transforms(tree, joints, {}, times[:1])
    positions_ls, rotations_ls = local_from_world(parents, *motion)
    offsets_ls, rest_rotations_ls = local_from_world(parents, *rest)
    return Recording(
        tree.names(joints), parents, offsets_ls[0], positions_ls, rotations_ls, frame_time,
        metres_per_unit=1.0, up_axis="y", rest_rotations_ls=rest_rotations_ls[0],
        remarks=(*remarks, *left_out),
    )  # fmt: skip


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
