"""Which parameters to free for clips of which nothing is known yet.

Each parameter is swept over its range while the others stay at the system's values, and again at a
few draws from a wide prior, for at one point a rule may happen to be idle. The mean slope of every
residual over such a sweep, which also sees what lies behind a threshold or a limit, stands in for
its derivative, and a normal approximation then tells how far the clips would narrow down the
parameters together. The one they narrow down least is fixed, and so on, until they narrow down all.
It is a forecast: what the clips do determine is for the fit to say.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

import jaxik
from fitting.problem.free_parameters import free_parameter
from fitting.problem.prior import SPREAD
from fitting.problem.scene import Scene
from fitting.problem.space import make_space
from fitting.runtime.precision import in_float64

from .identifiability import UNDETERMINED
from .sensitivity import NEGLIGIBLE, FreeTable, sweep, sweep_points

INDEPENDENT_EVERY = 0.5  # s between residuals of captured motion that tell something new


@dataclasses.dataclass(frozen=True)
class Forecast:
    """What the clips are expected to say of a parameter."""

    name: str
    is_free: bool
    """Whether they should determine it, together with the others that are free."""
    reach: float
    """Sigmas by which it can move a residual."""
    contraction: float
    """Of its variance, alone: 0 where the clips say nothing, 1 where they decide."""
    rival: str = ""
    """The free parameter from which they do not tell it apart; empty where they say little."""

    @property
    def moves(self) -> bool:
        """Whether it changes the motion at all."""
        return self.reach > NEGLIGIBLE


@in_float64
def choose_free(
    ik: jaxik.FootIK, candidates: FreeTable, scenes: tuple[Scene, ...]
) -> list[Forecast]:
    """A forecast for each parameter, in the order of the table.

    Args:
        ik: the system.
        candidates: the parameters, with overrides of their declarations.
        scenes: the clips; of these the sigmas count, the references do not. Ranges are those for
            the body of the first one.
    """
    rig, names = scenes[0].rig, list(candidates)
    parameters = [free_parameter(ik, name, rig, **given) for name, given in candidates.items()]
    space = make_space(ik, parameters)
    seconds = float(np.mean([np.asarray(scene.frames.dt).mean() for scene in scenes]))
    information, reach = np.zeros((space.size, space.size)), np.zeros(space.size)
    points = sweep_points(space)
    for u in points:
        swept = zip(u, sweep(space, scenes, u), strict=True)
        each = [
            (_slope(tried - here, changes), np.abs(changes).max())
            for here, (tried, changes) in swept
        ]
        slopes = np.stack([slope for slope, _ in each])
        information += min(1.0, seconds / INDEPENDENT_EVERY) * slopes @ slopes.T / len(points)
        reach = np.maximum(reach, [size for _, size in each])
    free, rivals = _narrowed_down(information)
    alone = 1.0 - 1.0 / (1.0 + SPREAD**2 * np.diag(information))
    return [
        Forecast(
            name,
            is_free=i in free,
            reach=float(reach[i]),
            contraction=float(alone[i]),
            rival=names[rivals[i]] if i in rivals and alone[i] >= UNDETERMINED else "",
        )
        for i, name in enumerate(names)
    ]


def _slope(
    steps: Float[np.ndarray, " tried"], changes: Float[np.ndarray, "tried residuals"]
) -> Float[np.ndarray, " residuals"]:
    """Of the line through the origin that is nearest to the changes."""
    return steps @ changes / (steps @ steps)


def _narrowed_down(
    information: Float[np.ndarray, "all all"],
) -> tuple[list[int], dict[int, int]]:
    """Parameters of which enough is known together; of each other, the one most like it then."""
    free, rivals = list(range(len(information))), {}
    while free:
        precision = information[np.ix_(free, free)] + np.eye(len(free)) / SPREAD**2
        covariance = np.linalg.inv(precision)
        variances = np.diag(covariance)
        worst = int(np.argmax(variances))
        if 1.0 - variances[worst] / SPREAD**2 >= UNDETERMINED:
            break
        likeness = np.abs(covariance[worst]) / np.sqrt(variances)
        likeness[worst] = 0.0
        rivals[free[worst]] = free[int(np.argmax(likeness))]
        del free[worst]
    return free, rivals
