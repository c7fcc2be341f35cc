"""Ground of which only hits are known: something else, such as a game engine, casts the rays."""

import dataclasses
from collections.abc import Sequence
from typing import NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, ArrayLike, Float, UInt

from jaxik.maths import vec
from jaxik.maths.struct import struct
from jaxik.world import arguments
from jaxik.world.skeleton import Transform
from jaxik.world.surfaces import STATIC, plane_distance

from .rays import HORIZON, Hit, LegTerrains, Terrain

BODY = -1  # number of the ground under the body, where legs have their own


@struct
class GivenHits(Terrain):
    """Ground of which only the hits of the rays of one `step` are known.

    `jaxik.step` reads them in the order of its casts; `jaxik.pipeline.requests` tells which rays
    those are, and casts them on another terrain. Derivatives take the ground around a hit as the
    plane that its normal says.
    """

    hits: Hit | None = None
    """Of all rays of the step (rays), world space: of a miss only `found`, 0, counts, and
    `distance` never does. `platform` where there are platforms. None for legs other than the
    body's, whose hits are with those of the body."""
    number: int = eqx.field(default=BODY, static=True)
    """Of the leg whose ground this is, or `BODY`."""
    platforms: int = eqx.field(default=0, static=True)
    """How many platforms there are."""
    offset_ws: Float[Array, "3"] | None = None
    """m, by which the coordinates of the rays are moved; None for nothing."""

    @property
    def platform_count(self) -> int:
        return self.platforms

    def at(self, platforms: Transform) -> "GivenHits":
        return self

    def moved(self, by_ws: Float[Array, "3"]) -> "GivenHits":
        offset_ws = by_ws if self.offset_ws is None else self.offset_ws + by_ws
        return dataclasses.replace(self, offset_ws=offset_ws)

    def first_hits(
        self,
        origins_ws: Float[Array, "*b 3"],
        reach: Float[Array, "*#b"],
        mask: UInt[Array, "*#b"],
        moves: bool,
    ) -> Hit:
        shape = origins_ws.shape[:-1]
        length = jnp.broadcast_to(jnp.minimum(reach, HORIZON), shape)
        up = jnp.broadcast_to(self.up_ws, origins_ws.shape)
        starts = origins_ws if self.offset_ws is None else origins_ws - self.offset_ws
        layers = jnp.broadcast_to(mask, shape)
        point, normal, found, *platform = request_p.bind(
            starts, up, length, layers, ground=self.number, moves=moves
        )
        if self.offset_ws is not None:
            point += self.offset_ws
        hit = found > 0
        normal = jnp.where(hit[..., None], normal, up)
        point = jnp.where(hit[..., None], point, origins_ws)
        distance = jnp.where(hit, _drop(origins_ws, up, point, normal), length)
        on_platform = jnp.where(hit, platform[0], STATIC) if moves else None
        on_ray = origins_ws - vec.scale(up, distance)
        return Hit(on_ray, normal, distance, hit.astype(length.dtype), on_platform)


def from_hits(
    hits: Hit | None,
    up: ArrayLike | tuple[float, ...] = (0.0, 1.0, 0.0),
    leg_ups: Sequence[ArrayLike | tuple[float, ...]] | None = None,
    platforms: int = 0,
) -> GivenHits | LegTerrains:
    """The ground of one `jaxik.step` of which these hits are known.

    Args:
        hits: of all rays of the step (rays), m, world space, in the order of its casts; None for
            ground whose hits are still unknown.
        up: of the body, and of the legs unless they have their own; need not be a unit vector.
        leg_ups: up of each leg, where they differ.
        platforms: how many platforms there are; with some, hits have a `platform`.

    Raises:
        ValueError: a direction of length zero, or platforms without numbers in the hits.
    """
    if platforms and hits is not None and hits.platform is None:
        raise ValueError(f"hits.platform is None; wanted a number for each hit, {STATIC} for none")
    dtype = arguments.float_dtype(up) if hits is None else hits.point.dtype
    body = GivenHits(arguments.direction(up, "up", dtype), (), hits, BODY, platforms)
    if leg_ups is None:
        return body
    ups = [arguments.direction(leg_up, "leg_ups", dtype) for leg_up in leg_ups]
    grounds = (GivenHits(leg_up, (), None, leg, platforms) for leg, leg_up in enumerate(ups))
    return LegTerrains(body, tuple(grounds))


@jax.custom_jvp
def _drop(origins_ws: Array, up_ws: Array, point_ws: Array, normal: Array) -> Array:
    """Distance along -up to a point."""
    return vec.dot(origins_ws - point_ws, up_ws)


@_drop.defjvp
def _drop_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return _drop(*primals), jax.jvp(plane_distance, primals, tangents)[1]


# Rays as a program asks for them: whoever runs the program has to answer in place of it.
request_p = Primitive("request_rays")
request_p.multiple_results = True


def _refuse(*_: object, **__: object) -> NoReturn:
    raise ValueError(
        "only jaxik.step reads hits that are given, one frame at a time; cast, run and loops of "
        "rays need a terrain"
    )


@request_p.def_abstract_eval
def _(
    origins: ShapedArray, up: ShapedArray, length: ShapedArray, layers: ShapedArray, **params: int
) -> list[ShapedArray]:
    platform = [ShapedArray(length.shape, jnp.dtype(jnp.int32))] if params["moves"] else []
    return [origins, up, length, *platform]


def _batched(values: Sequence[Array], axes: Sequence[int | None], **params: int) -> tuple:
    size = next(x.shape[axis] for x, axis in zip(values, axes, strict=True) if axis is not None)
    rows = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(values, axes, strict=True)
    ]
    results = request_p.bind(*rows, **params)
    return results, [0] * len(results)


request_p.def_impl(_refuse)
mlir.register_lowering(request_p, _refuse)
batching.primitive_batchers[request_p] = _batched
