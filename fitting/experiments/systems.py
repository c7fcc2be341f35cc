"""Systems by name: presets, other rules for some of their stages, parameters fixed or free."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import numpy as np

import jaxik
from fitting.runtime import validation
from fitting.runtime.validation import check_keys, check_table, flatten
from jaxik import presets
from jaxik.maths import parameter_tree


def _rules_under(stage: type[eqx.Module]) -> list[type[eqx.Module]]:
    """The classes under a stage that nothing is left to be said of."""
    children = [child for child in stage.__subclasses__() if child.__module__.startswith("jaxik.")]
    return [made for child in children for made in _rules_under(child)] or [stage]


STAGES: dict[str, dict[str, type[eqx.Module]]] = {  # the rules that each stage may have, by name
    one.name: {made.__name__: made for made in _rules_under(one.type)}  # type: ignore[arg-type]
    for one in fields(jaxik.FootIK)
}

FREE: dict[str, validation.Constraint] = dict.fromkeys(
    ("low", "high", "prior_mean"), validation.NUMBER
)
FREE |= {"prior_sd": validation.POSITIVE, "kind": validation.TEXT, "scale": validation.TEXT}


def name_preset(name: object) -> jaxik.FootIK:
    """The preset of this name; ValueError with the list of names."""
    known = sorted(n for n, made in vars(presets).items() if _makes_ik(made))
    if name not in known:
        raise ValueError(f"no preset named {name!r}; there are {known}")
    return getattr(presets, str(name))()


def _makes_ik(made: Any) -> bool:
    return getattr(made, "__module__", "") == presets.__name__ and callable(made)


def rules_of(ik: jaxik.FootIK) -> dict[str, str]:
    """The name of the rule at each stage."""
    return {stage: type(part).__name__ for stage, part in vars(ik).items()}


def with_rules(ik: jaxik.FootIK, names: Mapping[str, Any], where: str) -> jaxik.FootIK:
    """The system with the rules of these names at these stages.

    A rule that the system has already keeps its values; another one comes with its defaults.

    Args:
        ik: the system.
        names: of rules, by stage.
        where: the names stand, for the error.

    Raises:
        ValueError: for an unknown stage, or a rule that the stage does not have.
    """
    check_keys(names, list(STAGES), where)
    present = rules_of(ik)
    for stage, name in names.items():
        if name not in list(STAGES[stage]):
            known = list(STAGES[stage])
            raise ValueError(f"{where}: {stage} has no rule {name!r}; it has {known}")
    other = {stage: name for stage, name in names.items() if name != present[stage]}
    return replace(ik, **{stage: STAGES[stage][name]() for stage, name in other.items()})


def exchanged(ik: jaxik.FootIK, preset: jaxik.FootIK) -> dict[str, str]:
    """The rules of a system by stage, where they are others than its preset's."""
    there = rules_of(preset)
    return {stage: name for stage, name in rules_of(ik).items() if name != there[stage]}


def with_parameters(ik: jaxik.FootIK, values: Mapping[str, Any], where: str) -> jaxik.FootIK:
    """The system with these values by dotted name, switches too; ValueError for a wrong one."""
    leaves = leaf_names(ik)
    check_keys(values, leaves, where)
    for name, value in values.items():
        old = parameter_tree.get(ik, name)
        try:
            new = np.asarray(value)
        except ValueError:  # lists of unlike lengths
            new = np.asarray(None)
        if new.dtype.kind not in ("b" if old.dtype == bool else "if") or np.isnan(new).any():
            kind = "true or false" if old.dtype == bool else "a number"
            raise ValueError(f"{where}: {name} is {value!r}; wanted {kind}")
        if new.shape != old.shape and (old.ndim, new.ndim, new.size > 0) != (0, 1, True):
            raise ValueError(f"{where}: {name} has shape {new.shape}; wanted {old.shape}")
    return parameter_tree.replace(ik, dict(values))


def leaf_names(ik: jaxik.FootIK) -> list[str]:
    """Dotted names of all parameters, conventions and switches of a system."""
    return [f"{stage}.{one.name}" for stage, part in vars(ik).items() for one in fields(part)]


def free_table(given: Mapping[str, Any], where: str) -> dict[str, Mapping[str, Any]]:
    """What a [free] table says of each parameter, by dotted name."""
    named = flatten(given, 2)
    return {name: check_table(one, FREE, f"{where} {name}") for name, one in named.items()}
