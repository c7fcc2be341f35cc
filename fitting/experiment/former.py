"""What files of earlier releases mean now: rules that were merged, gains that became half-lives."""

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fitting.runtime.validation import Content, Table
from jaxik.record.parameters import half_life_of_gain


class FormerRule(NamedTuple):
    """What the name of a rule meant before rules were merged."""

    name: str
    """Of the rule as which it lives on."""
    values: Mapping[str, float]
    """What that rule has other than its defaults."""
    is_meant: Callable[[Any], ArrayLike]
    """Whether a rule of that name already is the former one, whatever its other values."""


FORMER_RULES = {
    "IdleContact": FormerRule(
        "StandingContact", {"idle_speed": 0.0}, lambda rule: np.isfinite(rule.idle_speed)
    ),
    "StandingContact": FormerRule("StandingContact", {}, lambda rule: np.isinf(rule.idle_speed)),
    "NoWarp": FormerRule("StrideWarp", {"max_scale": 1.0, "min_scale": 1.0}, lambda rule: False),
    "ContactTarget": FormerRule(
        "SoleTarget", {"max_slope": 0.0, "foot_height": 0.1}, lambda rule: rule.max_slope == 0
    ),
    "SoleTarget": FormerRule("SoleTarget", {}, lambda rule: rule.max_slope > 0),
    "FoundEffector": FormerRule("DirectEffector", {"if_found": True}, lambda rule: rule.if_found),
    "DirectEffector": FormerRule("DirectEffector", {}, lambda rule: ~rule.if_found),
    "HintLeg": FormerRule("PoleLeg", {"to_hint": True}, lambda rule: rule.to_hint),
    "PoleLeg": FormerRule("PoleLeg", {}, lambda rule: ~rule.to_hint),
}

HALF_LIVES = {  # by the name of the gain per tick that each was
    "pelvis.on_gain": "pelvis.half_life",
    "pelvis.off_gain": "pelvis.airborne_half_life",
    "lean.gain": "lean.half_life",
    "lean.gain_slide": "lean.half_life_slide",
    "lean.slide_on_gain": "lean.slide_on_half_life",
    "lean.slide_off_gain": "lean.slide_off_half_life",
}
TICK_HZ = 30.0  # to which gains refer, unless a file says otherwise
GAINS = {"low": 0.01, "high": 0.95}  # between which gains were fitted, likewise


def parameters_with_half_lives(values: Table, leaves: Collection[str]) -> Content:
    """Values by dotted name, where a system with these leaves has half-lives, s, for gains."""
    rates = {_tick_rate(gain) for gain in HALF_LIVES if _is_gain(gain, leaves)} - {*leaves}
    content: Content = {}
    for name, value in values.items():
        if _is_gain(name, leaves):
            content[HALF_LIVES[name]] = _half_life(value, values.get(_tick_rate(name), TICK_HZ))
        elif name not in rates:
            content[name] = value
    return content


def free_with_half_lives(table: Table, leaves: Collection[str]) -> Content:
    """The same for the bounds in a table [free], which change places."""
    content: Content = {}
    for name, entry in table.items():
        if _is_gain(name, leaves) and isinstance(entry, Mapping):
            bounds = {**GAINS, **entry}
            ends = {"low": _half_life(bounds["high"]), "high": _half_life(bounds["low"])}
            content[HALF_LIVES[name]] = bounds | ends
        else:
            content[name] = entry
    return content


def row_with_half_life(row: Table) -> Table:
    """The same for a fitted parameter: what sampling reads of it; `u` rose with the gain."""
    if row["name"] not in HALF_LIVES or row["unit"] != "1/tick":
        return row
    half_life = {"name": HALF_LIVES[row["name"]], "unit": "s", "value": _half_life(row["value"])}
    return half_life | {name: row[name] for name in ("start_sd", "determined")} | {"u": -row["u"]}


def _is_gain(name: str, leaves: Collection[str]) -> bool:
    """Whether a system with these leaves has a half-life in place of a gain of this name."""
    return name not in leaves and HALF_LIVES.get(name) in leaves


def _tick_rate(gain: str) -> str:
    """The name of the tick rate to which a gain of this name refers."""
    return f"{gain.partition('.')[0]}.tick_hz"


def _half_life(gain: Any, tick_hz: Any = TICK_HZ) -> Any:
    """The half-life, s, of a gain per tick; what is not one stays, for its reader to refuse."""
    are_numbers = {type(gain), type(tick_hz)} <= {int, float}
    if are_numbers and math.isfinite(gain) and tick_hz > 0:
        return half_life_of_gain(gain, tick_hz)
    return gain
