"""The posterior of a fit, sampled with emcee through the hard program."""

import dataclasses
import hashlib
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.problem.problem import Problem

from . import diagnostics
from .chain import Chain, Identity


@dataclasses.dataclass(frozen=True)
class SamplingProgress:
    """How far a run is; handed out every `check_every` steps."""

    step: int
    max_steps: int
    elapsed: float  # s, of this call
    acceptance: float  # mean over the walkers
    log_probability: float  # median of the walkers now
    autocorrelation_time: float  # steps, of the slowest parameter at the last check; NaN before


@dataclasses.dataclass(frozen=True)
class Posterior:
    """A sampled posterior. `steps` counts stored steps, each `thin_by` steps of the sampler."""

    names: tuple[str, ...]
    u: Float[np.ndarray, "steps walkers free"]
    log_probability: Float[np.ndarray, "steps walkers"]
    values: Float[np.ndarray, "steps walkers free"]  # in the parameters' units
    thin_by: int
    burn_in: int  # stored steps to leave out
    autocorrelation_time: Float[np.ndarray, " free"]  # steps of the sampler
    acceptance: Float[np.ndarray, " walkers"]  # share of the stored steps' proposals
    apart: list[int]  # walkers on an island of negligible weight; left out of the summary
    stuck: list[int]  # those, and walkers that hardly ever move
    converged: bool
    message: str
    seconds: float  # of this call
    interrupted: bool = False

    @property
    def kept(self) -> Float[np.ndarray, "steps walkers free"]:
        """Values after burn-in of the walkers that count."""
        return np.delete(self.values[self.burn_in :], self.apart, axis=1)

    @property
    def summary(self) -> list[dict[str, Any]]:
        """Row per parameter: name, mean, sd, median, 68 and 95 % intervals, ess, r_hat."""
        u = np.delete(self.u[self.burn_in :], self.apart, axis=1)
        times = self.autocorrelation_time / self.thin_by
        return diagnostics.summarise(
            self.names, self.kept, np.maximum(times, 1.0), diagnostics.split_r_hat(u)
        )


def sample_posterior(
    problem: Problem,
    start_u: Float[Array | np.ndarray, " _"],
    start_sd: Float[Array | np.ndarray, " _"],
    *,
    path: Path | None = None,
    max_steps: int = 20_000,
    min_steps: int = 0,
    walkers: int | None = None,
    seed: int = 0,
    thin_by: int = 1,
    check_every: int = 100,
    stop_at: float = 50.0,
    progress: Callable[[SamplingProgress], None] | None = None,
) -> Posterior:
    """Samples until the chain is `stop_at` autocorrelation times long and these are steady.

    A run that was killed goes on from its file when called again with the same arguments, and its
    chain is the one that an unbroken run would have made, bit by bit. A finished one is returned as
    it is; a larger `max_steps` or `stop_at` continues it. KeyboardInterrupt keeps the chain and
    returns it, unless no step is done.

    Args:
        problem: what is free and what it is held against.
        start_u: where the walkers start, usually the fit.
        start_sd: how far around it, in `u`: for a threshold a small number, since the Laplace
            width of one is the prior's and walkers that start there stick.
        path: HDF5 file for the chain, in the layout of emcee; None keeps it in memory only.
        max_steps: of the sampler, over all runs; at least `thin_by`.
        min_steps: do not stop before.
        walkers: an even number, at least two per free parameter; None takes four.
        seed: of the start and of every proposal.
        thin_by: store every so many steps.
        check_every: steps between reports, and the least between two checks of convergence.
        stop_at: autocorrelation times.
        progress: called every `check_every` steps.

    Raises:
        ValueError: for shapes, counts or widths that cannot be, a start where too few walkers find
            a finite log-probability, or a file that holds another run's chain.
    """
    # Here, for emcee imports scipy.stats: half a second, for which a fit need not wait.
    from . import sampler

    began = time.monotonic()
    size = problem.space.size
    start_u, start_sd = np.asarray(start_u, float), np.asarray(start_sd, float)
    walkers = max(4 * size, 4) if walkers is None else walkers
    _check_start(size, start_u, start_sd)
    check_walkers(size, walkers)
    _check_counts(max_steps, thin_by, check_every)
    identity = Identity(problem.space.names, walkers, seed, thin_by, digest(problem))
    names = problem.space.names

    def check(length: int) -> diagnostics.Check:
        return diagnostics.check(chain.u[:length], chain.log_probability[:length])

    before = latest = None
    interrupted = False
    with Chain(identity, path) as chain:
        every = math.ceil(check_every / thin_by)
        limit = max(max_steps // thin_by, len(chain))
        steps = sampler.steps(problem, chain, start_u, start_sd, limit)
        try:
            for length in diagnostics.check_lengths(len(chain), every, limit):
                while len(chain) < length:
                    next(steps)
                    if progress is not None and len(chain) % every == 0:
                        slowest = math.nan if latest is None else latest.slowest * thin_by
                        progress(_report(chain, max_steps, time.monotonic() - began, slowest))
                chain.save()
                before, latest = latest, check(length)
                done, _ = diagnostics.verdict(before, latest, names, thin_by, stop_at)
                if done and length * thin_by >= min_steps:
                    break
        except KeyboardInterrupt:
            if not len(chain):
                raise
            interrupted = True
            before, latest = latest, check(len(chain))
    assert latest is not None  # at least one length is checked
    converged, message = diagnostics.verdict(before, latest, names, thin_by, stop_at)
    if interrupted:
        converged, message = False, f"Interrupted, the chain is kept. {message}"
    made = _conclude(problem, chain, latest, converged, message, time.monotonic() - began)
    return dataclasses.replace(made, interrupted=interrupted)


def digest(problem: Problem) -> str:
    """64 characters that change with any number or name on which the log-probability depends."""
    hashed = hashlib.sha256()
    residuals = problem.residual_function
    kind = (residuals.__module__, residuals.__qualname__, problem.loss, problem.space.parameters)
    hashed.update(repr(kind).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(problem, eqx.is_array_like)):
        array = np.asarray(leaf)
        hashed.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}".encode())
        hashed.update(array.tobytes())
    return hashed.hexdigest()


@jax.jit
def _values(problem: Problem, u: Float[Array, "samples free"]) -> Float[Array, "samples free"]:
    return jax.vmap(problem.space.values)(u)


def _check_start(size: int, start_u: np.ndarray, start_sd: np.ndarray) -> None:
    for name, array in (("start_u", start_u), ("start_sd", start_sd)):
        if array.shape != (size,) or not np.isfinite(array).all():
            raise ValueError(
                f"{name} is {array}, wanted {size} finite numbers, one per free parameter"
            )
    if not (start_sd > 0).all():
        raise ValueError(f"start_sd is {start_sd}, wanted more than 0 everywhere")


def check_walkers(size: int, walkers: int) -> None:
    """ValueError for a number of walkers that the moves cannot use in `size` dimensions."""
    least = max(4, 2 * size)
    if walkers % 2 or walkers < least:
        raise ValueError(
            f"walkers is {walkers}, wanted an even number from {least} on, two per free parameter"
        )


def _check_counts(max_steps: int, thin_by: int, check_every: int) -> None:
    if thin_by < 1 or check_every < 1:
        raise ValueError(f"thin_by is {thin_by}, check_every {check_every}, wanted 1 or more")
    if max_steps < thin_by:
        raise ValueError(f"max_steps is {max_steps}, wanted at least thin_by, which is {thin_by}")


def _report(chain: Chain, max_steps: int, elapsed: float, slowest: float) -> SamplingProgress:
    last = chain.last
    assert last is not None  # called after a step
    return SamplingProgress(
        step=len(chain) * chain.identity.thin_by,
        max_steps=max_steps,
        elapsed=elapsed,
        acceptance=float(chain.accepted.mean() / len(chain)),
        log_probability=float(np.median(last.log_probability)),
        autocorrelation_time=slowest,
    )


def _conclude(
    problem: Problem,
    chain: Chain,
    check: diagnostics.Check,
    converged: bool,
    message: str,
    seconds: float,
) -> Posterior:
    u = chain.u
    flat = jnp.asarray(u.reshape(-1, u.shape[-1]), problem.space.u0.dtype)
    acceptance = chain.accepted / len(chain)
    stuck = check.apart | diagnostics.lazy_walkers(acceptance)
    return Posterior(
        names=problem.space.names,
        u=u,
        log_probability=chain.log_probability,
        values=np.asarray(_values(problem, flat)).reshape(u.shape),
        thin_by=chain.identity.thin_by,
        burn_in=check.burn_in,
        autocorrelation_time=check.times * chain.identity.thin_by,
        acceptance=acceptance,
        apart=np.flatnonzero(check.apart).tolist(),
        stuck=np.flatnonzero(stuck).tolist(),
        converged=converged,
        message=message,
        seconds=seconds,
    )
