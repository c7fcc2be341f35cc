"""Converts and checks what callers hand to the constructors of `terrain`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from jaxik.maths import vec

from .heightfield import INTERPOLATIONS, HeightOf

LAYERS = 32
FURTHEST = 1e7  # m, of a vertex from the origin
NARROWEST = 1e-6  # m, between the heights of a heightfield


def float_dtype(*values: ArrayLike | tuple[float, ...]) -> jnp.dtype:
    """The float dtype of the arrays among `values`; JAX's default if there are none."""
    arrays = [array for array in values if isinstance(array, jax.Array | np.ndarray)]
    return jnp.result_type(float, *arrays)


def direction(value: ArrayLike | tuple[float, ...], name: str, dtype) -> Float[Array, "3"]:
    """`value` as a unit vector."""
    vector = jnp.asarray(value, dtype)
    if not isinstance(vector, Tracer):
        if vector.shape != (3,) or not 0 < np.sum(np.square(vector)) < np.inf:
            raise ValueError(f"{name} is a direction: three numbers, not all zero; got {value}")
    return _unit(vector)


@jax.jit  # outside jit, one program instead of six
def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    return vec.scale(vector, 1.0 / vec.length(vector))


def layer_bits(layer: int | ArrayLike) -> np.ndarray:
    """The bit of each layer."""
    numbers = np.asarray(layer)
    if not np.issubdtype(numbers.dtype, np.integer) or ((numbers < 0) | (numbers >= LAYERS)).any():
        raise ValueError(f"layers are integers from 0 to {LAYERS - 1}; got {layer}")
    return np.asarray(np.uint32(1) << numbers.astype(np.uint32))


def check_mesh(vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Rejects arrays that are not a mesh."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices must have the shape (vertices, 3); got {vertices.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
        raise ValueError(f"triangles must have the shape (1 or more, 3); got {triangles.shape}")
    if not np.issubdtype(triangles.dtype, np.integer):
        raise ValueError(f"triangles must be integer indices of vertices; got {triangles.dtype}")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(
            f"triangles must index vertices 0 to {len(vertices) - 1}; got {triangles.min()} to "
            f"{triangles.max()}"
        )
    wrong = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(wrong):
        raise ValueError(
            f"{len(wrong)} of {len(vertices)} vertices are not finite; the first is vertex "
            f"{wrong[0]}: {vertices[wrong[0]].tolist()}"
        )
    far = np.flatnonzero((np.abs(vertices) > FURTHEST).any(axis=1))
    if len(far):
        raise ValueError(
            f"{len(far)} of {len(vertices)} vertices are too far away; the first is vertex "
            f"{far[0]}: {vertices[far[0]].tolist()}; wanted at most {FURTHEST:g} m"
        )


def check_heightfield(
    heights: ArrayLike,
    spacing: ArrayLike | tuple[float, ...],
    origin: ArrayLike | tuple[float, ...],
    interpolation: str,
) -> None:
    """Rejects what is not a heightfield; of traced arrays, only the shapes are checked."""
    shape = np.shape(heights)
    if len(shape) != 2 or min(shape) < 2:
        raise ValueError(
            f"heights must have the shape (2 or more rows, 2 or more columns); got {shape}"
        )
    if np.shape(spacing) not in ((), (2,)):
        raise ValueError(
            "spacing is one length for both axes, or two: between columns and between rows; "
            f"got the shape {np.shape(spacing)}"
        )
    if np.shape(origin) != (3,):
        raise ValueError(f"origin must have the shape (3,); got {np.shape(origin)}")
    if interpolation not in INTERPOLATIONS:
        known = " or ".join(map(repr, INTERPOLATIONS))
        raise ValueError(f"interpolation is {known}; got {interpolation!r}")
    if not isinstance(spacing, Tracer):
        _check_spacing(np.asarray(spacing, np.float64), shape)
    if not isinstance(origin, Tracer) and not (np.abs(np.asarray(origin)) <= FURTHEST).all():
        place = np.asarray(origin).tolist()
        raise ValueError(f"origin is three numbers of at most {FURTHEST:g} m; got {place}")
    if not isinstance(heights, Tracer):
        _check_heights(np.asarray(heights))


def height_function(height: HeightOf, dtype) -> HeightOf:
    """`height` as a tree; ValueError unless it takes two scalars and returns a real one."""
    is_tree = not jax.tree_util.treedef_is_leaf(jax.tree.structure(height))
    for leaf in jax.tree.leaves(height) if is_tree else ():
        if not eqx.is_array_like(leaf):
            raise ValueError(f"all leaves of height must be arrays; one is a {type(leaf).__name__}")
    # A Python number would be static in `equinox.filter_jit`, and every new one a new program.
    tree = jax.tree.map(jnp.asarray, height) if is_tree else Partial(height)
    scalar = jax.ShapeDtypeStruct((), dtype)
    result = jax.eval_shape(lambda x, z: jnp.asarray(tree(x, z)), scalar, scalar)
    if result.shape != () or jnp.issubdtype(result.dtype, jnp.complexfloating):
        raise ValueError(
            "height must return one real number for the x and z of one point; got the shape "
            f"{result.shape} and dtype {result.dtype}"
        )
    return tree


def _check_spacing(spacing: np.ndarray, shape: tuple[int, ...]) -> None:
    if not (spacing > 0).all():
        raise ValueError(f"spacing is in metres, above 0; got {spacing.tolist()}")
    widest = FURTHEST / np.array([shape[1] - 1, shape[0] - 1])
    if not ((spacing >= NARROWEST) & (spacing <= widest)).all():
        rows, columns = shape
        raise ValueError(
            f"spacing is {spacing.tolist()} m for {rows} rows and {columns} columns; wanted "
            f"{NARROWEST:g} m or more, and at most {FURTHEST:g} m from end to end"
        )


def _check_heights(heights: np.ndarray) -> None:
    wrong = np.argwhere(np.isinf(heights))
    if len(wrong):
        row, column = wrong[0]
        raise ValueError(
            f"{len(wrong)} of {heights.size} heights are infinite; the first is "
            f"heights[{row}, {column}]; a hole is NaN"
        )
    high = np.argwhere(np.abs(heights) > FURTHEST)
    if len(high):
        row, column = high[0]
        raise ValueError(
            f"{len(high)} of {heights.size} heights are too far from 0; the first is "
            f"heights[{row}, {column}]: {heights[row, column]:g}; wanted at most {FURTHEST:g} m"
        )
    known = ~np.isnan(heights)
    if not (known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]).any():
        raise ValueError("every cell has a NaN at one of its corners: there is no ground at all")
