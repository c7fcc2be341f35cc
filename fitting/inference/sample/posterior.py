"""The posterior of a fit, sampled with emcee through the hard program."""

import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.inference.sharding import over_devices
from fitting.problem.problem import Problem, digest
from fitting.problem.space import Space
from fitting.runtime import activity
from fitting.runtime.display import Displayable, data_frame
from fitting.runtime.precision import in_float64

from . import diagnostics
from .blocks import DEFAULTS, BlockLogLikelihood, SamplerSettings
from .chain import Chain, Identity
from .modes import Mode

if TYPE_CHECKING:
    import pandas


@dataclasses.dataclass(frozen=True)
class SamplingProgress:
    """How far a run is; reported every `check_every` steps."""

    step: int
    max_steps: int
    elapsed: float
    """s, of this call."""
    acceptance: float
    """Fraction of the proposals, mean over the walkers."""
    log_probability: float
    """Of the median walker now."""
    autocorrelation_time: float
    """Steps, of the slowest parameter at the last check; NaN before."""

    def __str__(self) -> str:
        slowest = self.autocorrelation_time
        ending = "" if math.isnan(slowest) else f"  slowest autocorrelation {slowest:.0f} steps"
        return (
            f"step {self.step} of at most {self.max_steps}  acceptance {self.acceptance:.2f}  "
            f"log p {self.log_probability:.1f}{ending}"
        )


@dataclasses.dataclass(frozen=True)
class WalkerStart:
    """The ball in which the walkers start, usually around a fit, and others for some of them.

    For a threshold `sd` must be small: its Laplace width is the prior's, and walkers that start
    that far away get stuck.
    """

    u: Float[Array | np.ndarray, " _"]
    """As many as there are free parameters."""
    sd: Float[Array | np.ndarray, " _"]
    """Of u."""
    elsewhere: Float[Array | np.ndarray, "places _"] | None = None
    """Other u around which a quarter of the walkers starts, so that modes there are found."""


@dataclasses.dataclass(frozen=True)
class Posterior(Displayable):
    """A sampled posterior. `steps` counts stored steps, each `thin_by` steps of the sampler."""

    names: tuple[str, ...]
    u: Float[np.ndarray, "steps walkers free"]
    log_probability: Float[np.ndarray, "steps walkers"]
    values: Float[np.ndarray, "steps walkers free"]
    """In the parameters' units."""
    thin_by: int
    burn_in: int
    """Stored steps to leave out."""
    autocorrelation_time: Float[np.ndarray, " free"]
    """Steps of the sampler."""
    acceptance: Float[np.ndarray, " walkers"]
    """Fraction of the stored steps' proposals."""
    isolated: list[int]
    """Walkers that never come near the others, in modes of negligible weight; left out of the
    summary."""
    stuck: list[int]
    """Isolated walkers, and walkers that hardly ever move."""
    converged: bool
    message: str
    """One sentence."""
    seconds: float
    """Of this call."""
    interrupted: bool = False
    isolated_mass: float = 0.0
    """Estimate of the fraction of the posterior where the isolated walkers are."""
    sigmas: Mapping[str, Float[np.ndarray, " draws"]] = dataclasses.field(default_factory=dict)
    """Draws of the sigmas that were left open, by kind of residual; m, rad, ..."""
    modes: tuple[Mode, ...] = ()
    """The heaviest first; none where there is only one."""
    minus_costs: Float[np.ndarray, "steps walkers"] | None = None
    """By which the fit compares points: as the log-probability, with the prior weighted, too."""
    start_minus_cost: float = math.inf
    """Of the point around which the walkers started."""
    blocks: BlockLogLikelihood | None = None
    """Of some draws; None until they are run through the clips (`studies.sample.replay`)."""
    source: Any = dataclasses.field(default=None, repr=False, compare=False)
    """The problem and the clips that it is of, whose motion notebooks show; None if unknown."""

    @property
    def draws(self) -> Float[np.ndarray, "steps walkers free"]:
        """Values after burn-in, without isolated walkers."""
        return np.delete(self.values[self.burn_in :], self.isolated, axis=1)

    @property
    def draws_u(self) -> Float[np.ndarray, "steps walkers free"]:
        """`u` of the same draws."""
        return np.delete(self.u[self.burn_in :], self.isolated, axis=1)

    @property
    def improvement(self) -> float:
        """How far the best draw is above the start, as the fit counts; negative if it is below."""
        return float(self._judged.max()) - self.start_minus_cost

    @property
    def _judged(self) -> Float[np.ndarray, "steps walkers"]:
        return self.log_probability if self.minus_costs is None else self.minus_costs

    @property
    def best_values(self) -> dict[str, float]:
        """The best draw of all, as the fit counts, by name, in the parameters' units."""
        best = np.unravel_index(np.argmax(self._judged), self._judged.shape)
        return dict(zip(self.names, self.values[best].tolist(), strict=True))

    def to_inference_data(self, space: Space) -> Any:
        """The draws after burn-in for ArviZ; see `inference_data.to_inference_data`."""
        from .inference_data import to_inference_data

        return to_inference_data(self, space)

    def table(self) -> "pandas.DataFrame":
        """The parameters by name, as pandas has tables: mean, sd, median, central intervals.

        Raises:
            ImportError: pandas is not installed.
        """
        return data_frame(self.summary, "name")

    @property
    def summary(self) -> list[diagnostics.ParameterSummary]:
        """One row per parameter, without burn-in and isolated walkers."""
        times = self.autocorrelation_time / self.thin_by
        return diagnostics.summarise(
            self.names, self.draws, np.maximum(times, 1.0), diagnostics.split_r_hat(self.draws_u)
        )


@in_float64
def sample_posterior(
    problem: Problem,
    start: WalkerStart,
    settings: SamplerSettings = DEFAULTS,
    *,
    seed: int = 0,
    path: Path | None = None,
) -> Posterior:
    """Samples until the chain is `stop_at` autocorrelation times long and these are steady.

    A run that was killed continues from its file when called again with the same arguments, and its
    chain is bit by bit the one that an uninterrupted run makes. A finished one is returned as it
    is; a larger `max_steps` or `stop_at` continues it. KeyboardInterrupt saves the chain and
    returns it, unless no step is done.

    Args:
        problem: with free parameters and data.
        start: where the walkers start.
        settings: how long to sample.
        seed: of the start and of every proposal.
        path: HDF5 file for the chain, in the layout of emcee; None leaves it in memory.

    Raises:
        ValueError: for shapes, numbers of walkers or widths that are impossible, a start where too
            few walkers have a finite log-probability, or a file that holds another run's chain.
    """
    began = time.monotonic()
    space = problem.space
    _check_start(space.size, start)
    walkers = settings.walkers_for(space.size)
    identity = Identity(space.names, walkers, seed, settings.thin_by, digest(problem))
    with Chain(identity, path) as chain:
        outcome = _extend(problem, chain, start, settings, began)
    with activity.announced("Summing up the chain"):
        at_start = _log_probability(problem, start, walkers)
        sampled = _posterior(problem, chain, outcome, time.monotonic() - began)
    return dataclasses.replace(
        sampled,
        minus_costs=minus_cost(problem, sampled.u, sampled.log_probability),
        start_minus_cost=float(minus_cost(problem, np.asarray(start.u), np.asarray(at_start))),
    )


def minus_cost(
    problem: Problem, u: Float[np.ndarray, "*rows free"], log_probability: np.ndarray
) -> Float[np.ndarray, "*rows"]:
    """Minus the cost of points, whose lowest one is the fit, from their log-probability."""
    of_prior = np.sum(problem.space.prior_costs(np.asarray(u)), axis=-1)
    return np.asarray(log_probability + (1.0 - float(problem.weight)) * of_prior)


@dataclasses.dataclass(frozen=True)
class _Outcome:
    """How sampling ended."""

    check: diagnostics.Check
    converged: bool
    message: str
    interrupted: bool


def _extend(
    problem: Problem, chain: Chain, start: WalkerStart, settings: SamplerSettings, began: float
) -> _Outcome:
    """Samples until the chain is long enough or Ctrl-C comes."""
    # Here, for emcee imports scipy.stats: half a second, for which a fit need not wait.
    from . import sampler

    names, thin_by = chain.identity.parameters, chain.identity.thin_by
    interval = math.ceil(settings.check_every / thin_by)
    limit = max(settings.max_steps // thin_by, len(chain))
    steps = sampler.steps(problem, chain, *_balls(start, chain.identity.walkers), limit)
    before = latest = None
    interrupted = False
    try:
        title = f"Sampling up to {limit * thin_by} steps of {chain.identity.walkers} walkers"
        with activity.announced(title, limit * thin_by, done=len(chain) * thin_by) as sampling:
            activity.note("preparing the program of a step")
            for length in diagnostics.check_lengths(len(chain), interval, limit):
                while len(chain) < length:
                    next(steps)
                    sampling.reach(len(chain) * thin_by)
                    if len(chain) % interval == 0:
                        elapsed = time.monotonic() - began
                        reached = _progress(chain, latest, settings.max_steps, elapsed)
                        activity.report(reached, str(reached))
                chain.save()
                before, latest = latest, _check(chain, length)
                done, _ = diagnostics.verdict(before, latest, names, thin_by, settings.stop_at)
                if done and length * thin_by >= settings.min_steps:
                    break
    except KeyboardInterrupt:
        if not len(chain):
            raise
        interrupted = True
        before, latest = latest, _check(chain, len(chain))
    assert latest is not None  # at least one length is checked
    converged, message = diagnostics.verdict(before, latest, names, thin_by, settings.stop_at)
    if interrupted:
        converged, message = False, f"Interrupted, the chain is saved. {message}"
    return _Outcome(latest, converged, message, interrupted)


def _check(chain: Chain, length: int) -> diagnostics.Check:
    return diagnostics.check(chain.u[:length], chain.log_probability[:length])


def _log_probability(problem: Problem, start: WalkerStart, walkers: int) -> float:
    """Of the start, by the program that the sampler has."""
    from .sampler import log_probabilities

    rows = jnp.broadcast_to(
        jnp.asarray(start.u, problem.space.start.dtype), (walkers // 2, problem.space.size)
    )
    return float(log_probabilities(over_devices(problem), rows)[0])


def _balls(
    start: WalkerStart, walkers: int
) -> tuple[Float[np.ndarray, "walkers free"], Float[np.ndarray, "walkers free"]]:
    """Centre and width of the ball in which each walker starts."""
    centres = np.tile(np.asarray(start.u, float), (walkers, 1))
    if start.elsewhere is not None and len(start.elsewhere):
        others = np.arange(walkers // 4)
        centres[-1 - 4 * others] = np.asarray(start.elsewhere)[others % len(start.elsewhere)]
    return centres, np.broadcast_to(np.asarray(start.sd, float), centres.shape)


def _check_start(size: int, start: WalkerStart) -> None:
    """Raises ValueError for a start that is not finite or has another size than the space."""
    for place in () if start.elsewhere is None else start.elsewhere:
        _check_start(size, WalkerStart(place, start.sd))
    for name, array in (("u", start.u), ("sd", start.sd)):
        if array.shape != (size,) or not np.isfinite(array).all():
            raise ValueError(
                f"start.{name} is {array}, wanted {size} finite numbers, one per free parameter"
            )
    if not (start.sd > 0).all():
        raise ValueError(f"start.sd is {start.sd}, wanted more than 0 everywhere")


def _progress(
    chain: Chain, check: diagnostics.Check | None, max_steps: int, elapsed: float
) -> SamplingProgress:
    last = chain.last
    assert last is not None  # called after a step
    thin_by = chain.identity.thin_by
    return SamplingProgress(
        step=len(chain) * thin_by,
        max_steps=max_steps,
        elapsed=elapsed,
        acceptance=float(chain.accepted.mean() / len(chain)),
        log_probability=float(np.median(last.log_probability)),
        autocorrelation_time=math.nan if check is None else check.slowest * thin_by,
    )


def _posterior(problem: Problem, chain: Chain, outcome: _Outcome, seconds: float) -> Posterior:
    u, check = chain.u, outcome.check
    acceptance = chain.accepted / len(chain)
    stuck = check.isolated | diagnostics.lazy_walkers(acceptance)
    return Posterior(
        names=problem.space.names,
        u=u,
        log_probability=chain.log_probability,
        values=problem.space.values(u),
        thin_by=chain.identity.thin_by,
        burn_in=check.burn_in,
        autocorrelation_time=check.times * chain.identity.thin_by,
        acceptance=acceptance,
        isolated=np.flatnonzero(check.isolated).tolist(),
        isolated_mass=check.isolated_mass,
        stuck=np.flatnonzero(stuck).tolist(),
        converged=outcome.converged,
        message=outcome.message,
        seconds=seconds,
        interrupted=outcome.interrupted,
        modes=check.modes,
    )
