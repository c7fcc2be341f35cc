"""Two ways to move thresholds, which have no derivative. Each finds what the other misses.

`search_blocks` takes turns: a population moves the thresholds, a descent the smooth parameters.
`descend_ensembles` follows the mean residuals over random shifts of the thresholds, which do have
a derivative; the shifts shrink from one descent to the next.
"""

import dataclasses

import numpy as np

from .descent import descend, descend_ensemble
from .population import breed
from .state import Search, SearchState
from .sweep import sweep_and_descend


def search_thresholds(search: Search, state: SearchState) -> SearchState:
    """The better end of both ways; where they end far apart, a third search starts there."""
    settings = search.settings
    first = search_blocks(search, state, settings.block_spread)
    second = descend_ensembles(search, dataclasses.replace(first, point=state.point))
    second = search_blocks(search, second, settings.block_spread_after_ensemble)
    worse, better = first.point, second.point
    if worse.cost <= better.cost:
        worse, better = better, worse
    state = dataclasses.replace(second, point=better)
    if worse.cost - better.cost > settings.max_disagreement * better.cost:
        state = search_blocks(search, state, settings.block_spread)
    return state


def search_blocks(search: Search, state: SearchState, spread: float) -> SearchState:
    """Rounds of a population for the thresholds and a descent for the smooth parameters.

    Args:
        search: the problem and the settings.
        state: where it begins.
        spread: standard deviation of the threshold shifts in the first round, in `u`.
    """
    settings = search.settings
    state = descend(search, state, "blocks")
    state = sweep_and_descend(search, state, settings.block_sweeps)
    state = descend(search, state, "blocks")
    for number in range(settings.block_rounds):
        before = state.point.cost
        state = breed(search, state, spread * settings.round_decay**number)
        state = descend(search, state, "blocks")
        if number > 1 and before - state.point.cost < settings.min_round_gain * before:
            break
    return state


def descend_ensembles(search: Search, state: SearchState) -> SearchState:
    """Descents on the mean residuals over ensembles of shifted thresholds, each less spread."""
    settings, thresholds = search.settings, search.thresholds
    random = state.generator()
    draws = np.zeros((settings.ensemble_pairs, thresholds.size))
    draws[:, thresholds] = random.normal(size=(settings.ensemble_pairs, int(thresholds.sum())))
    pairs = np.stack([draws, -draws], axis=1).reshape(2 * len(draws), thresholds.size)
    state = dataclasses.replace(state, random=random)
    for spread in settings.ensemble_spreads:
        state = descend_ensemble(search, state, search.array(spread * pairs))
    return state
