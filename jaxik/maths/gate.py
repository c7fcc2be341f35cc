"""Gates: how a comparison becomes a decision, sharp as in a game or blurred for gradients.

What a threshold among the parameters decides goes through a gate; where two formulas meet without a
jump, a plain `where` chooses. `Hard` decides as a game does. `Smooth` blurs, for users who want
gradients through decisions. Both express a decision as a weight 0..1, so that `a * b` is "and" and
`1 - a` is "not" with either. Each call states its `band`: the width over which a blurred decision
changes, in the unit of what is compared.
"""

import functools
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import vec


class AbstractGate(eqx.Module):
    """Turns comparisons into weights 0..1, and weights into choices."""

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
        """`x` limited to `low`..`high`; the limits may be infinite."""

    @abstractmethod
    def minimum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        """The minimum over the last axis."""

    def maximum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        """The maximum over the last axis."""
        return -self.minimum(-x, band=band)


class Hard(AbstractGate):
    """Decides as a game does: the gradient through a decision is zero."""

    def below(self, x: Array, threshold: Array, *, band: float) -> Array:
        del band
        return (x <= threshold).astype(x.dtype)

    def choose(self, weight: Array, yes: Array, no: Array) -> Array:
        return jnp.where(weight > 0.5, yes, no)

    def clip(self, x: Array, low: Array, high: Array, *, band: float) -> Array:
        # Not jnp.minimum: it splits the gradient where the operands are equal.
        del band
        capped = jnp.where(x > high, high, x)
        return jnp.where(capped < low, low, capped)

    def minimum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        # Not jnp.min, whose gradient picks the branch by bitwise equality after fusion. Not
        # indexing by argmin, which is a loop over the batch in reverse mode. NaN propagates.
        del band
        return functools.reduce(
            lambda a, b: jnp.where((b < a) | jnp.isnan(b), b, a), vec.unstack(x)
        )


class Smooth(AbstractGate):
    """Blurs each decision over `softness` bands; approaches `Hard` as softness falls to zero."""

    softness: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def below(self, x: Array, threshold: Array, *, band: float) -> Array:
        # An infinite threshold decides outright; divided by the width, it would leave softness
        # without a gradient.
        gap = threshold - x
        infinite = ~jnp.isfinite(gap)
        weight = jax.nn.sigmoid(jnp.where(infinite, 0.0, gap) / (band * self.softness))
        return jnp.where(infinite, jnp.where(gap > 0, 1.0, 0.0), weight)

    def choose(self, weight: Array, yes: Array, no: Array) -> Array:
        return no + weight * (yes - no)

    def clip(self, x: Array, low: Array, high: Array, *, band: float) -> Array:
        # An infinite limit does not bind; left in the formula, it would give inf - inf.
        width = band * self.softness
        no_low, no_high = ~jnp.isfinite(low), ~jnp.isfinite(high)
        floor, ceiling = jnp.where(no_low, 0.0, low), jnp.where(no_high, 0.0, high)
        raised = jnp.where(no_low, x, floor + width * jax.nn.softplus((x - floor) / width))
        excess = jnp.where(no_high, 0.0, width * jax.nn.softplus((x - ceiling) / width))
        return raised - excess

    def minimum(self, x: Float[Array, "*b n"], *, band: float) -> Float[Array, "*b"]:
        # Measured from the smallest: with a narrow width `x / width` is so large that its rounding
        # matters, and a compiled softmax of it is NaN. The result does not depend on the shift.
        smallest = jax.lax.stop_gradient(jnp.min(x, axis=-1, keepdims=True))
        above = x - smallest
        weights = jax.nn.softmax(-above / (band * self.softness), axis=-1)
        return smallest[..., 0] + jnp.sum(above * weights, axis=-1)


HARD = Hard()
