"""Ablations: an experiment with something left out, as each of its [[without]] tables says.

[[without]]
name = "support"
rules = { pelvis = "LowestPelvis" }     # other rules, by stage
parameters = { lock.enabled = false }   # fixed at these values, even if they are free otherwise
free = { pelvis.limit = {} }            # fitted in addition
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import jaxik
from fitting.inference.sensitivity import FreeTable
from fitting.runtime import validation

from .systems import leaf_names, read_free_table, rule_names, with_parameters, with_rules

COMPLETE = "all rules"  # the name of the experiment with nothing left out


@dataclass(frozen=True)
class Ablation:
    """What differs from the experiment, under a name."""

    name: str
    rules: Mapping[str, str] = field(default_factory=dict)
    """By stage."""
    parameters: Mapping[str, object] = field(default_factory=dict)
    """By dotted name."""
    free: FreeTable = field(default_factory=dict)
    """By dotted name."""


KEYS = {
    "name": validation.TEXT.meaning("What is left out. Needed."),
    "rules": validation.TABLE.meaning("Other rules, by stage."),
    "parameters": validation.TABLE.meaning("Fixed at these values, even if they are free else."),
    "free": validation.TABLE.meaning("Fitted in addition."),
}


def read_ablations(tables: Sequence[object], ik: jaxik.FootIK, where: str) -> tuple[Ablation, ...]:
    """The ablations in TOML tables.

    Args:
        tables: the tables.
        ik: the system from which they differ.
        where: the tables' place in their file, for error messages.

    Raises:
        ValueError: a key, stage, rule or parameter is unknown; a value is wrong; a name is missing,
            empty or taken; an ablation changes nothing.
    """
    ablations: list[Ablation] = []
    for table in tables:
        ablation = _read(validation.check_table(table, KEYS, where), ik, where)
        if ablation.name in (COMPLETE, *(earlier.name for earlier in ablations)):
            raise ValueError(f"{where}: there already is a variant named {ablation.name!r}")
        ablations.append(ablation)
    return tuple(ablations)


def _read(table: validation.Table, ik: jaxik.FootIK, where: str) -> Ablation:
    name = table.get("name", "")
    if not name.strip():
        raise ValueError(f"{where}: a variant without a name; wanted name = 'what is left out'")
    parameters = validation.flatten(table.get("parameters", {}), 2)
    free = read_free_table(table.get("free", {}), f"{where} {name}: free")
    rules = dict(table.get("rules", {}))
    changed = with_rules(ik, rules, f"{where} {name}: rules")
    with_parameters(changed, parameters, f"{where} {name}: parameters")
    leaves = {full.partition("[")[0]: None for full in free}  # one leg's element has an index
    validation.check_keys(leaves, leaf_names(changed), f"{where} {name}: free")
    if not parameters and not free and rule_names(changed) == rule_names(ik):
        raise ValueError(f"{where} {name}: changes nothing; wanted other rules or parameters")
    return Ablation(name, rules, parameters, free)
