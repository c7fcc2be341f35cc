"""Reports of a posterior: islands, one parameter alone."""

import math
from dataclasses import replace
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes

from fitting.inference.sampling.islands import Island
from fitting.inference.sampling.posterior import Posterior
from fitting.problem.free_parameters import free_parameter
from fitting.problem.space import Space, make_space
from fitting.report import posterior_report
from fitting.report.formatting import markdown
from fitting.report.plots import posterior_plots
from fitting.report.uncertainty import islands
from fitting.studies.sample import SampledFit
from support import toy
from support.problems import posterior_of

NAMES = ("foot.share", "foot.idle")


def space_of(names: tuple[str, ...]) -> Space:
    ik = toy.Toy()
    return make_space(ik, [free_parameter(ik, name) for name in names])


def posterior(names: tuple[str, ...] = NAMES, **other: Any) -> Posterior:
    """Normal draws."""
    u = 0.3 * np.random.default_rng(0).normal(size=(100, 8, len(names)))
    return replace(posterior_of(names, u, 0.6 + 0.2 * u, burn_in=10), **other)


def sampled_fit(posterior: Posterior) -> SampledFit:
    """As far as texts need it: a posterior around a fit with these rows."""
    row = {"kind": "smooth", "value": 0.6, "interval": [0.5, 0.7]}
    rows: Any = [{"name": name} | row for name in posterior.names]
    return SampledFit(cast(Any, None), space_of(posterior.names), rows, posterior)


def text_of(**other: Any) -> str:
    return posterior_report.posterior_text(sampled_fit(posterior(**other)))


def island(weight: float, exchanges: int, u: float) -> Island:
    error = 0.012 if exchanges >= 20 else math.nan
    return Island(np.full(2, u), weight, error, exchanges, 4, -12.5)


def test_one_parameter_alone_can_be_drawn():
    (name,) = names = NAMES[:1]
    figure = posterior_plots.corner(
        posterior(names), names, {name: 0.61}, {name: 0.55}, "one", space_of(names)
    )
    (axes,) = figure.axes
    assert {0.61, 0.55} <= first_coordinates(axes)[0]


def first_coordinates(axes: Axes) -> tuple[set[float], set[float]]:
    """x and y of where the lines of a panel begin."""
    starts = [np.asarray(line.get_data(), float)[:, 0] for line in axes.lines]
    return {float(x) for x, _ in starts}, {float(y) for _, y in starts}


def test_the_lines_of_known_values_cross_in_every_panel_of_their_parameters():
    fitted, known = {"foot.share": 0.61, "foot.idle": 0.5}, {"foot.idle": 0.4}
    figure = posterior_plots.corner(posterior(), NAMES, fitted, known, "two")
    marks = [first_coordinates(axes) for axes in figure.axes]
    assert 0.61 in marks[0][0] and 0.61 in marks[2][0]
    assert {0.5, 0.4} <= marks[2][1] and {0.5, 0.4} <= marks[3][0]


def test_islands_are_shown_with_weights_exchanges_and_medians():
    found = (island(0.81, 250, 0.0), island(0.19, 250, 1.5))
    assert "2 islands: 81.0 % ± 1.2 %, 19.0 % ± 1.2 %" in text_of(islands=found)
    space = space_of(NAMES)
    section = islands.island_section(posterior(islands=found), space, dict.fromkeys(NAMES, "1"))
    text = "\n".join(section)
    assert "| 1 | 81.0 % ± 1.2 % | 250 | 4 | -12.5 |" in text
    first, second = (np.asarray(space.values(jnp.full(2, u))) for u in (0.0, 1.5))
    assert f"| foot.share | 1 | {first[0]:.4g} | {second[0]:.4g} |" in text
    assert "out of reach" not in text


def test_islands_without_exchanges_are_said_to_be_out_of_reach():
    found = (island(0.75, 3, 0.0), island(0.25, 3, 1.5))
    text = text_of(islands=found)
    assert "out of reach (75.0 % of the draws), out of reach (25.0 % of the draws)" in text
    table = islands.island_table(found)
    assert "| 2 | out of reach (25.0 % of the draws) | 3 |" in markdown(table)


def test_walkers_are_not_left_out_in_silence():
    text = text_of(isolated=[2, 5], isolated_mass=0.0071)
    assert "Left out are walkers 2, 5" in text and "about 0.71 % of the posterior" in text


def posterior_around(value: float, width: float) -> Posterior:
    """Draws of which 95 % lie in an interval of this width."""
    draws = posterior(NAMES[:1])
    return replace(draws, values=value + width / 3.92 * draws.u / draws.u.std())


@pytest.mark.parametrize(
    ("value", "width", "kind", "reason"),
    [
        (0.6, 0.2, "smooth", None),
        (0.75, 0.2, "smooth", "leaves out the fit"),
        (0.6, 0.08, "smooth", "narrower"),
        (0.6, 0.08, "threshold", None),
        (0.6, 0.03, "threshold", "narrower"),
        (0.6, 0.5, "threshold", "wider"),
    ],
)
def test_an_interval_that_contradicts_the_fit_is_found(value, width, kind, reason):
    sampled = sampled_fit(posterior_around(value, width))
    sampled.parameters[0]["kind"] = kind
    found = [row["reason"] for row in sampled.disagreements]
    assert found == ([] if reason is None else [reason])
    text = posterior_report.posterior_text(sampled)
    assert ("The chain contradicts its fit" in text) == (reason is not None)
    assert sampled_fit(replace(sampled.posterior, converged=False)).disagreements == []


def test_a_better_point_of_the_chain_is_said_without_a_folder_too():
    top = float(posterior().log_probability.max())
    text = text_of(start_log_probability=top - 3.25)
    assert "log-probability is 3.25 higher" in text and "`Posterior.best_values`" in text
    assert "contradicts" not in text_of(start_log_probability=top - 0.05)
