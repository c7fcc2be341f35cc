"""What a running fit reports, and where it ended."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Progress:
    """One report of a running fit."""

    stage: str
    start: int  # which start, from 0
    step: int  # steps of Levenberg–Marquardt so far, in this start
    cost: float  # where the stage stands
    best: float  # lowest cost on the hard rows so far, over all starts
    seconds: float  # since the beginning


@dataclasses.dataclass(frozen=True)
class Solution:
    """Where a fit ended, and how."""

    names: tuple[str, ...]
    u: Float[np.ndarray, " free"]
    values: Float[np.ndarray, " free"]  # in their own units
    cost_before: float  # of the base's values
    cost: float
    converged: bool
    message: str  # one sentence
    jacobian: Float[np.ndarray, "rows free"]  # of `Problem.rows` at `u`; zero at thresholds
    history: tuple[Progress, ...]
    steps: int  # of Levenberg–Marquardt, all starts together
    seconds: float
    interrupted: bool = False
