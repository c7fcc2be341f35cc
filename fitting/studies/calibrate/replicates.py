"""Replicates of an experiment: truths, motion made from them, and what fits say of it.

identity.json           what is calibrated; another experiment is refused
fits/0000.json          the fit of a replicate
chains/0000.json        its posterior, where chains were wanted
wrong_model/0000.json   the fit of a replicate whose motion another system makes

Everything follows from the experiment and the number of the replicate. A call continues where an
earlier one ended, also with more replicates, or with chains for fits that have none yet. All
replicates of a process share their compiled programs.
"""

import dataclasses
import functools
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, NotRequired, TypedDict, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.inference.noise import NoiseModel, noise_of, with_noise
from fitting.inference.optimise import descent
from fitting.inference.optimise.solution import (
    Search,
    SearchSettings,
    SearchState,
    StepsUsedUp,
)
from fitting.inference.profiles.profile import Profile, level_of
from fitting.inference.proportions import Proportion, RankTest
from fitting.inference.sample.posterior import Posterior
from fitting.problem.problem import Problem, digest
from fitting.problem.simulation import simulate
from fitting.problem.space import FreeParameter, to_fractions
from fitting.runtime.declarations import count
from fitting.runtime.json_files import Finite, JsonFile, Store, length
from fitting.runtime.validation import Content
from fitting.studies.campaign import Campaign
from fitting.studies.fit.assess import assess_solution, search_with_noise
from fitting.studies.fit.fit import Fit, FittedParameter, Interval, SearchRecord
from fitting.studies.sample.sample import sample_around, with_open_noise

if TYPE_CHECKING:
    from distributed import Client

DRAWS = 99  # of each posterior, among which the truth has a rank from 0 to 99
LEVELS = (0.5, 0.8, 0.95)  # of a posterior's central intervals
LOG_PROBABILITY = "log-probability"  # ranked beside the parameters
IDENTITY = "identity.json"
WRITER, ADVICE = "written by `jaxik calibrate`", "delete it to make it anew, or name another folder"
PER_PARAMETER = ("truth_u", "truth", "truth_levels", "parameters")
Result = TypeVar("Result", bound=Mapping[str, Any])
SAME_MINIMUM = 3.0  # of cost, above the lowest that a descent from the truth reaches


class Identity(TypedDict):
    """What is calibrated: everything that a replicate follows from, except the program itself."""

    name: str
    problem: str
    """Digest."""
    start: list[float]
    seed: int
    noise_factor: float
    noise: Content
    fit: Content
    sample: Content
    truth: NotRequired[Content]
    """Of another system, where one makes the motion; see `wrong_model.identity_of`."""


IDENTITY_FILE = JsonFile(Identity, WRITER, "name another folder")


class Kind(NamedTuple):
    """What is made of each replicate: a fit, or a chain."""

    folder: str
    word: str
    """Its plural, for the reader."""
    file: JsonFile[Any]
    line: Callable[[Any], str]
    """Describes one, for the reader."""


def claim(
    folder: Path | None,
    replicates: int,
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    noise_factor: float,
    truth: Content | None = None,
) -> None:
    """Writes into a folder what is calibrated there, or compares it with what it says already.

    Raises:
        ValueError: there is not one replicate; the noise is not positive; the folder is that of
            another calibration, or of something else.
    """
    if replicates < 1:
        raise ValueError(f"replicates is {replicates}; wanted 1 or more")
    if not 0 < noise_factor < math.inf:
        raise ValueError(f"noise_factor is {noise_factor:g}; wanted a positive number")
    if folder is None:
        return
    if not (folder / IDENTITY).exists() and any(folder.glob("*/[0-9]*.json")):
        raise ValueError(f"{folder}: has replicates but no {IDENTITY}; name another folder")
    identity = {
        "name": experiment.name,
        "problem": digest(problem),
        "start": np.asarray(problem.space.start).tolist(),
        "seed": experiment.seed,
        "noise_factor": noise_factor,
        **{key: dataclasses.asdict(getattr(experiment, key)) for key in ("noise", "fit", "sample")},
        **({} if truth is None else {"truth": truth}),
    }
    own: Identity = json.loads(json.dumps(identity))
    other = "holds the calibration of {name!r}, which differs from this one in: {changed}"
    key = {**own, "truth": truth}
    del key["name"]
    Store(IDENTITY_FILE, folder, other).remember(IDENTITY, lambda: own, key)


def make_replicates(
    kind: Kind,
    folder: Path | None,
    parameters: Sequence[str],
    make: Callable[[Any], Result],
    sources: Sequence[Any],
    client: "Client | None" = None,
) -> list[Result]:
    """All replicates, of which those are made that a folder does not hold yet.

    Args:
        kind: of what is made.
        folder: of the replicates, if they are stored.
        parameters: names of those that are fitted.
        make: makes one from its source.
        sources: of each replicate, its number or its fit.
        client: of the Dask cluster that computes. None computes in this process.
    """
    check = functools.partial(_check, parameters)
    other = f"not {WRITER}: it is of replicate {{number}}"
    store: Store[Any] = Store(kind.file, folder, other, check)

    def path(source: Any) -> str:
        return f"{kind.folder}/{_number(source):04}.json"

    return Campaign(
        f"Making the {kind.word} of {len(sources)} replicates",
        sources,
        make,
        read=lambda source: store.read(path(source), {"number": _number(source)}),
        write=lambda source, result: store.write(path(source), result),
        line=kind.line,
        name=lambda source: f"replicate {_number(source) + 1}",
    ).run(client)


def _number(source: int | Mapping[str, Any]) -> int:
    return source if isinstance(source, int) else source["number"]


def _check(parameters: Sequence[str], result: Mapping[str, Any]) -> None:
    """Raises ValueError for a result of other parameters, or one that contradicts itself."""
    if "ranks" in result:
        ranked = list(set(result["ranks"]) ^ {LOG_PROBABILITY})
        parts = {"ranks": ranked, "intervals": list(result["intervals"])}
    else:
        parts = {"parameters": [row["name"] for row in result["parameters"]]}
    for key, names in parts.items():
        if sorted(names) != sorted(parameters):
            raise ValueError(f"{key} has {names}; wanted {parameters}")
    sizes = {key: len(result[key]) for key in PER_PARAMETER if key in result}
    if len(set(sizes.values())) > 1:
        raise ValueError(f"its lists have different lengths, {sizes}")


@dataclasses.dataclass(frozen=True)
class Judgement(ABC):
    """Statistics of replicates, some of which are checked."""

    replicates: int

    @property
    @abstractmethod
    def checks(self) -> Mapping[str, Proportion | RankTest]:
        """What is checked, by the words for it where it is outside its bounds."""

    @property
    def outside(self) -> list[str]:
        """The checks that failed, in words."""
        return [words for words, share in self.checks.items() if not share.inside]

    @property
    def inside(self) -> bool:
        """Whether all checks passed."""
        return not self.outside

    @property
    def summary(self) -> dict[str, Any]:
        """The numbers as `calibration.json` holds them."""
        fields = {key: _plain(value) for key, value in vars(self).items()}
        return {"inside": self.inside, "outside": self.outside, **fields}


def _plain(value: Any) -> Any:
    if isinstance(value, Proportion):
        return {**dataclasses.asdict(value), "inside": value.inside}
    if isinstance(value, RankTest):
        return {"ranks": value.ranks.tolist(), "draws": value.draws, "inside": value.inside}
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return value


def numbers(where: Sequence[bool] | np.ndarray) -> tuple[int, ...]:
    """Replicates for which something holds, counted from 1."""
    return tuple(int(i) + 1 for i in np.flatnonzero(where))


class Truth(NamedTuple):
    """What a replicate is made from."""

    u: Float[np.ndarray, " free"]
    noise_seed: int
    seed: int
    """Of the search and the sampler."""


class Replicate(SearchRecord):
    """The fit of a replicate of any kind, as its file holds it."""

    number: int
    """From 0."""
    parameters: list[FittedParameter]


class ReplicateFit(Replicate):
    """The fit to motion that the experiment's own system makes."""

    truth_u: list[Finite]
    truth: list[Finite]
    """In the parameters' units."""
    truth_levels: list[Finite]
    """Of the smallest intervals of the profiles that contain the truth, 0..1."""
    truth_valley_cost: float
    """The cost where a descent from the truth ends."""


class ReplicateChain(TypedDict):
    """The posterior of a replicate, as its file holds it."""

    number: int
    ranks: dict[str, Annotated[int, count(0, DRAWS)]]
    """Number of independent draws, of `DRAWS`, below the truth: of each parameter, and of the
    log-probability."""
    intervals: dict[str, Annotated[list[Interval], length(len(LEVELS))]]
    """Of each parameter, in its unit: the central intervals with the `LEVELS`."""
    draws: int
    """Independent ones in the chain."""
    converged: bool
    message: str
    seconds: float


def draw_truth(problem: Problem[jaxik.FootIK], experiment: Experiment, number: int) -> Truth:
    """The truth of a replicate, from the prior of the problem."""
    random = np.random.default_rng([experiment.seed, number])
    u = problem.space.prior.draw(random, 1)[0]
    noise_seed, seed = random.integers(2**32, size=2)
    return Truth(u, int(noise_seed), int(seed))


def fit_replicate(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    number: int,
    noise_factor: float = 1.0,
) -> ReplicateFit:
    """Fits a replicate, counted from 0, as `jaxik fit` does, and descends from its truth.

    Raises:
        KeyboardInterrupt, ValueError: as `fit_simulated`.
    """
    truth = draw_truth(problem, experiment, number)
    simulated = _simulated(problem, truth, noise_factor)
    fitted = fit_simulated(simulated, dataclasses.replace(experiment, seed=truth.seed))
    values = np.asarray(problem.space.values(truth.u))
    profiles = fitted.identifiability.profiles
    levels = [
        level_at(profiles[parameter.name], parameter, value)
        for parameter, value in zip(problem.space.parameters, values, strict=True)
    ]
    settings = experiment.fit.search
    return {
        "number": number,
        **fitted.search,
        "parameters": fitted.parameters,
        "truth_u": truth.u.tolist(),
        "truth": values.tolist(),
        "truth_levels": levels,
        "truth_valley_cost": _polished_cost(fitted.problem.with_weight(1.0), settings, truth.u),
    }


def fit_simulated(
    simulated: Problem[jaxik.FootIK],
    experiment: Experiment,
) -> Fit:
    """Fits a problem of simulated motion as `jaxik fit` does.

    Raises:
        KeyboardInterrupt: the search was interrupted; half a fit counts for nothing.
        ValueError: the fit cannot be assessed.
    """
    simulated, solution = search_with_noise(simulated, experiment)
    if solution.interrupted:
        raise KeyboardInterrupt
    fitted = assess_solution(experiment, simulated, solution)
    if fitted.solution.interrupted:
        raise KeyboardInterrupt
    return fitted


def fit_line(fitted: ReplicateFit) -> str:
    """A finished fit in one line, for the terminal."""
    gap = fitted["cost"] - fitted["truth_valley_cost"]
    end = "the truth's minimum" if gap <= SAME_MINIMUM else f"a minimum {gap:.1f} above the truth's"
    return (
        f"replicate {fitted['number'] + 1}: {end}, {fitted['agreeing']} of {fitted['starts']} "
        f"starts agree{'' if fitted['converged'] else ', not converged'}; {fitted['seconds']:.1f} s"
    )


def chain_line(chain: ReplicateChain) -> str:
    """A finished chain in one line, for the terminal."""
    return (
        f"replicate {chain['number'] + 1}: chain with {chain['draws']} independent draws"
        f"{'' if chain['converged'] else ', not converged'}; {chain['seconds']:.0f} s"
    )


def sample_replicate(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    fitted: ReplicateFit,
    noise_factor: float = 1.0,
) -> ReplicateChain:
    """Samples the posterior of a replicate as `jaxik sample` does, around its fit.

    Raises:
        KeyboardInterrupt: the sampling was interrupted; half a chain counts for nothing.
        ValueError: walkers cannot start around the fit.
    """
    number = fitted["number"]
    truth = draw_truth(problem, experiment, number)
    simulated = _simulated(problem, truth, noise_factor)
    own = dataclasses.replace(experiment, seed=truth.seed)
    if "noise" in fitted:
        simulated = with_noise(simulated, NoiseModel(**fitted["noise"]))
    posterior = sample_around(fitted["parameters"], simulated, own)
    if posterior.interrupted:
        raise KeyboardInterrupt
    draws = independent_draws(posterior)
    random = np.random.default_rng([experiment.seed, number, DRAWS])
    log_probability = with_open_noise(simulated, own).log_probability(jnp.asarray(truth.u))
    ranks = rank(np.append(fitted["truth"], log_probability), draws, random)
    quantities = [*posterior.names, LOG_PROBABILITY]
    ends = 0.5 + np.multiply.outer(LEVELS, [-0.5, 0.5])
    intervals = np.quantile(posterior.draws.reshape(-1, len(posterior.names)), ends, axis=0)
    return {
        "number": number,
        "ranks": dict(zip(quantities, ranks.tolist(), strict=True)),
        "intervals": dict(zip(posterior.names, intervals.transpose(2, 0, 1).tolist(), strict=True)),
        "draws": len(draws),
        "converged": posterior.converged,
        "message": posterior.message,
        "seconds": posterior.seconds,
    }


def _simulated(
    problem: Problem[jaxik.FootIK], truth: Truth, noise_factor: float
) -> Problem[jaxik.FootIK]:
    """The problem with motion made at a truth; it assumes the same noise as before."""
    assumed = noise_of(problem)
    sigmas = {kind: noise_factor * sigma for kind, sigma in assumed.sigmas.items()}
    noisy = with_noise(problem, dataclasses.replace(assumed, sigmas=sigmas))
    return with_noise(simulate(noisy, truth.u, truth.noise_seed), assumed)


def level_at(profile: Profile, parameter: FreeParameter, value: float) -> float:
    """Level, 0..1, of the smallest interval of a profile that contains a value."""
    places = to_fractions(parameter, profile.values)
    place = to_fractions(parameter, np.asarray(value))
    rise = float(np.interp(place, places, np.sqrt(np.maximum(profile.rises, 0.0))) ** 2)
    return level_of(parameter, profile.values, profile.rises, rise)


def independent_draws(posterior: Posterior) -> Float[np.ndarray, "draws quantities"]:
    """Values and log-probability of all walkers, at steps an autocorrelation time apart or more."""
    log_probability = np.delete(
        posterior.log_probability[posterior.burn_in :], posterior.isolated, axis=1
    )
    both = np.concatenate([posterior.draws, log_probability[..., None]], axis=-1)
    slowest = float(posterior.autocorrelation_time.max()) / posterior.thin_by
    step = int(np.ceil(min(slowest, len(both))))  # infinite if nothing moves
    return both[::-step].reshape(-1, both.shape[-1])


def rank(
    truth: Float[np.ndarray, " quantities"],
    draws: Float[np.ndarray, "draws quantities"],
    random: np.random.Generator,
) -> Int[np.ndarray, " quantities"]:
    """Rank of a truth, quantity by quantity, among `DRAWS` of the draws.

    Where there are fewer, their ranks are spread at random over the places that each stands for:
    uniform ranks stay uniform.
    """
    chosen = random.permutation(draws)[:DRAWS]
    below = np.sum(chosen < truth, axis=0)
    if len(chosen) == DRAWS:
        return below
    places = (below + random.random(truth.size)) / (len(chosen) + 1)
    return np.floor((DRAWS + 1) * places).astype(int)


def _polished_cost(
    problem: Problem[jaxik.FootIK], settings: SearchSettings, u: Float[np.ndarray, " free"]
) -> float:
    """The lowest cost of a descent that begins at the truth."""
    try:
        return descent.polish(Search(problem, settings), SearchState.at(u)).best.cost
    except StepsUsedUp as error:
        return error.state.best.cost
