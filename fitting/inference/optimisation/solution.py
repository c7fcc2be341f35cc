"""What a search reports while it runs, and its result."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Progress:
    """One report of a running search."""

    stage: str  # start, blocks, ensemble, sweep, slopes or polish
    start: int  # index of the starting point
    step: int  # Levenberg–Marquardt steps so far, from this start
    cost: float  # of the point that the stage has reached
    best: float  # minimum cost of the hard program so far, over all starts
    seconds: float  # since the search began


@dataclasses.dataclass(frozen=True)
class Solution:
    """The best point of a search, and how the search ended."""

    names: tuple[str, ...]
    u: Float[np.ndarray, " free"]
    values: Float[np.ndarray, " free"]  # in the parameters' units
    cost_before: float  # of the system's values before the fit
    cost: float
    converged: bool
    message: str  # one sentence
    jacobian: Float[np.ndarray, "residuals free"]  # of `Problem.residuals`; 0 for thresholds
    history: tuple[Progress, ...]
    steps: int  # of Levenberg–Marquardt, all starts together
    seconds: float
    interrupted: bool = False
