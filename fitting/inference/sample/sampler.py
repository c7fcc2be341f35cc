"""Steps of emcee through the hard program.

The moves are differential evolution at its usual scale (ter Braak 2006), and jumps, which lead from
one mode of the posterior to another. Never emcee 3.1.6's snooker move: its acceptance is wrong,
and in 20 dimensions it shrinks a unit variance to 0.81.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias, cast

import emcee
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.inference.sharding import over_devices
from fitting.problem.problem import Problem
from fitting.runtime import activity
from fitting.runtime.program_cache import cached, committed
from jaxik import lanes

from .chain import Chain, Identity, LastStep, RandomState
from .modes import Modes, find_modes

# Fraction of the steps. Effective samples per 1,000 evaluations of the slowest parameter, with 0,
# 0.2 and 0.5: 39, 96 and 210 for the 6 smooth ones of data/experiments/ozz.toml, 3, 18 and 14 for
# the 17 of uneven_walk.toml, four of them thresholds.
JUMPS = 0.3
Balls: TypeAlias = Float[np.ndarray, "walkers free"]
DRAWS = 100  # attempts to start every walker where its log-probability is finite
FIRST_LESSON = 100  # steps before the first jump


class JumpMove(emcee.moves.MHMove):
    """Proposals around all modes that the later half of a chain shows, wherever a walker is.

    Differential evolution moves a walker by the difference of two others, which seldom leads from
    a mode to a place on another one that is as good. Jumps are independent of the walker
    (Tierney 1994, section 2.3.3). They are learnt anew whenever the chain is twice as long, so that
    they settle (Chimisov, Latuszynski and Roberts, Air Markov chain Monte Carlo, 2018), and follow
    from the chain alone: a resumed chain makes the same.
    """

    def __init__(self, chain: Chain):
        super().__init__(self._proposals)
        self._chain = chain
        self._learnt_from = 0  # stored steps
        self._modes: Modes | None = None
        self._before = emcee.moves.DEMove(gamma0=1.0)

    def propose(self, model, state):
        """A jump of every walker; before the first lesson, whole differences of two walkers."""
        length = lesson(len(self._chain), self._chain.identity.thin_by)
        if not length:
            return self._before.propose(model, state)
        if length != self._learnt_from:
            self._learnt_from = length
            self._modes = find_modes(self._chain.u[length // 2 : length])
        return super().propose(model, state)

    def _proposals(
        self, u: np.ndarray, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """New positions, and the log-ratios of their densities."""
        assert self._modes is not None
        proposed = self._modes.draw(random, len(u))
        return proposed, self._modes.log_density(u) - self._modes.log_density(proposed)


def lesson(stored: int, thin_by: int) -> int:
    """How many stored steps jumps are learnt from: a power of two times the first ones."""
    first = math.ceil(FIRST_LESSON / thin_by)
    return first << int(math.log2(stored / first)) if stored >= first else 0


def moves(chain: Chain) -> list[tuple[emcee.moves.Move, float]]:
    """Proposals, and the fraction of steps that each makes."""
    return [(emcee.moves.DEMove(), 1 - JUMPS), (JumpMove(chain), JUMPS)]


class _Recorder(emcee.backends.Backend):
    """Passes emcee's steps on to a chain."""

    def __init__(self, chain: Chain):
        super().__init__()
        self.record = chain.append

    def grow(self, ngrow: int, blobs: object) -> None:
        """The chain grows by itself."""

    def save_step(self, state: Any, accepted: np.ndarray) -> None:
        self.record(state.coords, state.log_prob, accepted, state.random_state)


@cached
def log_probabilities(
    problem: Problem, u: Float[Array, "walkers free"]
) -> Float[Array, " walkers"]:
    """Of several points; -inf where it is not finite."""
    log_probability = lanes(problem.log_probability)(u)
    # emcee raises on NaN
    return jnp.where(jnp.isfinite(log_probability), log_probability, -jnp.inf)


def steps(
    problem: Problem, chain: Chain, centres: Balls, widths: Balls, limit: int
) -> Iterator[emcee.State]:
    """Continues the chain from its last step to `limit` stored steps, one at a time.

    Each walker of a new chain starts in its ball, of this centre and width in `u`.
    """
    identity = chain.identity
    dtype = problem.space.start.dtype
    problem = committed(over_devices(problem))

    def evaluate(u: np.ndarray) -> np.ndarray:
        """Half of the walkers at a time, as the moves need them: one program."""
        halves = np.asarray(u, dtype).reshape(-1, identity.walkers // 2, u.shape[1])
        return np.concatenate(
            [np.asarray(log_probabilities(problem, jnp.asarray(half)), float) for half in halves]
        )

    last = chain.last
    if last is None:
        with activity.announced(f"Placing {identity.walkers} walkers"):
            last = _start(identity, evaluate, centres, widths)
    sampler = emcee.EnsembleSampler(
        identity.walkers,
        problem.space.size,
        evaluate,
        moves=moves(chain),
        backend=_Recorder(chain),
        vectorize=True,
    )
    sampler.log_prob_fn = evaluate  # type: ignore[assignment]  # emcee's wrapper prints all walkers when interrupted
    yield from sampler.sample(
        emcee.State(last.u, log_prob=last.log_probability, random_state=last.random_state),
        iterations=limit - len(chain),
        thin_by=identity.thin_by,
        skip_initial_state_check=True,
    )


def _start(
    identity: Identity,
    evaluate: Callable[[np.ndarray], np.ndarray],
    centres: Balls,
    widths: Balls,
) -> LastStep:
    """Walkers in their balls, each drawn until its log-probability is finite."""
    random = np.random.RandomState(identity.seed)  # emcee continues with this generator's state
    u = np.empty(centres.shape)
    log_probability = np.full(identity.walkers, -np.inf)
    for _ in range(DRAWS):
        missing = np.isneginf(log_probability)
        drawn = centres + widths * random.standard_normal(u.shape)
        u[missing] = drawn[missing]
        log_probability[missing] = evaluate(drawn)[missing]
        if np.isfinite(log_probability).all():
            return LastStep(u, log_probability, cast(RandomState, random.get_state()))
    finite = int(np.isfinite(log_probability).sum())
    raise ValueError(
        f"only {finite} of {identity.walkers} walkers have a finite log-probability after {DRAWS}"
        " draws around start.u; start from a fit, with a smaller start.sd"
    )
