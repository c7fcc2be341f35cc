"""Clips of different length as one array, so that one program computes all of them.

A clip is made longer by repeating its last frame, which then was not observed: nothing that a frame
shows depends on later ones, and what was not observed has no residuals. Lengths are rounded up to a
few, so that a thousand clips of a thousand lengths need a few programs.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from .scene import Scene

Tree = TypeVar("Tree", bound=PyTree)

GROWTH = 1.25  # of the lengths that clips are rounded up to: at most a fifth is padding
SHORTEST = 32  # frames


class Stack(NamedTuple):
    """Clips with the same shapes, one after another on the first axis of each array."""

    scenes: Scene
    """On the host, as NumPy arrays; a terrain that all share has no such axis."""
    members: tuple[int, ...]
    """Which clips they are."""
    shares_terrain: bool

    @property
    def stacked(self) -> tuple[bool, ...]:
        """For each array, whether it has an axis of clips."""
        flags = jax.tree.map(lambda leaf: True, self.scenes)
        if self.shares_terrain:
            terrain = jax.tree.map(lambda leaf: False, self.scenes.terrain)
            flags = _with_terrain(flags, terrain)
        return tuple(jax.tree.leaves(flags))

    def one(self, number: int) -> Scene:
        """A clip of the stack, without an axis of clips."""
        return chosen(self.scenes, self.stacked, number)

    def part(self, first: int, count: int) -> Scene:
        """So many clips from one of them on; the last clip is repeated where there are fewer."""
        numbers = np.minimum(np.arange(first, first + count), len(self.members) - 1)
        return chosen(self.scenes, self.stacked, numbers)


def chosen(tree: Tree, stacked: Sequence[bool], numbers: int | np.ndarray) -> Tree:
    """A tree whose stacked arrays have only these members, or a member and no axis of them."""
    leaves, structure = jax.tree.flatten(tree)
    pairs = zip(leaves, stacked, strict=True)
    return jax.tree.unflatten(structure, [x[numbers] if flag else x for x, flag in pairs])


def labelled(tree: PyTree, stacked: Sequence[bool], label: object) -> PyTree:
    """The tree with a label for each stacked array and None for others, as axes are given."""
    leaves = [label if flag else None for flag in stacked]
    return jax.tree.unflatten(jax.tree.structure(tree), leaves)


def frame_count(scene: Scene) -> int:
    """How many frames a clip has."""
    return scene.frames.dt.shape[0]


def rounded_up(frames: int) -> int:
    """The number of frames to which a clip is made longer."""
    steps = math.ceil(math.log(max(frames, SHORTEST) / SHORTEST, GROWTH) - 1e-9)
    return max(frames, math.ceil(SHORTEST * GROWTH**steps))


def padded(scene: Scene, frames: int) -> Scene:
    """A clip with its last frame repeated until it has so many; repetitions are not observed.

    Raises:
        ValueError: it has more frames than that.
    """
    missing = frames - frame_count(scene)
    if missing < 0:
        raise ValueError(f"the clip has {frame_count(scene)} frames; wanted at most {frames}")

    def lengthen(leaf: np.ndarray) -> np.ndarray:
        return np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)])

    parts = (scene.frames, scene.pelvis, scene.reference, scene.tracks)
    motion, pelvis, reference, tracks = jax.tree.map(lambda leaf: lengthen(np.asarray(leaf)), parts)
    observed = np.concatenate([np.asarray(scene.reference.observed), np.zeros(missing, bool)])
    reference = dataclasses.replace(reference, observed=observed)
    return dataclasses.replace(
        scene, frames=motion, pelvis=pelvis, reference=reference, tracks=tracks
    )


def stack(scenes: Sequence[Scene], *, rounded: bool = True) -> list[Stack]:
    """Clips in as few stacks as their shapes allow, each with clips in their order.

    Args:
        scenes: of any length, body and ground.
        rounded: whether lengths are rounded up to a few; else each stack is as long as its longest
            clip, whatever that is.
    """
    longest = max(map(frame_count, scenes))
    groups: dict[object, list[tuple[int, Scene]]] = {}
    for number, scene in enumerate(scenes):
        length = rounded_up(frame_count(scene)) if rounded else longest
        plain = _without_names(dataclasses.replace(padded(scene, length), place=None))
        groups.setdefault(_shapes(plain), []).append((number, plain))
    return [_stacked(members) for members in groups.values()]


def _stacked(members: Sequence[tuple[int, Scene]]) -> Stack:
    numbers, scenes = zip(*members, strict=True)
    shares_terrain = _are_equal(scene.terrain for scene in scenes)
    apart = [_with_terrain(scene, None) if shares_terrain else scene for scene in scenes]
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *apart)
    if shares_terrain:
        stacked = _with_terrain(stacked, jax.tree.map(np.asarray, scenes[0].terrain))
    return Stack(stacked, numbers, shares_terrain)


def _with_terrain(scene: Scene, terrain: PyTree) -> Scene:
    return eqx.tree_at(lambda s: s.terrain, scene, terrain, is_leaf=lambda leaf: leaf is None)


def _without_names(scene: Scene) -> Scene:
    """The clip without what only people read, which would keep it apart from others."""
    rig, reference = scene.rig, scene.reference
    legs = len(rig.names)
    names, joints = tuple(f"{i}" for i in range(legs)), ((0, 0, 0, 0),) * legs
    return dataclasses.replace(
        scene,
        rig=dataclasses.replace(rig, names=names, joints=joints, pelvis=0),
        reference=dataclasses.replace(reference, label=""),
    )


def _shapes(scene: Scene) -> object:
    """Equal for clips that one program computes."""
    leaves, structure = jax.tree.flatten(scene)
    return structure, tuple((np.shape(leaf), np.asarray(leaf).dtype.str) for leaf in leaves)


def _are_equal(trees: Iterable[PyTree]) -> bool:
    """Whether arrays of trees with the same shapes are the same."""
    first, *others = (jax.tree.leaves(tree) for tree in trees)
    return all(
        all(a is b or np.array_equal(a, b) for a, b in zip(first, other, strict=True))
        for other in others
    )
