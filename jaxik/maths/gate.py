"""Every decision of the pipeline is made by a gate.

`Hard` decides as a game does. `Smooth` blurs, for users who want slopes through decisions. Both
answer with a weight 0..1, so that `a * b` is "and" and `1 - a` is "not" for either. A call names
its `band`: the width over which a decision turns, in the unit of what is compared.
"""

import functools
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import vec


class AbstractGate(eqx.Module):
    """How a comparison becomes a weight, and a weight a choice."""

    @abstractmethod
    def below(self, x: Array, threshold: Array, *, band: float) -> Array:
        """1 where `x` is at or below `threshold`, else 0."""

    def above(self, x: Array, threshold: Array, *, band: float) -> Array:
        """1 where `x` is at or above `threshold`, else 0."""
        return self.below(-x, -threshold, band=band)

    @abstractmethod
    def choose(self, weight: Array, yes: Array, no: Array) -> Array:
        """`yes` where `weight` is 1, `no` where it is 0."""

    @abstractmethod
    def clip(self, x: Array, low: Array, high: Array, *, band: float) -> Array:
        """`x` kept between `low` and `high`."""

    @abstractmethod
    def minimum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        """The smallest along the last axis."""

    def maximum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        """The maximum along the last axis."""
        return -self.minimum(-x, band=band)


class Hard(AbstractGate):
    """Decides as a game does: the slope through a decision is zero."""

    def below(self, x: Array, threshold: Array, *, band: float) -> Array:
        del band
        return (x <= threshold).astype(x.dtype)

    def choose(self, weight: Array, yes: Array, no: Array) -> Array:
        return jnp.where(weight > 0.5, yes, no)

    def clip(self, x: Array, low: Array, high: Array, *, band: float) -> Array:
        # Not jnp.minimum: its slope is split where the operands are equal.
        del band
        capped = jnp.where(x > high, high, x)
        return jnp.where(capped < low, low, capped)

    def minimum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        # Not jnp.min: its slope picks the branch by bitwise equality after fusion. Nor what argmin
        # points at: in reverse mode that is a loop over the batch. NaN is passed on.
        del band
        return functools.reduce(
            lambda a, b: jnp.where((b < a) | jnp.isnan(b), b, a), vec.unstack(x)
        )


class Smooth(AbstractGate):
    """Blurs each decision over `softness` bands; tends to `Hard` as softness falls to zero."""

    softness: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def below(self, x: Array, threshold: Array, *, band: float) -> Array:
        # An endless threshold decides; divided by the width it would have no slope in softness.
        gap = threshold - x
        endless = jnp.isinf(gap)
        share = jax.nn.sigmoid(jnp.where(endless, 0.0, gap) / (band * self.softness))
        return jnp.where(endless, jnp.where(gap > 0, 1.0, 0.0), share)

    def choose(self, weight: Array, yes: Array, no: Array) -> Array:
        return no + weight * (yes - no)

    def clip(self, x: Array, low: Array, high: Array, *, band: float) -> Array:
        # An endless limit does not bind; counted with, it would make inf - inf.
        width = band * self.softness
        open_low, open_high = jnp.isinf(low), jnp.isinf(high)
        floor, roof = jnp.where(open_low, 0.0, low), jnp.where(open_high, 0.0, high)
        above = jnp.where(open_low, x, floor + width * jax.nn.softplus((x - floor) / width))
        over = jnp.where(open_high, 0.0, width * jax.nn.softplus((x - roof) / width))
        return above - over

    def minimum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        # Counted from the smallest: at a small width `x / width` is too large for its rounding not
        # to matter, and a compiled softmax of it is NaN. The answer does not depend on the shift.
        smallest = jax.lax.stop_gradient(jnp.min(x, axis=-1, keepdims=True))
        above = x - smallest
        share = jax.nn.softmax(-above / (band * self.softness), axis=-1)
        return smallest[..., 0] + jnp.sum(above * share, axis=-1)


HARD = Hard()
