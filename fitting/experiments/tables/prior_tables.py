"""The tables [prior] and [start] of an experiment file: what is known before any clip.

[prior]                              # of every free parameter that has no table of its own
shape = "normal"                     # or "uniform": anywhere in the range
spread = 1.6                         # standard deviation, of u
[prior.pelvis]
on_gain = { centre = 0.3, spread = 1.0 }  # median, in the parameter's unit
limit = { shape = "uniform" }
[start]                              # where the search begins, in the parameters' units
pelvis.on_gain = 0.5
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import get_args

from fitting.problem.prior import SPREADS, ParameterPrior, Priors, Shape
from fitting.runtime import validation
from fitting.runtime.validation import (
    Content,
    Table,
    check_keys,
    check_table,
    flatten,
    nest,
    with_floats,
)

DEFAULT_KEYS: dict[str, validation.Constraint] = {
    "shape": validation.one_of(get_args(Shape)).meaning(
        "Distribution of u, the free parameter on its scale; a uniform one has no centre and no"
        " spread."
    ),
    "spread": validation.number(*SPREADS).meaning("Standard deviation of u."),
}
CENTRE = validation.NUMBER.meaning("Median, in the parameter's unit; left out, the system's value.")
KEYS = {**DEFAULT_KEYS, "centre": CENTRE}


def read_priors(table: Table, free: Collection[str], where: str) -> Priors:
    """The priors in a [prior] table.

    A parameter without a shape or a spread of its own has the table's.

    Args:
        table: as TOML reads it.
        free: names of all parameters that may have a prior.
        where: the table's place in its file, for error messages.

    Raises:
        ValueError: a key is no key of the table and no free parameter, or a value is wrong.
    """
    entries = flatten(table, 2)
    check_keys(entries, [*DEFAULT_KEYS, *free], where)
    default = {key: entries.pop(key) for key in DEFAULT_KEYS if key in entries}
    check_table(default, DEFAULT_KEYS, where)
    named = {}
    for name, entry in entries.items():
        given = check_table(entry, KEYS, f"{where} {name}")
        normal = given.get("shape", default.get("shape")) != "uniform"
        inherited = default if normal else {"shape": "uniform"}
        with validation.error_context(f"{where} {name}"):
            named[name] = ParameterPrior(**with_floats({**inherited, **given}, KEYS))
    with validation.error_context(where):
        return Priors(ParameterPrior(**with_floats(default, KEYS)), named)


def priors_to_table(priors: Priors) -> Content:
    """The [prior] table; empty for the default."""
    if priors == Priors():
        return {}
    tables = {name: _changed(prior) for name, prior in priors.named.items()}
    return {**_changed(priors.default), **nest(tables)}


def _changed(prior: ParameterPrior) -> Content:
    return {key: value for key, value in dataclasses.asdict(prior).items() if value is not None}


def read_start(table: Table, free: Collection[str], where: str) -> Mapping[str, float]:
    """The values in a [start] table by dotted name; arguments as `read_priors`.

    Raises:
        ValueError: a name is not free, or a value is no number.
    """
    values = flatten(table, 2)
    check_table(values, dict.fromkeys(free, validation.NUMBER), where)
    return with_floats(values, values)
