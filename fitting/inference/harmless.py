"""The few parameters on which it depends whether a system leaves a motion alone.

On flat ground a capture says nothing but that foot IK must not move the feet. Where a system moves
them, each parameter is swept over its range while the others stay, the change that helps most is
kept, and so on, up to `MOST` changes. They are for a fit to refine.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

import jaxik
from fitting.problem.free_parameters import free_parameter
from fitting.problem.loss import rho
from fitting.problem.scene import Scene, left_alone
from fitting.problem.space import make_space
from fitting.runtime.precision import in_float64

from .sensitivity import FreeTable, residuals_at, sweep

MOST = 4  # parameters that are changed
AS_GOOD = 0.02  # of the cost that is to be gained: among changes so alike, the smallest is taken


@in_float64
def leave_alone(
    ik: jaxik.FootIK,
    candidates: FreeTable,
    scenes: tuple[Scene, ...],
    is_harmless: Callable[[jaxik.FootIK], bool],
) -> list[str]:
    """Names of the parameters that are to be changed; not more than are needed.

    Args:
        ik: the system.
        candidates: the parameters, with overrides of their declarations.
        scenes: the clips, whose animations are to be left as they are.
        is_harmless: whether a system leaves them alone, which ends the search.
    """
    rig = scenes[0].rig
    parameters = [free_parameter(ik, name, rig, **given) for name, given in candidates.items()]
    space = make_space(ik, parameters)
    scenes = tuple(left_alone(scene) for scene in scenes)
    u, changed = np.asarray(space.pack({})), list[str]()
    while len(changed) < MOST and not is_harmless(space.unpack(u)):
        here = residuals_at(space, scenes, u[None])[0]
        present, costs, places = _cost(here), [], []
        for i, (tried, moved) in enumerate(sweep(space, scenes, u)):
            costs += [_cost(here + row) for row in moved]
            places += [(i, place) for place in tried]
        best = min(costs)
        if not best < present:
            break
        good = np.flatnonzero(np.asarray(costs) <= best + AS_GOOD * (present - best))
        i, place = min((places[k] for k in good), key=lambda at: abs(at[1] - u[at[0]]))
        u = np.where(np.arange(space.size) == i, place, u)
        changed.append(space.names[i])
    return changed


def _cost(residuals: Float[np.ndarray, " residuals"]) -> float:
    """As a fit counts it, without the prior."""
    return 0.5 * float(np.sum(rho(residuals**2, "huber", library=np)))
