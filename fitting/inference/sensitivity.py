"""Which parameters change a motion at all: a sweep over every range, before anything is fitted."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxik
from fitting.problem.free_parameters import PRIOR_SD, free_parameter
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene
from fitting.problem.space import Space, make_space
from fitting.runtime.program_cache import cached
from jaxik.maths import parameter_tree

from .optimisation.population import BATCH, from_values

SHARES = (np.arange(6) + 0.5) / 6  # of a range, where each parameter is tried
DRAWS = 2  # places besides the present values: there a threshold may hide what another place shows
SEEN = 0.1  # of a sigma: what moves no row that far does not change the motion
WIDE = 4.0  # times its usual range, for what is infinite now: "no limit" must stay within reach

Named = Mapping[str, Mapping[str, Any]]  # free parameters with what overrides their declarations


def declared(ik: jaxik.FootIK) -> dict[str, dict[str, Any]]:
    """Every declared parameter of a system as free, a leaf of several values by its elements."""
    named: dict[str, dict[str, Any]] = {}
    for name, one in parameter_tree.declarations(ik).items():
        value = np.asarray(parameter_tree.get(ik, name))
        wide = {"high": WIDE * one.high} if np.isinf(value).any() else {}
        elements = [f"{name}[{i}]" for i in range(len(value))] if value.ndim else [name]
        named |= dict.fromkeys(elements, wide)
    return named


def moving(
    ik: jaxik.FootIK, named: Named, scenes: tuple[Scene, ...], seed: int = 0
) -> dict[str, float]:
    """How far each parameter moves these motions at most, in sigmas; without those that move none.

    Each parameter in turn is carried over its range, the others staying where they are: at the
    system's values, then at draws from the prior.

    Args:
        ik: the system.
        named: the parameters.
        scenes: the clips; what their references are does not matter, their sigmas do.
        seed: of the draws.
    """
    space = make_space(ik, [free_parameter(ik, name, **options) for name, options in named.items()])
    random = np.random.default_rng(seed)
    draws = PRIOR_SD * random.normal(size=(DRAWS, space.size))
    places = [np.asarray(space.pack({})), *draws]
    reach = np.max([_reach(space, scenes, place) for place in places], axis=0)
    return {name: float(far) for name, far in zip(named, reach, strict=True) if far > SEEN}


def _reach(space: Space, scenes: tuple[Scene, ...], place: np.ndarray) -> np.ndarray:
    """How far each parameter moves any row from where it is at a place, (free,), in sigmas."""
    dtype = space.u0.dtype
    here = np.asarray(space.values(jnp.asarray(place, dtype)))
    odds = np.log(SHARES / (1 - SHARES))
    grid = np.stack([space.values(jnp.full(space.size, one, dtype)) for one in odds])
    table = np.tile(here, (space.size, len(SHARES), 1))
    for i in range(space.size):
        table[i, :, i] = grid[:, i]
    every = np.concatenate([here[None], table.reshape(-1, space.size)])
    candidates = from_values(space, every)
    first = _rows(space, scenes, candidates[:1])[0]
    moved = [
        np.abs(_rows(space, scenes, candidates[i : i + BATCH]) - first)
        for i in range(1, len(candidates), BATCH)
    ]
    furthest = np.concatenate([np.nan_to_num(one).max(axis=1) for one in moved])
    return furthest.reshape(space.size, len(SHARES)).max(axis=1)


def _rows(space: Space, scenes: tuple[Scene, ...], some: np.ndarray) -> np.ndarray:
    """Rows of at most a population; filled up, so that there is one program."""
    filled = jnp.asarray(np.resize(some, (BATCH, space.size)), space.u0.dtype)
    return np.asarray(_rows_of_all(space, scenes, filled))[: len(some)]


@cached
def _rows_of_all(space: Space, scenes: tuple[Scene, ...], candidates: Array) -> Array:
    return jax.vmap(lambda u: residuals_of_scenes(space.unpack(u), scenes))(candidates)
