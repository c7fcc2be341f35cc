"""The distribution of noise that a loss stands for."""

from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from fitting.inference.noise.density import NoiseDensity
from fitting.problem.loss import CAUCHY, Loss

EXACT: dict[Loss, Any] = {
    "squares": stats.norm(),
    "student": stats.t(3.5),
    # exp(-c²/2 log(1 + r²/c²)) is a t distribution with c² - 1 degrees of freedom.
    "cauchy": stats.t(CAUCHY**2 - 1, scale=CAUCHY / np.sqrt(CAUCHY**2 - 1)),
}


@pytest.mark.parametrize("loss", EXACT)
def test_the_log_density_is_that_of_a_known_distribution(loss):
    r = np.array([-30.0, -2.0, 0.0, 0.7, 4.0, 100.0])
    expected = EXACT[loss].logpdf(r)
    np.testing.assert_allclose(NoiseDensity(loss, 3.5).log_density(r), expected, atol=1e-4)


@pytest.mark.parametrize("loss", ["squares", "huber", "cauchy", "student"])
def test_draws_have_the_density(loss):
    density = NoiseDensity(loss, 2.0)
    draws = density.draw(np.random.default_rng(0), (4000, 5)).ravel()

    def density_at(r: float) -> float:
        return float(np.exp(density.log_density(np.array(r))))

    for end in (-1.5, 0.4, 3.0):
        below = integrate.quad(density_at, -np.inf, end)[0]
        assert np.mean(draws < end) == pytest.approx(below, abs=4 * 0.5 / draws.size**0.5)
    assert integrate.quad(density_at, -np.inf, np.inf)[0] == pytest.approx(1.0, abs=1e-4)
