"""How thoroughly a search looks: the numbers that its stages share."""

import dataclasses

from fitting.inference.settings import Settings, setting

MAX_STARTS = 6  # independent ones, where the user names no other number


@dataclasses.dataclass(frozen=True)
class SearchSettings(Settings):
    """Settings of `search.find_best_fit`.

    Spreads are standard deviations of `u`, gains are relative falls of the cost.

    Raises:
        ValueError: for a setting out of its range.
    """

    max_steps: int = setting(
        1000, "Levenberg–Marquardt steps allowed for each start.", unit="steps", low=1, high=100_000
    )
    # Starts
    draws: int = setting(
        126,
        "Draws from the prior of which the best descend.",
        unit="candidates",
        low=2,
        high=100_000,
    )
    descents: int = setting(
        6,
        "Descents of a start, at most; half the number of parameters if that is less.",
        low=1,
        high=1000,
    )
    agreement: float = setting(
        3.0, "Two ends whose costs differ by no more than this agree.", unit="cost", high=1e6
    )
    agreeing_starts: int = setting(
        2,
        "Starts that must agree; they must also be half of those made.",
        unit="starts",
        low=1,
        high=1000,
    )
    # Levenberg–Marquardt
    descent_steps: int = setting(
        8,
        "Steps of a descent, between two changes of the decisions.",
        unit="steps",
        low=1,
        high=1000,
    )
    min_step_gain: float = setting(
        1e-6, "A step that lowers the cost by less than this is a small one.", high=1.0
    )
    max_small_steps: int = setting(
        2, "Small steps in a row that end a descent.", unit="steps", low=1, high=1000
    )
    max_rejected_steps: int = setting(
        5,
        "Rejected steps in a row that end a descent; each shrinks the step to a quarter.",
        unit="steps",
        low=1,
        high=1000,
    )
    polish_max_rejected_steps: int = setting(
        12,
        "Rejected steps in a row that end the last descent of a start.",
        unit="steps",
        low=1,
        high=1000,
    )
    # Evolution
    population: int = setting(
        64, "Candidates in a generation.", unit="candidates", low=4, high=100_000
    )
    generations: int = setting(
        10, "Generations between two descents.", unit="generations", low=1, high=1000
    )
    elite: int = setting(24, "Candidates that parent the next generation.", low=1, high=100_000)
    gauss_newton_children: int = setting(
        16, "Candidates of a generation that come again after a Gauss-Newton step.", high=100_000
    )
    max_rounds: int = setting(
        40, "Rounds of an evolution, at most.", unit="rounds", low=1, high=1000
    )
    min_round_gain: float = setting(
        0.5, "A round that lowers the cost by less than this is an idle one.", unit="cost", high=1e6
    )
    patience: int = setting(
        4, "Idle rounds in a row that end an evolution.", unit="rounds", low=1, high=1000
    )
    # Sweeps
    sweep_values: int = setting(
        6, "Values that a sweep tries for each parameter.", unit="values", low=1, high=1000
    )
    sweep_tries: int = setting(
        2,
        "Sweeps without a sufficient gain that end the sweeping.",
        unit="sweeps",
        low=1,
        high=1000,
    )
    min_sweep_gain: float = setting(
        1e-5, "Gain that makes a sweep's result worth taking.", high=1.0
    )
    sweeps: int = setting(
        1,
        "Sweeps of a descent, at most, each with another descent after it.",
        unit="sweeps",
        high=1000,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gauss_newton_children >= self.population:
            raise ValueError(
                f"gauss_newton_children is {self.gauss_newton_children},"
                f" wanted less than the population, which is {self.population}"
            )


DEFAULTS = SearchSettings()
