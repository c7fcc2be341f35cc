"""The sampler without slopes beside one with slopes: the same moments on a smooth problem."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.inference.sampling.autocorrelation import autocorrelation_time
from fitting.inference.sampling.posterior import WalkerStart, sample_posterior
from fitting.inference.sampling.settings import SamplerSettings
from fitting.problem.problem import Problem
from support import toy
from support.problems import problem_of

NAMES = ("foot.share", "foot.half_life", "body.gain")
FRAMES = 20  # so few that the prior matters and the posterior is no normal
WARM_UP, DRAWS, CHAINS = 200, 800, 4


def smooth_problem() -> Problem:
    """Three parameters, far from every limit, of a system whose locks they do not reach."""
    ik = toy.Toy(foot=toy.Foot(limit=(0.8, 0.8)), body=toy.Body(drop=0.4, rise=0.2))  # type: ignore[arg-type]
    wide = {"foot.limit[0]": 0.79, "foot.limit[1]": 0.79, "body.drop": 0.39, "body.rise": 0.19}
    truth = toy.TRUTH | wide | {"foot.share": 0.9, "foot.half_life": 0.2, "body.gain": 0.1}
    clip = toy.make_problem(truth=truth).data
    short = jax.tree.map(lambda leaf: leaf[:FRAMES] if leaf.ndim else leaf, clip)
    return problem_of(ik, NAMES, short, few_and_noisy)


def few_and_noisy(ik: toy.Toy, data: toy.Data) -> jax.Array:
    """Residuals of motion that was measured badly: sigmas of 2 cm and 0.2 rad."""
    return toy.residuals(ik, data) / 10.0


def sampled_with_slopes(problem: Problem, u: np.ndarray) -> np.ndarray:
    """Draws of NUTS, (draws, chains, free)."""
    blackjax = pytest.importorskip("blackjax")

    @jax.jit
    def chain(key):
        warm_up, sampling = jax.random.split(key)
        adaptation = blackjax.window_adaptation(blackjax.nuts, problem.log_probability)
        (state, parameters), _ = adaptation.run(warm_up, jnp.asarray(u), num_steps=WARM_UP)
        kernel = blackjax.nuts(problem.log_probability, **parameters).step

        def step(state, key):
            state, _ = kernel(key, state)
            return state, state.position

        return jax.lax.scan(step, state, jax.random.split(sampling, DRAWS))[1]

    keys = jax.random.split(jax.random.key(0), CHAINS)
    return np.asarray(jax.vmap(chain)(keys)).swapaxes(0, 1)


def moments(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means of `u` and of its squares, and their standard errors."""
    both = np.concatenate([u, u**2], axis=-1)
    count = both.shape[0] * both.shape[1]
    error = both.std(axis=(0, 1)) * np.sqrt(autocorrelation_time(both) / count)
    return both.mean(axis=(0, 1)), error


@pytest.mark.slow
def test_nuts_and_emcee_give_the_same_moments():
    problem = smooth_problem()
    start = np.asarray(problem.space.pack({}))
    with_slopes = sampled_with_slopes(problem, start)
    settings = SamplerSettings(walkers=24, max_steps=1500, stop_at=1e9)
    posterior = sample_posterior(problem, WalkerStart(start, np.full(3, 0.3)), settings)
    theirs, their_error = moments(with_slopes)
    ours, our_error = moments(posterior.kept_u)
    assert np.all(np.abs(ours - theirs) < 4 * np.hypot(our_error, their_error))
    spread = np.std(with_slopes, axis=(0, 1))
    assert np.all(np.hypot(our_error, their_error)[:3] < 0.1 * spread)  # sharp enough to differ
    assert np.all(spread > 0.05)
