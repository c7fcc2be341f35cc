"""Variants of an experiment, each without something that it has: what its `[[without]]` says.

[[without]]
name = "support"
rules = { pelvis = "LowestPelvis" }     # other rules, by stage
parameters = { lock.enabled = false }   # fixed at these values, also if they are free
free = { pelvis.limit = {} }            # fitted in addition
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jaxik
from fitting.runtime import validation

from .systems import free_table, leaf_names, rules_of, with_parameters, with_rules

WHOLE = "all rules"  # the name of the experiment as it is


@dataclass(frozen=True)
class Variant:
    """What is otherwise, under a name."""

    name: str
    rules: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)  # by dotted name
    free: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # likewise


KINDS = {"name": validation.TEXT} | dict.fromkeys(("rules", "parameters", "free"), validation.TABLE)


def read_variants(given: Sequence[Any], ik: jaxik.FootIK, where: str) -> tuple[Variant, ...]:
    """The variants in tables of TOML.

    Args:
        given: the tables.
        ik: the system from which they differ.
        where: they stand, for the error.

    Raises:
        ValueError: for an unknown key, stage, rule or parameter, a wrong value, a name that is
            missing, empty or taken, a variant that changes nothing.
    """
    made: list[Variant] = []
    for table in given:
        made.append(_read(validation.check_table(table, KINDS, where), ik, where))
        names = [WHOLE, *(one.name for one in made)]
        if names[-1] in names[:-1]:
            raise ValueError(f"{where}: there already is a variant named {names[-1]!r}")
    return tuple(made)


def _read(table: Mapping[str, Any], ik: jaxik.FootIK, where: str) -> Variant:
    name = table.get("name", "")
    if not name.strip():
        raise ValueError(f"{where}: a variant without a name; wanted name = 'what is left out'")
    parameters = validation.flatten(table.get("parameters", {}), 2)
    free = free_table(table.get("free", {}), f"{where} {name}: free")
    variant = Variant(name, dict(table.get("rules", {})), parameters, free)
    other = with_rules(ik, variant.rules, f"{where} {name}: rules")
    with_parameters(other, parameters, f"{where} {name}: parameters")
    leaves = {one.partition("[")[0]: None for one in free}  # a leg's own element has its index
    validation.check_keys(leaves, leaf_names(other), f"{where} {name}: free")
    if not parameters and not free and rules_of(other) == rules_of(ik):
        raise ValueError(f"{where} {name}: nothing is otherwise; wanted other rules or parameters")
    return variant
