"""Small problems for tests of the inference, their posteriors, and what JAX compiles for them."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.inference.sample.posterior import Posterior
from fitting.problem.problem import Problem
from fitting.problem.space import free_parameter, make_space
from jaxik.maths import parameter_tree


def parameter(default: float | tuple[float, ...], unit: str, low: float, high: float, **other: Any):
    """A parameter of a test rule."""
    return parameter_tree.parameter(
        default, unit=unit, low=low, high=high, doc="Of the test rule.", **other
    )


class Fractions(eqx.Module):
    """Any number of parameters, each between 0 and 1."""

    x: Float[Array, " legs"] = parameter((0.5,), "", 0.0, 1.0)


def problem_of(
    ik: Any, names: Sequence[str], data: Any, residuals: Callable, *options: Any, **named: Any
) -> Problem:
    """A problem in which these parameters of a system are free."""
    space = make_space(ik, [free_parameter(ik, name) for name in names])
    return Problem(space, data, residuals, *options, **named)


def problem_of_fractions(size: int, data: Any, residuals: Callable) -> Problem:
    """A problem in which so many fractions are free, each half to begin with."""
    names = [f"x[{i}]" for i in range(size)]
    return problem_of(Fractions(x=jnp.full(size, 0.5)), names, data, residuals)


def posterior_of(
    names: tuple[str, ...],
    u: Float[np.ndarray, "steps walkers free"],
    values: Float[np.ndarray, "steps walkers free"],
    **other: Any,
) -> Posterior:
    """A posterior of draws, whose density is that of a standard normal."""
    walkers, free = u.shape[1:]
    fields: dict[str, Any] = {
        "thin_by": 1,
        "burn_in": 0,
        "autocorrelation_time": np.ones(free),
        "acceptance": np.full(walkers, 0.3),
        "isolated": [],
        "stuck": [],
    }
    return Posterior(
        names=names,
        u=u,
        log_probability=-0.5 * np.sum(u**2, axis=-1),
        values=values,
        converged=True,
        message="Converged.",
        seconds=1.0,
        **fields | other,
    )


@contextlib.contextmanager
def compilations() -> Iterator[list[str]]:
    """What JAX compiles meanwhile; at the end it is seen to hear of a compilation at all."""
    compiled: list[str] = []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
        count = len(compiled)
        jax.jit(lambda x: x + 1)(1.0)
        assert len(compiled) > count
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
