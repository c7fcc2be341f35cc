"""How thoroughly a search looks: the numbers that its stages share."""

import dataclasses

from fitting.inference.settings import Settings, setting


@dataclasses.dataclass(frozen=True)
class SearchSettings(Settings):
    """Settings of `search.find_best_fit`.

    Spreads are standard deviations of `u`, gains are relative falls of the cost.

    Raises:
        ValueError: for a setting out of its range.
    """

    max_steps: int = setting(
        1000, "Levenberg–Marquardt steps allowed for each start.", unit="steps", low=1
    )
    start_spread: float = setting(
        0.5, "Spread of the random starting points, in prior standard deviations."
    )
    # Levenberg–Marquardt
    descent_steps: int = setting(
        8, "Steps of a descent, between two changes of the thresholds.", unit="steps", low=1
    )
    min_step_gain: float = setting(
        1e-6, "A step that lowers the cost by less than this is a small one."
    )
    max_small_steps: int = setting(
        2, "Small steps in a row that end a descent.", unit="steps", low=1
    )
    max_rejected_steps: int = setting(
        5,
        "Rejected steps in a row that end a descent; each shrinks the step to a quarter.",
        unit="steps",
        low=1,
    )
    polish_max_rejected_steps: int = setting(
        12, "Rejected steps in a row that end the last descent of a start.", unit="steps", low=1
    )
    # Population
    population: int = setting(64, "Candidates in a generation.", unit="candidates", low=4)
    generations: int = setting(5, "Generations bred in a round.", unit="generations", low=1)
    elite: int = setting(8, "Candidates that parent the next generation.", low=1)
    gauss_newton_children: int = setting(
        16, "Candidates of a generation that come again after a Gauss-Newton step."
    )
    shift_probability: float = setting(
        0.3,
        "Probability that a child shifts a threshold; on average it shifts at least one.",
        high=1,
    )
    generation_decay: float = setting(
        0.6, "Factor on the spread of the shifts from one generation to the next.", high=1
    )
    redrawn_one_in: int = setting(
        3, "One child in so many has one parameter drawn anew from its range.", low=1
    )
    # Block search: population and descents in turn
    block_rounds: int = setting(5, "Rounds of a block search, at most.", unit="rounds", low=1)
    block_sweeps: int = setting(2, "Sweeps before the first round, at most.", unit="sweeps")
    block_spread: float = setting(1.2, "Spread of the shifts in the first round.", unit="u")
    block_spread_after_ensemble: float = setting(
        0.4, "The same for the block search that follows the ensemble.", unit="u"
    )
    round_decay: float = setting(0.7, "Factor on the spread from one round to the next.", high=1)
    min_round_gain: float = setting(
        1e-4, "From the third round on, a round that gains less than this is the last."
    )
    # Ensemble
    ensemble_pairs: int = setting(
        16, "Antithetic pairs of threshold shifts in the ensemble.", unit="pairs", low=1
    )
    ensemble_spreads: tuple[float, ...] = setting(
        (0.8, 0.4, 0.2, 0.1), "Spreads of these shifts, one descent after another.", unit="u"
    )
    max_disagreement: float = setting(
        1e-3, "Two block searches whose costs differ by more than this call for a third."
    )
    # Sweeps
    sweep_values: int = setting(
        6, "Values that a sweep tries for each parameter.", unit="values", low=1
    )
    sweep_tries: int = setting(
        2, "Sweeps without a sufficient gain that end the sweeping.", unit="sweeps", low=1
    )
    min_sweep_gain: float = setting(1e-5, "Gain that makes a sweep's result worth taking.")
    final_sweeps: int = setting(
        8, "Sweeps before the last descent of a start, at most.", unit="sweeps"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gauss_newton_children >= self.population:
            raise ValueError(
                f"gauss_newton_children is {self.gauss_newton_children},"
                f" wanted less than the population, which is {self.population}"
            )


DEFAULTS = SearchSettings()
