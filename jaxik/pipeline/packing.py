"""Trees of many small arrays as a few vectors, one for each type of number.

Handing an array to a compiled program, or taking one from it, costs about a microsecond. A frame
of one character is over a hundred arrays, and handing them over takes longer than computing it.
"""

import functools
import math
from collections.abc import Hashable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxik.maths.struct import struct

LARGE = 1024  # numbers; a larger array stays as it is, since packing it would copy it in each call


class Layout:
    """Where each array of a tree lies in the vectors; see `layout_of`."""

    def __init__(self, structure: Hashable, arrays: tuple) -> None:
        self.structure: Any = structure
        self.shapes = [shape for shape, _ in arrays]
        groups: dict[object, list[int]] = {}
        for number, (shape, dtype) in enumerate(arrays):
            large = math.prod(shape) > LARGE
            groups.setdefault(number if large else dtype, []).append(number)
        self.groups = [(arrays[numbers[0]][1], numbers) for numbers in groups.values()]
        """Type and numbers of the arrays in each vector; a large array is alone."""
        self.slices = [slice(0)] * len(arrays)
        """Of each array, in its vector."""
        for _, numbers in self.groups:
            begin = 0
            for number in numbers:
                end = begin + math.prod(self.shapes[number])
                self.slices[number], begin = slice(begin, end), end

    def fits(self, arrays: Sequence[np.ndarray], structure: Hashable) -> bool:
        """Whether this is the layout of a tree of these arrays, whatever their types."""
        return structure == self.structure and [x.shape for x in arrays] == self.shapes

    def pack(self, arrays: Sequence) -> "Packed":
        """The arrays of a tree, of NumPy or of a trace, as vectors.

        NumPy's are converted to the layout's types, as far as these are of the same kind.
        """
        return Packed(tuple(_joined(arrays, *group) for group in self.groups), self)


def _joined(arrays: Sequence, dtype: np.dtype, numbers: list[int]) -> Array | np.ndarray:
    if arrays[numbers[0]].size > LARGE:
        return arrays[numbers[0]]
    parts = [arrays[number].ravel() for number in numbers]
    if isinstance(parts[0], jax.Array):
        return jnp.concatenate(parts)
    # NumPy takes less time than JAX for small arrays.
    return np.concatenate(parts, dtype=dtype, casting="same_kind")


# The same object for the same layout: it is hashed in each call of a program that takes it.
_layout = functools.lru_cache(maxsize=None)(Layout)


@struct
class Packed:
    """A tree as vectors."""

    vectors: tuple
    layout: Layout = eqx.field(static=True)

    def unpack(self) -> PyTree:
        """The tree. Where the vectors are NumPy's, its arrays are views of them."""
        shapes, slices = self.layout.shapes, self.layout.slices
        arrays: list = [None] * len(shapes)
        for vector, (_, numbers) in zip(self.vectors, self.layout.groups, strict=True):
            for number in numbers:
                arrays[number] = vector[slices[number]].reshape(shapes[number])
        return jax.tree.unflatten(self.layout.structure, arrays)


def layout_of(tree: PyTree, floats: np.dtype | None = None) -> Layout:
    """The layout of a tree of arrays: one object for all trees with the same layout.

    Args:
        tree: of arrays.
        floats: type to which all floats are converted; None leaves them as they are.
    """
    leaves, structure = jax.tree.flatten(tree)
    types = [(aval.shape, aval.dtype) for aval in map(jax.typeof, leaves)]
    if floats is not None:
        types = [(s, floats if jnp.issubdtype(t, jnp.floating) else t) for s, t in types]
    return _layout(structure, tuple(types))


def pack(tree: PyTree) -> Packed:
    """A tree of arrays, of NumPy, of JAX or of a trace, as vectors."""
    return layout_of(tree).pack(jax.tree.leaves(tree))
