"""What is known of each free parameter before any clip, in the parameter's unit."""

from typing import TypedDict

import numpy as np

from fitting.problem.space import Space
from fitting.runtime.precision import in_float64


class PriorSummary(TypedDict):
    """The prior of one parameter, as `fit.json` and `posterior.json` hold it."""

    shape: str
    """Normal or uniform."""
    centre: float | None
    """In the parameter's unit, with the other parameters at their centres; None where uniform."""
    spread: float | None
    """Standard deviation of u; None where uniform."""
    interval: list[float]
    """The central 95 %, in the parameter's unit."""


@in_float64
def summarise_priors(space: Space) -> dict[str, PriorSummary]:
    """The priors of a space's parameters by name."""
    centre, spread = np.asarray(space.values(space.prior.centre)), np.asarray(space.prior.spread)
    uniform, interval = np.asarray(space.prior.uniform), space.prior_interval()
    return {
        name: PriorSummary(
            shape="uniform" if uniform[i] else "normal",
            centre=None if uniform[i] else float(centre[i]),
            spread=None if uniform[i] else float(spread[i]),
            interval=[float(end) for end in interval[i]],
        )
        for i, name in enumerate(space.names)
    }
