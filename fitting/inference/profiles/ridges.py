"""Ridges: parameters of which the data determine a combination, and none alone."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from fitting.problem.free_parameters import FreeParameter, scale_width, to_fractions

from .profile import Profile

LONG = 0.15  # fraction of the range that a parameter covers along a ridge, at least
THIN = 0.05  # width of a ridge, as a fraction of its length, at most
SLIGHT = 0.1  # coefficient, as a fraction of the largest, below which a parameter does not belong
LARGEST = 3  # parameters of a ridge


@dataclasses.dataclass(frozen=True)
class Ridge:
    """A combination that is determined: a sum of coefficients times parameters on their scales."""

    names: tuple[str, ...]
    coefficients: tuple[float, ...]
    """Of the values on the parameters' scales; the first is 1."""

    def describe(self, parameters: Mapping[str, FreeParameter]) -> str:
        """The combination in words: a sum, or a product where all scales are logarithmic."""
        terms = list(zip(self.names, self.coefficients, strict=True))
        if all(parameters[name].scale != "linear" for name in self.names):
            powers = [(_factor(parameters[n]), _power(parameters[n], c)) for n, c in terms]
            return _combined(powers, (" × ", " / "), "{name}^{size:.2g}")
        summands = [
            (_logarithm(parameters[n]), c if parameters[n].scale != "gain" else -c)
            for n, c in terms
        ]
        return _combined(summands, (" + ", " - "), "{size:.2g} {name}")


def find_ridges(
    parameters: Sequence[FreeParameter],
    profiles: Mapping[str, Profile],
    undetermined: Sequence[str],
) -> tuple[Ridge, ...]:
    """The ridges among undetermined parameters, of two or three.

    Along a ridge's profiles its parameters move together: the points that the data allow lie in a
    plane or on a line, in the parameters' fractions of their ranges. The direction across it is the
    combination that the data determine.

    Args:
        parameters: all of them, in the order of the paths' columns.
        profiles: by name.
        undetermined: names among which ridges are sought.
    """
    index = {parameter.name: i for i, parameter in enumerate(parameters)}
    found: list[Ridge] = []
    for size in range(2, LARGEST + 1):
        for names in itertools.combinations(undetermined, size):
            if any(set(ridge.names) <= set(names) for ridge in found):
                continue
            columns = [index[name] for name in names]
            chosen = [parameters[i] for i in columns]
            points = np.concatenate([_allowed(profiles[name])[:, columns] for name in names])
            across = _across(np.stack(list(map(to_fractions, chosen, points.T)), axis=1))
            if across is not None:
                coefficients = across / [scale_width(parameter) for parameter in chosen]
                found.append(Ridge(names, tuple(map(float, coefficients / coefficients[0]))))
    return tuple(found)


def _allowed(profile: Profile) -> Float[np.ndarray, "points free"]:
    """The path of a profile where the data allow it."""
    return profile.path[profile.data_rises <= profile.max_rise]


def _across(places: Float[np.ndarray, "points n"]) -> Float[np.ndarray, " n"] | None:
    """The unit vector across points that lie on a thin ridge; None if they do not."""
    if len(places) <= places.shape[1] or (np.ptp(places, axis=0) < LONG).any():
        return None
    centred = places - places.mean(axis=0)
    _, spreads, directions = np.linalg.svd(centred, full_matrices=False)
    across = directions[-1]
    thin = spreads[-1] < THIN * spreads[-2]
    return across if thin and (np.abs(across) > SLIGHT * np.abs(across).max()).all() else None


def _factor(parameter: FreeParameter) -> str:
    return (
        f"half-life of `{parameter.name}`" if parameter.scale == "gain" else f"`{parameter.name}`"
    )


def _power(parameter: FreeParameter, coefficient: float) -> float:
    """On the scale of gains, a longer half-life is a smaller coordinate."""
    return -coefficient if parameter.scale == "gain" else coefficient


def _logarithm(parameter: FreeParameter) -> str:
    factor = _factor(parameter)
    return factor if parameter.scale == "linear" else f"ln({factor})"


def _combined(terms: Sequence[tuple[str, float]], signs: tuple[str, str], term: str) -> str:
    """Names with their coefficients in words, the first of them positive.

    Args:
        terms: names and coefficients.
        signs: between terms, before a positive and before a negative coefficient.
        term: how a `name` and the `size` of its coefficient are written, unless that is 1.
    """
    first = np.sign(terms[0][1])
    words = ""
    for name, coefficient in terms:
        size = abs(coefficient)
        sign = signs[0] if coefficient * first > 0 else signs[1]
        one = np.isclose(size, 1, atol=0.05)
        words += (sign if words else "") + (name if one else term.format(name=name, size=size))
    return words
