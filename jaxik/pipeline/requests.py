"""Rays that a traced program requests, and programs that go on with what somebody answers."""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var
from jaxtyping import Array, Float, PyTree, UInt

from jaxik.batching.primitives import aval_of, function_of
from jaxik.maths.struct import struct
from jaxik.world.terrain import GivenHits, Hit, LegTerrains, Terrain
from jaxik.world.terrain.hits import BODY, request_p


@struct
class Request:
    """Rays that somebody is to cast, world space."""

    origins_ws: Float[Array, "*b 3"]
    """Metres."""
    up_ws: Float[Array, "*b 3"]
    """Unit; each ray runs along its opposite."""
    length: Float[Array, "*b"]
    """Metres."""
    layers: UInt[Array, "*b"]
    """The layers that each ray can hit, one bit per layer."""


Answer: TypeAlias = Callable[[Request, int], Hit]
"""What rays hit, by the number of the leg on whose ground they fall, or `hits.BODY`."""


class OpenProgram:
    """A function, traced, that leaves it to others to cast the rays onto its `GivenHits`."""

    def __init__(self, function: Callable, *args: PyTree) -> None:
        """Traces the function of these arguments, or of their shapes."""
        self._traced, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        self._structure = jax.tree.structure(shapes)

    @property
    def ray_shapes(self) -> list[tuple[int, ...]]:
        """How many rays each of its requests has, in order, along each axis."""
        lengths = (request.invars[2] for request in _requests(self._traced))
        return [aval_of(length).shape for length in lengths]

    @property
    def ray_count(self) -> int:
        """How many rays it requests."""
        return sum(map(math.prod, self.ray_shapes))

    def checked(self, hits: Hit | None) -> Hit:
        """The hits, if they are of as many rays as it requests.

        Raises:
            ValueError: saying how many there are.
        """
        if hits is None or len(hits.found) != self.ray_count:
            held = "no hits" if hits is None else f"the hits of {len(hits.found)} rays"
            raise ValueError(
                f"terrain has {held}, and the system casts {self.ray_count} in a frame; "
                "jaxik.pipeline.step_and_rays tells which"
            )
        return hits

    def __call__(self, answer: Answer, *args: PyTree) -> Any:
        """What the function returns if its requests, one by one, are answered in this way."""
        results = _evaluate(self._traced, jax.tree.leaves(args), answer)
        return jax.tree.unflatten(self._structure, results)


def open_terrain(terrain: Terrain | LegTerrains) -> Terrain | LegTerrains:
    """Ground with the same directions and platforms, onto which somebody else casts."""
    platforms = terrain.platform_count
    body = GivenHits(terrain.up_ws, (), None, BODY, platforms)
    if isinstance(terrain, Terrain):
        return body
    legs = enumerate(terrain.legs)
    return LegTerrains(
        body, tuple(GivenHits(ground.up_ws, (), None, leg, platforms) for leg, ground in legs)
    )


def reading(hits: Hit) -> Answer:
    """Answers with hits of all rays (rays), in the order of the requests."""
    start = 0

    def answer(request: Request, number: int) -> Hit:
        nonlocal start
        shape = request.length.shape
        rows = slice(start, start + math.prod(shape))
        start = rows.stop
        return jax.tree.map(lambda leaf: leaf[rows].reshape((*shape, *leaf.shape[1:])), hits)

    return answer


def joined(casts: Sequence[tuple[Request, Hit]]) -> tuple[Request, Hit]:
    """The rays of several casts, and what they hit, one after another (rays)."""

    def join(*leaves: Array) -> Array:
        pairs = zip(leaves, casts, strict=True)
        flat = [leaf.reshape(-1, *leaf.shape[rays.length.ndim :]) for leaf, (rays, _) in pairs]
        return jnp.concatenate(flat)

    return jax.tree.map(join, *casts)


def casting(terrain: Terrain | LegTerrains) -> Answer:
    """Answers with what the rays hit of a terrain whose platforms are in place."""

    def answer(request: Request, number: int) -> Hit:
        ground = terrain.body if number == BODY else terrain.legs[number]  # type: ignore[union-attr]
        rays = request.origins_ws, request.length, request.layers
        return ground.first_hits(*rays, terrain.platform_count > 0)

    return answer


def _requests(traced: ClosedJaxpr | Jaxpr) -> list[JaxprEqn]:
    """The equations that request rays, in their order."""
    requests = []
    for equation in _jaxpr(traced).eqns:
        if equation.primitive is request_p:
            requests.append(equation)
        elif equation.primitive.name == "jit":
            requests += _requests(equation.params["jaxpr"])
    return requests


def _jaxpr(traced: ClosedJaxpr | Jaxpr) -> Jaxpr:
    return cast(Jaxpr, getattr(traced, "jaxpr", traced))


def _evaluate(traced: ClosedJaxpr | Jaxpr, values: list, answer: Answer) -> list:
    jaxpr = _jaxpr(traced)
    known = dict(zip(jaxpr.constvars, getattr(traced, "consts", ()), strict=True))
    known |= zip(jaxpr.invars, values, strict=True)

    def read(atom: Var | Literal) -> Any:
        return atom.val if isinstance(atom, Literal) else known[atom]

    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        if equation.primitive is request_p:
            hit = answer(Request(*map(jnp.asarray, operands)), equation.params["ground"])
            results = [hit.point, hit.normal, hit.found, hit.platform][: len(equation.outvars)]
        elif equation.primitive.name == "jit" and _requests(equation.params["jaxpr"]):
            results = _evaluate(equation.params["jaxpr"], operands, answer)
        else:
            results = function_of(equation)(*operands)
        typed = zip(equation.outvars, results, strict=True)
        known |= {var: jnp.asarray(result, aval_of(var).dtype) for var, result in typed}
    return [read(atom) for atom in jaxpr.outvars]
