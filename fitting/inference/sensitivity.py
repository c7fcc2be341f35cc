"""Which parameters change a motion at all: a sweep over every range, before anything is fitted."""

from collections.abc import Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.problem.free_parameters import free_parameter
from fitting.problem.prior import SPREAD
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene
from fitting.problem.space import Space, make_space
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from jaxik.maths import parameter_tree
from jaxik.world.body import scaled_declarations

from .optimisation.population import BATCH

FRACTIONS = (np.arange(6) + 0.5) / 6  # of a range, where each parameter is tried
DRAWS = 2  # random systems besides the given one: there a parameter may matter that here does not
NEGLIGIBLE = 0.1  # sigmas; what moves no residual further does not change the motion
UNLIMITED = 4.0  # times its usual range, for an infinite limit: "no limit" must stay in reach

FreeTable = Mapping[str, Mapping[str, float | int | str]]  # names, and overrides of declarations


def all_parameters(ik: jaxik.FootIK, rig: jaxik.Rig | None = None) -> dict[str, dict[str, float]]:
    """Every declared parameter of a system as free, leg by leg where it has a value for each.

    Args:
        ik: the system.
        rig: whose body the ranges are for; None is the adult.
    """
    table: dict[str, dict[str, float]] = {}
    for name, declaration in scaled_declarations(ik, rig).items():
        value = np.asarray(parameter_tree.get(ik, name))
        overrides = {"high": UNLIMITED * declaration.high} if np.isinf(value).any() else {}
        elements = [f"{name}[{i}]" for i in range(len(value))] if value.ndim else [name]
        table |= dict.fromkeys(elements, overrides)
    return table


@in_float64
def measure_sensitivity(
    ik: jaxik.FootIK, free: FreeTable, scenes: tuple[Scene, ...], seed: int = 0
) -> dict[str, float]:
    """How far each parameter can move these motions, in sigmas; without those that move none.

    Ranges are those for the body of the first clip.

    Each parameter in turn is swept over its range while the others stay where they are: at the
    system's values, then at draws from a normal prior in the middle of the ranges.

    Args:
        ik: the system.
        free: the parameters.
        scenes: the clips; of these the sigmas count, the references do not.
        seed: of the draws.
    """
    rig = scenes[0].rig
    space = make_space(ik, [free_parameter(ik, name, rig, **given) for name, given in free.items()])
    reach = np.max([_reach(space, scenes, u) for u in sweep_points(space, seed)], axis=0)
    return {name: float(r) for name, r in zip(free, reach, strict=True) if r > NEGLIGIBLE}


def sweep_points(space: Space, seed: int = 0) -> list[Float[np.ndarray, " free"]]:
    """Where the other parameters stay during sweeps, u: as the system has them, and a few draws."""
    random = np.random.default_rng(seed)
    return [np.asarray(space.pack({})), *(SPREAD * random.normal(size=(DRAWS, space.size)))]


def _reach(
    space: Space, scenes: tuple[Scene, ...], u: Float[np.ndarray, " free"]
) -> Float[np.ndarray, " free"]:
    """How far each parameter alone can move any residual from where it is at `u`, in sigmas."""
    return np.array([np.abs(changes).max() for _, changes in sweep(space, scenes, u)])


def sweep(
    space: Space,
    scenes: tuple[Scene, ...],
    u: Float[np.ndarray, " free"],
) -> Iterator[tuple[Float[np.ndarray, " tried"], Float[np.ndarray, "tried residuals"]]]:
    """For each parameter alone, its `u` over the range and how the residuals change from `u`.

    Args:
        space: the parameters.
        scenes: the clips.
        u: where all the others stay.
    """
    present = np.asarray(space.values(u))
    log_odds = np.log(FRACTIONS / (1 - FRACTIONS))
    grid = np.asarray(space.values(np.tile(log_odds[:, None], space.size)))
    first = residuals_at(space, scenes, space.pack_values(present[None]))[0]
    together = BATCH // len(FRACTIONS)  # parameters in one call of the program
    for start in range(0, space.size, together):
        indices = range(start, min(start + together, space.size))
        table = np.tile(present, (len(indices), len(FRACTIONS), 1))
        for row, i in enumerate(indices):
            table[row, :, i] = grid[:, i]
        candidates = space.pack_values(table.reshape(-1, space.size))
        changes = np.nan_to_num(residuals_at(space, scenes, candidates) - first)
        for row, i in enumerate(indices):
            tried = slice(row * len(FRACTIONS), (row + 1) * len(FRACTIONS))
            yield candidates[tried, i], changes[tried]


def residuals_at(
    space: Space, scenes: tuple[Scene, ...], candidates: Float[np.ndarray, "points free"]
) -> Float[np.ndarray, "points residuals"]:
    """Residuals of at most a batch of candidates, filled up so that there is one program."""
    filled = jnp.asarray(np.resize(candidates, (BATCH, space.size)), space.start.dtype)
    return np.asarray(_residuals_of_batch(space, scenes, filled))[: len(candidates)]


@cached
def _residuals_of_batch(space: Space, scenes: tuple[Scene, ...], candidates: Array) -> Array:
    return jax.vmap(lambda u: residuals_of_scenes(space.unpack(u), scenes))(candidates)
