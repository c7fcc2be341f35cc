"""Residuals that compile at once, for tests of commands that need no real fit."""

from collections.abc import Iterable

import equinox as eqx
import jax.numpy as jnp

TARGETS = {"pelvis.half_life": 0.3, "foot.max_pitch": 0.4}
SIGMA = 0.02  # of what stands in a reference


def residuals_of_scenes(ik, scenes):
    """Distance of two parameters from known values, in hundredths."""
    residuals = [ik.pelvis.half_life - 0.3, ik.foot.max_pitch - 0.4]
    return jnp.stack(residuals) / jnp.asarray(0.01, ik.leg.soften.dtype)


def residuals_of_references(ik, scenes):
    """Distance of the same two from the numbers that stand in the reference of each scene."""
    each = []
    for scene in scenes:
        measured, seen = scene.reference.pelvis.pos[0, :2], scene.reference.observed[0]
        residuals = (values_of(ik) - measured) / jnp.asarray(SIGMA, measured.dtype)
        each.append(jnp.where(seen, residuals, 0.0))
    return jnp.concatenate(each)


def values_of(ik):
    """The two parameters."""
    return jnp.stack([ik.pelvis.half_life, ik.foot.max_pitch])


def with_measured(problem, measured: Iterable):
    """The problem with a pair of numbers in the reference of each scene."""
    positions = [scene.reference.pelvis.pos for scene in problem.data]
    written = [
        pos.at[0, :2].set(jnp.asarray(pair)) for pos, pair in zip(positions, measured, strict=True)
    ]
    return eqx.tree_at(lambda p: [s.reference.pelvis.pos for s in p.data], problem, written)
