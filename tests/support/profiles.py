"""Profiles that are parabolas around the middle of an interval."""

from collections.abc import Mapping, Sequence

import numpy as np

from fitting.inference.profiles.profile import Profile, make_profile, usual_rise
from fitting.problem.space import FreeParameter, from_fractions, to_fractions


def parabola(parameter: FreeParameter, interval: tuple[float, float], size: int = 1) -> Profile:
    """The profile with this 95 % interval, as far as the range goes.

    The other parameters, `size - 1` of them, stay where they are.
    """
    low, high = to_fractions(parameter, np.asarray(interval))
    middle = (low + high) / 2
    places = np.concatenate([np.linspace(0.001, 0.999, 200), [low, middle, high]])
    places = np.unique(places[(places > 0) & (places < 1)])
    values = from_fractions(parameter, places)
    distance = (places - middle) / ((high - low) / 2)
    cost = 1.000001 * usual_rise(parameter) * distance**2  # the ends are just outside
    path = np.tile(values[:, None], (1, size))
    return make_profile(parameter, path, values, cost, np.zeros_like(cost))


def parabolas(
    parameters: Sequence[FreeParameter], intervals: Sequence[tuple[float, float]]
) -> Mapping[str, Profile]:
    """One for each parameter, by name."""
    size = len(parameters)
    return {
        parameter.name: parabola(parameter, interval, size)
        for parameter, interval in zip(parameters, intervals, strict=True)
    }
