"""Trees as the structs of C in memory: four bytes for each number, in the order of the leaves."""

import math

import jax
import numpy as np
from jaxtyping import Float64, PyTree, UInt32

TYPES = {"f": np.float32, "i": np.int32, "u": np.uint32, "b": np.int32}  # by those of NumPy


def words(tree: PyTree) -> bytes:
    """One struct, in little-endian order."""
    alone = jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)
    return rows(alone).astype("<u4").tobytes()


def rows(tree: PyTree) -> UInt32[np.ndarray, "structs words"]:
    """Structs, of a tree whose leaves have one more axis in front."""
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(tree))
    parts = [
        leaf.astype(TYPES[leaf.dtype.kind])
        .view(np.uint32)
        .reshape(len(leaf), math.prod(leaf.shape[1:]))
        for leaf in leaves
    ]
    return np.concatenate(parts, axis=1)


def doubles(tree: PyTree) -> Float64[np.ndarray, "structs numbers"]:
    """As `rows`, but each number as a float of 64 bits."""
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(tree))
    parts = [leaf.reshape(len(leaf), math.prod(leaf.shape[1:])) for leaf in leaves]
    return np.concatenate(parts, axis=1, dtype=np.float64)


def tree_of(rows: UInt32[np.ndarray, "structs words"], like: PyTree) -> PyTree:
    """The tree of structs, with one more axis in front than a single one that is like them."""
    leaves, structure = jax.tree.flatten(like)
    parts, start = [], 0
    for leaf in leaves:
        size = math.prod(leaf.shape)
        part = np.ascontiguousarray(rows[:, start : start + size])
        start += size
        typed = part.view(TYPES[np.dtype(leaf.dtype).kind]).astype(leaf.dtype)
        parts.append(typed.reshape(len(rows), *leaf.shape))
    return jax.tree.unflatten(structure, parts)
