"""Half a minute of work whose outcome is known: a shipped clip that known parameters have made."""

import dataclasses
import time

import jax.numpy as jnp
import numpy as np

from fitting.experiment import experiment_files, problems
from fitting.experiment.experiment import Experiment
from fitting.inference.optimise import levenberg_marquardt
from fitting.inference.optimise.levenberg_marquardt import HardModel, LMState
from fitting.problem.problem import Problem
from fitting.runtime.precision import in_float64
from fitting.studies import exports

from .examination import Finding

EXAMPLE = "uneven_walk"
FREE = "pelvis.half_life"
STEPS = 6  # of Levenberg-Marquardt; four are enough
COST = 4348.38  # of the true values: 8640 residuals, whose mean square is that of noise, 1.007
TOLERANCE = 0.01  # of the cost; a step of another size in one foot changes it by more
LARGEST_ERROR = 4.0  # standard errors of the fitted value
WRONG_NUMBERS = (
    "pip install --force-reinstall jax jaxlib, or other versions of them; unset XLA_FLAGS if it"
    " was set"
)


@in_float64
def examine() -> Finding:
    """Runs the system that made the clip, differentiates, and fits one parameter."""
    begin = time.perf_counter()
    experiment, true_value = _experiment()
    problem = problems.make_problem(experiment)
    at_truth = _descend(problem, {FREE: true_value}, 0)
    fitted = _descend(problem, {}, STEPS)
    slopes = np.asarray(at_truth.jacobian)[:, 0]
    value = float(problem.space.values(fitted.u)[0])
    error = float(abs(fitted.u - at_truth.u)[0] * np.linalg.norm(slopes))
    wrong = {
        f"the motion has a cost of {at_truth.cost:.6g}, wanted {COST:g}": not np.isclose(
            at_truth.cost, COST, rtol=TOLERANCE
        ),
        "derivatives are 0 or not finite": not (np.isfinite(slopes).all() and slopes.any()),
        f"the fit found {FREE} = {value:.4g}, wanted {true_value:g}": not error < LARGEST_ERROR,
    }
    differences = [text for text, is_wrong in wrong.items() if is_wrong]
    seconds = time.perf_counter() - begin
    fact = f"motion, derivatives and a fit ({FREE} = {value:.4g}) in {seconds:.0f} s"
    return Finding("self-test", fact, "; ".join(differences), WRONG_NUMBERS)


def _experiment() -> tuple[Experiment, float]:
    """The shipped experiment with its true values fixed but for one, and that one."""
    whole = experiment_files.load_experiment(exports.path_of(EXAMPLE))
    known = dict(problems.load_known_values(whole) or {})
    true_value = known.pop(FREE)
    parameters = {**whole.parameters, **known}
    changed = {"free": {FREE: {}}, "parameters": parameters, "loss": "squares"}
    return dataclasses.replace(whole, **changed), true_value


def _descend(problem: Problem, values: dict[str, float], steps: int) -> LMState:
    """So many steps of Levenberg-Marquardt from these values."""
    u = jnp.asarray(problem.space.pack(values))
    model = HardModel(problem, u)
    state = levenberg_marquardt.evaluate(model, u)
    for _ in range(steps):
        state = levenberg_marquardt.step(model, state)
    return state
