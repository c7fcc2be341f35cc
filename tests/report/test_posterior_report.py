"""Reports of a posterior: islands, one parameter alone."""

import math
from dataclasses import replace
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest

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

NAMES = ("foot.share", "foot.idle")


def space_of(names: tuple[str, ...]) -> Space:
    ik = toy.Toy()
    return make_space(ik, [free_parameter(ik, name) for name in names])


def posterior_of(names: tuple[str, ...]) -> Posterior:
    """Normal draws."""
    u = 0.3 * np.random.default_rng(0).normal(size=(100, 8, len(names)))
    return Posterior(
        names=names,
        u=u,
        log_probability=-0.5 * np.sum(u**2, axis=-1),
        values=0.6 + 0.2 * u,
        thin_by=1,
        burn_in=10,
        autocorrelation_time=np.full(len(names), 2.0),
        acceptance=np.full(8, 0.3),
        isolated=[],
        stuck=[],
        converged=True,
        message="Converged.",
        seconds=1.0,
    )


def sampled_fit(posterior: Posterior, **other: Any) -> SampledFit:
    """As far as texts need it: a posterior around a fit with these rows."""
    rows = [
        {"name": name, "kind": "smooth", "value": 0.6, "interval": [0.5, 0.7]}
        for name in posterior.names
    ]
    space = space_of(posterior.names)
    return SampledFit(cast(Any, None), space, cast(Any, rows), replace(posterior, **other))


def island(weight: float, exchanges: int, u: float) -> Island:
    error = 0.012 if exchanges >= 20 else math.nan
    return Island(np.full(2, u), weight, error, exchanges, 4, -12.5)


def test_one_parameter_alone_can_be_drawn():
    posterior = posterior_of(NAMES[:1])
    figure = posterior_plots.corner(
        posterior, NAMES[:1], {"foot.share": 0.61}, {"foot.share": 0.55}, "one", space_of(NAMES[:1])
    )
    (axes,) = figure.axes
    marks = [float(np.asarray(line.get_xdata())[0]) for line in axes.lines]
    assert {0.61, 0.55} <= set(marks)


def test_the_lines_of_known_values_cross_in_every_panel_of_their_parameters():
    posterior = posterior_of(NAMES)
    figure = posterior_plots.corner(
        posterior, NAMES, {"foot.share": 0.61, "foot.idle": 0.5}, {"foot.idle": 0.4}, "two"
    )
    marks = [
        [{float(np.asarray(data)[0]) for line in axes.lines for data in (line.get_data()[k],)}
         for k in (0, 1)]
        for axes in figure.axes
    ]  # fmt: skip
    assert 0.61 in marks[0][0] and 0.61 in marks[2][0]
    assert {0.5, 0.4} <= marks[2][1] and {0.5, 0.4} <= marks[3][0]


def test_islands_are_shown_with_weights_exchanges_and_medians():
    found = (island(0.81, 250, 0.0), island(0.19, 250, 1.5))
    posterior = replace(posterior_of(NAMES), islands=found)
    text = posterior_report.posterior_text(sampled_fit(posterior))
    assert "2 islands: 81.0 % ± 1.2 %, 19.0 % ± 1.2 %" in text
    space = space_of(NAMES)
    parts = islands.island_section(posterior, space, {"foot.share": "1", "foot.idle": "1"})
    text = "\n".join(parts)
    assert "| 1 | 81.0 % ± 1.2 % | 250 | 4 | -12.5 |" in text
    first, second = (np.asarray(space.values(jnp.full(2, u))) for u in (0.0, 1.5))
    assert f"| foot.share | 1 | {first[0]:.4g} | {second[0]:.4g} |" in text
    assert "out of reach" not in text


def test_islands_without_exchanges_are_said_to_be_out_of_reach():
    found = (island(0.75, 3, 0.0), island(0.25, 3, 1.5))
    text = posterior_report.posterior_text(sampled_fit(posterior_of(NAMES), islands=found))
    assert "out of reach (75.0 % of the draws), out of reach (25.0 % of the draws)" in text
    table = islands.island_table(found)
    assert "| 2 | out of reach (25.0 % of the draws) | 3 |" in markdown(table)


def test_walkers_are_not_left_out_in_silence():
    left_out = {"isolated": [2, 5], "isolated_mass": 0.0071}
    text = posterior_report.posterior_text(sampled_fit(posterior_of(NAMES), **left_out))
    assert "Left out are walkers 2, 5" in text and "about 0.71 % of the posterior" in text


def posterior_around(value: float, width: float) -> Posterior:
    """Draws of which 95 % lie in an interval of this width."""
    posterior = posterior_of(NAMES[:1])
    spread = width / 3.92
    return replace(posterior, values=value + spread * posterior.u / posterior.u.std())


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
    unfinished = sampled_fit(sampled.posterior, converged=False)
    assert unfinished.disagreements == []


def test_a_better_point_of_the_chain_is_said_without_a_folder_too():
    posterior = posterior_of(NAMES)
    top = float(posterior.log_probability.max())
    text = posterior_report.posterior_text(sampled_fit(posterior, start_log_probability=top - 3.25))
    assert "log-probability is 3.25 higher" in text and "`Posterior.best_values`" in text
    same = sampled_fit(posterior, start_log_probability=top - 0.05)
    assert "contradicts" not in posterior_report.posterior_text(same)
