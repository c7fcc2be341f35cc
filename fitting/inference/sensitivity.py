"""Which parameters change a motion at all, and which to free before a fit.

Each parameter is swept over its range while the others stay at the system's values, and again at a
few draws from a wide prior, for at one point a rule may happen to be idle. The mean slope of every
residual over such a sweep, which also crosses thresholds and limits, replaces its derivative, and a
normal approximation then shows how far the clips would narrow down the parameters together. The one
they narrow down least is fixed, and so on, until they narrow down all. It is a forecast: the fit
shows what the clips do determine.

On flat ground a capture only shows that foot IK must not move the feet. Where a system moves
them, the parameter whose change helps most is changed, then the next one, up to `MOST` of them,
which are for a fit to refine.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxik
from fitting.problem.problem import rho
from fitting.problem.residuals import residuals_of_scenes
from fitting.problem.scene import Scene, left_alone
from fitting.problem.space import SPREAD, Space, free_parameter, make_space
from fitting.runtime.precision import in_float64
from fitting.runtime.program_cache import cached
from jaxik.maths import parameter_tree
from jaxik.world.body import scaled_declarations

from .identifiability import UNDETERMINED
from .optimise.evolution import BATCH

FRACTIONS = (np.arange(6) + 0.5) / 6  # of a range, where each parameter is tried
DRAWS = 2  # random systems besides the user's: there a parameter may matter that here does not
NEGLIGIBLE = 0.1  # sigmas; what moves no residual further does not change the motion
UNLIMITED = 4.0  # times its usual range, for an infinite limit: "no limit" must stay in reach

FreeTable = Mapping[str, Mapping[str, float | int | str]]  # names, and overrides of declarations

INDEPENDENT_EVERY = 0.5  # s between residuals of captured motion that count as independent

MOST = 4  # parameters that are changed
AS_GOOD = 0.02  # of the possible gain in cost: among changes this similar, the smallest is chosen


def all_parameters(ik: jaxik.FootIK, rig: jaxik.Rig | None = None) -> dict[str, dict[str, float]]:
    """Every declared parameter of a system as free, leg by leg where it has a value for each.

    Ranges are those for the body of the rig; None is the adult.
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
    ik: jaxik.FootIK, free: FreeTable, scenes: tuple[Scene, ...]
) -> dict[str, float]:
    """How far each parameter can move these motions, in sigmas; without those that move none.

    Each in turn is swept over its range, which is that for the body of the first clip, while the
    others stay: at the system's values, then at draws from a normal prior in the middle of the
    ranges. Of the scenes the sigmas count, the references do not.
    """
    space = _space_of(ik, free, scenes)
    swept = ([np.abs(c).max() for _, c in sweep(space, scenes, u)] for u in sweep_points(space))
    reach = np.max(list(swept), axis=0)
    return {name: float(r) for name, r in zip(free, reach, strict=True) if r > NEGLIGIBLE}


def _space_of(ik: jaxik.FootIK, free: FreeTable, scenes: tuple[Scene, ...]) -> Space:
    """The space of parameters with ranges for the body of the first clip."""
    rig = scenes[0].rig
    return make_space(ik, [free_parameter(ik, name, rig, **own) for name, own in free.items()])


def sweep_points(space: Space) -> list[Float[np.ndarray, " free"]]:
    """Where the other parameters stay during sweeps, u: as the system has them, and a few draws."""
    random = np.random.default_rng(0)
    return [np.asarray(space.pack({})), *(SPREAD * random.normal(size=(DRAWS, space.size)))]


def sweep(
    space: Space,
    scenes: tuple[Scene, ...],
    u: Float[np.ndarray, " free"],
) -> Iterator[tuple[Float[np.ndarray, " tried"], Float[np.ndarray, "tried residuals"]]]:
    """For each parameter alone, its `u` over the range and how the residuals change.

    The others stay at `u`, relative to which the residuals change.
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


@dataclasses.dataclass(frozen=True)
class Forecast:
    """How well the clips are expected to determine a parameter."""

    name: str
    is_free: bool
    """Whether they should determine it, together with the others that are free."""
    reach: float
    """Sigmas by which it can move a residual."""
    contraction: float
    """Of its variance, alone: 0 where the clips say nothing, 1 where they decide."""
    rival: str = ""
    """The free parameter with which they confuse it; empty where they say little."""

    @property
    def moves(self) -> bool:
        """Whether it changes the motion at all."""
        return self.reach > NEGLIGIBLE


@in_float64
def choose_free(
    ik: jaxik.FootIK, candidates: FreeTable, scenes: tuple[Scene, ...]
) -> list[Forecast]:
    """A forecast for each candidate, in the order of the table.

    Ranges are those for the body of the first clip. Of the scenes the sigmas count, the references
    do not.
    """
    space, names = _space_of(ik, candidates, scenes), list(candidates)
    seconds = float(np.mean([np.asarray(scene.frames.dt).mean() for scene in scenes]))
    information, reach = np.zeros((space.size, space.size)), np.zeros(space.size)
    points = sweep_points(space)
    for u in points:
        swept = zip(u, sweep(space, scenes, u), strict=True)
        each = [
            (_slope(tried - here, changes), np.abs(changes).max())
            for here, (tried, changes) in swept
        ]
        slopes = np.stack([slope for slope, _ in each])
        information += min(1.0, seconds / INDEPENDENT_EVERY) * slopes @ slopes.T / len(points)
        reach = np.maximum(reach, [size for _, size in each])
    free, rivals = _narrowed_down(information)
    alone = 1.0 - 1.0 / (1.0 + SPREAD**2 * np.diag(information))
    return [
        Forecast(
            name,
            is_free=i in free,
            reach=float(reach[i]),
            contraction=float(alone[i]),
            rival=names[rivals[i]] if i in rivals and alone[i] >= UNDETERMINED else "",
        )
        for i, name in enumerate(names)
    ]


def _slope(
    steps: Float[np.ndarray, " tried"], changes: Float[np.ndarray, "tried residuals"]
) -> Float[np.ndarray, " residuals"]:
    """Of the line through the origin that is nearest to the changes."""
    return steps @ changes / (steps @ steps)


def _narrowed_down(
    information: Float[np.ndarray, "all all"],
) -> tuple[list[int], dict[int, int]]:
    """Parameters of which enough is known together; of each other, the one most like it then."""
    free, rivals = list(range(len(information))), {}
    while free:
        precision = information[np.ix_(free, free)] + np.eye(len(free)) / SPREAD**2
        covariance = np.linalg.inv(precision)
        variances = np.diag(covariance)
        worst = int(np.argmax(variances))
        if 1.0 - variances[worst] / SPREAD**2 >= UNDETERMINED:
            break
        likeness = np.abs(covariance[worst]) / np.sqrt(variances)
        likeness[worst] = 0.0
        rivals[free[worst]] = free[int(np.argmax(likeness))]
        del free[worst]
    return free, rivals


@in_float64
def leave_alone(
    ik: jaxik.FootIK,
    candidates: FreeTable,
    scenes: tuple[Scene, ...],
    is_harmless: Callable[[jaxik.FootIK], bool],
) -> list[str]:
    """Names of the parameters to change so that the animations stay; no more than are needed.

    The search ends where `is_harmless` says that a system leaves the animations as they are.
    """
    space = _space_of(ik, candidates, scenes)
    scenes = tuple(left_alone(scene) for scene in scenes)
    u, changed = np.asarray(space.pack({})), list[str]()
    while len(changed) < MOST and not is_harmless(space.unpack(u)):
        here = residuals_at(space, scenes, u[None])[0]
        present, costs, places = _cost(here), [], []
        for i, (tried, moved) in enumerate(sweep(space, scenes, u)):
            costs += [_cost(here + row) for row in moved]
            places += [(i, place) for place in tried]
        best = min(costs)
        if not best < present:
            break
        good = np.flatnonzero(np.asarray(costs) <= best + AS_GOOD * (present - best))
        i, place = min((places[k] for k in good), key=lambda at: abs(at[1] - u[at[0]]))
        u = np.where(np.arange(space.size) == i, place, u)
        changed.append(space.names[i])
    return changed


def _cost(residuals: Float[np.ndarray, " residuals"]) -> float:
    """As a fit counts it, without the prior."""
    return 0.5 * float(np.sum(rho(residuals**2, "huber")))
