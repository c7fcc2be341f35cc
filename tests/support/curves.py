"""A decay with a jump: a problem of two or three parameters, solved in a second."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from fitting.problem.problem import Problem

from .problems import parameter, problem_of


class Curve(eqx.Module):
    """A decay with a jump where a hard decision changes."""

    height: jax.Array = parameter(0.8, "1", 0.0, 4.0)
    rate: jax.Array = parameter(1.0, "1/s", 0.1, 10.0, scale="log")
    turn: jax.Array = parameter(0.7, "s", 0.0, 1.0, kind="threshold")


TIME = jnp.linspace(0, 1, 200)
CURVE_TRUTH = {"height": 2.0, "rate": 3.0, "turn": 0.4}


def curve(ik: Curve) -> jax.Array:
    time = TIME.astype(ik.rate.dtype)
    decay = ik.height * jnp.exp(-ik.rate * time)
    return jnp.where(time <= ik.turn, decay, decay + 0.5)


def curve_residuals(ik: Curve, data: tuple[jax.Array, jax.Array]) -> jax.Array:
    """Finite only while the height is between the walls."""
    observed, walls = data
    residuals = (curve(ik) - observed) / jnp.asarray(0.02, observed.dtype)
    return jnp.where((walls[0] < ik.height) & (ik.height < walls[1]), residuals, jnp.nan)


def curve_problem(
    names: tuple[str, ...] = ("height", "rate"),
    walls: tuple[float, float] = (-1.0, 9.0),
    **options,
) -> Problem:
    base = Curve(turn=jnp.asarray(0.7 if "turn" in names else CURVE_TRUTH["turn"]))
    random = np.random.default_rng(1)
    clean = curve(Curve(**{name: jnp.asarray(value) for name, value in CURVE_TRUTH.items()}))
    data = clean + random.normal(0, 0.02, TIME.size)
    return problem_of(base, names, (data, jnp.asarray(walls)), curve_residuals, **options)
