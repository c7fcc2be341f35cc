"""A replicate under a wrong model: another system makes the motion, and it is captured with errors.

No value of the fitted parameters is true, then. What a fit says of its motion still must be: on
frames that were held out, against the capture and against the motion that has no errors.
"""

import copy
import dataclasses
from collections.abc import Callable
from typing import TypedDict, cast

import equinox as eqx
import numpy as np

import jaxik
from fitting.experiments import systems
from fitting.experiments.experiment import Experiment
from fitting.inference import sensitivity
from fitting.inference.optimisation.solution import Progress
from fitting.problem.free_parameters import free_parameter, present_value
from fitting.problem.problem import Problem
from fitting.problem.simulation import with_motion_of
from fitting.problem.space import make_space
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.storage.declared_types import Finite
from fitting.runtime.validation import Content
from fitting.studies.fit import Fit
from fitting.studies.translation import NamedSystem

from .capture_errors import draw_sizes, with_errors
from .replicates import Outcome, fit_simulated, outcome

SPREAD = 0.3  # of u, in which the truth's parameters are drawn around the values of the system


class KindDistances(TypedDict):
    """Distances of a motion by kind of joint, m and rad."""

    ankle: Finite
    knee: Finite
    pelvis: Finite
    foot: Finite


class MotionDistances(TypedDict):
    """Distances of all motions on the same frames."""

    animation: KindDistances
    before: KindDistances
    fitted: KindDistances


class PartDistances(TypedDict):
    """Distances on fitted and on held-out frames, as `Distances` has them."""

    fitted: MotionDistances
    held_out: MotionDistances


class Judgement(TypedDict):
    """What a fit says of its motion, and what it rests on."""

    fits: bool
    sentence: str
    distances: PartDistances


class WrongModelFit(Outcome):
    """The fit to motion that another system has made."""

    truth_values: dict[str, Finite]
    """Of the parameters of that system, by dotted name."""
    errors: dict[str, Finite]
    """Sizes of the capture's errors, as `ErrorSizes` has them."""
    captured: Judgement
    """The fit against the capture, as `jaxik fit` reports it."""
    lasting: Judgement
    """The same fit against a capture with only the errors that last: no noise and no jumps."""
    noise_free: Judgement
    """The same fit against the motion without errors."""


@in_float64
def draw_system(
    truth: jaxik.FootIK, rig: jaxik.Rig | None, random: np.random.Generator
) -> tuple[jaxik.FootIK, dict[str, float]]:
    """A system near the given one, and its parameters by name.

    What is 0 stays 0, and what is at a bound stays there: both mean that something is off. Vectors
    stay, as they are places on the body, and so does what another parameter stays above.

    Args:
        truth: the system.
        rig: whose body its ranges are for; None is the adult.
        random: what it is drawn from.
    """
    table = sensitivity.all_parameters(truth, rig)
    numbers = [name for name in table if present_value(truth, name) and "[" not in name]
    parameters = [free_parameter(truth, name, rig, **table[name]) for name in numbers]
    below = {parameter.above for parameter in parameters}
    parameters = [parameter for parameter in parameters if parameter.leaf not in below]
    space = make_space(with_floats(truth, np.float64), parameters)
    u = np.asarray(space.pack({})) + SPREAD * random.normal(size=space.size)
    ik = space.unpack(u)
    return ik, {name: present_value(ik, name) for name in table}


def fit_wrong_model(
    problem: Problem[jaxik.FootIK],
    experiment: Experiment,
    truth: jaxik.FootIK,
    number: int,
    progress: Callable[[Progress], None] | None = None,
    noise_factor: float = 1.0,
) -> WrongModelFit:
    """Fits the motion of another system, captured with errors, as `jaxik fit` does.

    Args:
        problem: of the experiment.
        experiment: its settings of the search, and the seed.
        truth: the other system, around which the truth of the replicate is drawn.
        number: of the replicate, from 0.
        progress: called as the search goes on.
        noise_factor: how much larger the errors are than usual.

    Raises:
        KeyboardInterrupt: the search was interrupted; half a fit counts for nothing.
        ValueError: the fit cannot be assessed.
    """
    random = np.random.default_rng([experiment.seed, number])
    rig = problem.data[0].rig if experiment.body == "clip" else None
    ik, values = draw_system(truth, rig, random)
    masked = [clip.mask_pops for clip in experiment.clips]
    made, sizes = with_motion_of(problem, ik), draw_sizes(random, noise_factor)
    lasting_sizes = dataclasses.replace(sizes, pop=0.0, noise=0.0)
    lasting = with_errors(made, lasting_sizes, masked, copy.deepcopy(random))
    captured = with_errors(made, sizes, masked, random)
    own = dataclasses.replace(experiment, seed=int(random.integers(2**32)))
    fitted = fit_simulated(captured, own, progress)
    return {
        **outcome(number, fitted),
        "truth_values": values,
        "errors": dataclasses.asdict(sizes),
        "captured": _judged(fitted),
        "lasting": _judged(_against(fitted, lasting)),
        "noise_free": _judged(_against(fitted, made)),
    }


def _against(fitted: Fit, made: Problem[jaxik.FootIK]) -> Fit:
    """A fit as it is judged by other references, on the frames that were seen in its own."""
    references = [
        dataclasses.replace(
            scene.reference,
            observed=seen.reference.observed,
            held_out=seen.reference.held_out,
        )
        for scene, seen in zip(made.data, fitted.problem.data, strict=True)
    ]
    problem = eqx.tree_at(
        lambda problem: [scene.reference for scene in problem.data], fitted.problem, references
    )
    return dataclasses.replace(fitted, problem=problem)


def _judged(fitted: Fit) -> Judgement:
    parts = {
        part: {motion: dict(kinds) for motion, kinds in motions.items()}
        for part, motions in fitted.distances.parts.items()
    }
    return {
        "fits": fitted.verdict.fits,
        "sentence": fitted.verdict.sentence,
        "distances": cast(PartDistances, parts),
    }


def identity_of(truth: NamedSystem) -> Content:
    """What the truths of all replicates follow from, as JSON holds it."""
    leaves = {name: present_value(truth.ik, name) for name in sensitivity.all_parameters(truth.ik)}
    return {"name": truth.name, "rules": systems.rule_names(truth.ik), "values": leaves}
