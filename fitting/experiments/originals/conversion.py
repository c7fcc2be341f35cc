"""Parameters as settings of an original, and settings as parameters."""

import warnings
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

import jaxik
from fitting.experiments.systems import changed_rules, with_parameters
from fitting.runtime.validation import check_keys
from jaxik.maths import parameter_tree

from .layout import ORIGINALS, SWITCH, Original, Setting

Value: TypeAlias = bool | int | float | Sequence
"""Of a setting: a sequence for a vector, or where legs differ."""
RTOL, ATOL = 1e-6, 1e-9  # within which values are the same


def original_of(name: str) -> Original:
    """The original with this name; ValueError if there is none."""
    if name not in ORIGINALS:
        raise ValueError(f"no settings of {name!r}; there are those of {list(ORIGINALS)}")
    return ORIGINALS[name]


def to_settings(ik: jaxik.FootIK, name: str, *, drop: bool = False) -> dict[str, Value]:
    """The settings of an original with which it does what a system does.

    Args:
        ik: the system.
        name: of the original.
        drop: whether to leave out, with a warning, what the original has no setting for.

    Raises:
        ValueError: there is no such original; the system has other rules than it, or values that it
            has no setting for, and they are not to be left out; two parameters that are one setting
            differ, or a parameter differs between legs where it may not.
    """
    original = original_of(name)
    if lost := dropped(ik, original):
        listed = ", ".join(f"{what} = {ours} ({its})" for what, (ours, its) in lost.items())
        message = f"{name} has no setting for {listed}; it has what stands in brackets"
        if not drop:
            raise ValueError(f"{message}. To leave them out nevertheless: --drop, or drop=True")
        warnings.warn(message, stacklevel=2)
    known = {slot.name for slot in parameter_tree.slots(ik)}
    assumed = original.preset.system()
    return {
        setting.name: _value(ik if set(setting.ours) <= known else assumed, setting, original)
        for setting in original.settings
    }


def to_ik(values: Mapping[str, Value], name: str) -> jaxik.FootIK:
    """The system of an original with these settings; what is left out has its default.

    Raises:
        ValueError: there is no such original or setting, or a value has the wrong type or shape.
    """
    original = original_of(name)
    check_keys(values, [setting.name for setting in original.settings], f"settings of {name}")
    ik = original.preset.system()
    parameters = {}
    for setting in original.settings:
        if setting.name in values:
            value = _checked(ik, setting, values[setting.name], original)
            parameters |= dict.fromkeys(setting.ours, value)
    return with_parameters(ik, parameters, f"settings of {name}")


def dropped(ik: jaxik.FootIK, original: Original) -> dict[str, tuple[str, str]]:
    """Rules, parameters and options that an original does not have: as they are, and as it is."""
    assumed = original.preset.system()
    rules = changed_rules(ik, assumed)
    lost = {
        f"rules.{stage}": (rule, type(getattr(assumed, stage)).__name__)
        for stage, rule in rules.items()
    }
    no_effect = (*original.has_no_effect(ik), *(f"{stage}." for stage in rules))
    for leaf in parameter_tree.docs(ik):
        if leaf in original.parameters or leaf.startswith(no_effect):
            continue
        if not _is_same(ik, assumed, leaf):
            lost[leaf] = (parameter_tree.shown(ik, leaf), parameter_tree.shown(assumed, leaf))
    return lost


def _is_same(ik: jaxik.FootIK, other: jaxik.FootIK, leaf: str) -> bool:
    """Whether a parameter or option is the same in two systems."""
    values, others = (np.asarray(parameter_tree.get(tree, leaf)) for tree in (ik, other))
    return bool(np.allclose(values, others, rtol=RTOL, atol=ATOL))


def _value(ik: jaxik.FootIK, setting: Setting, original: Original) -> Value:
    """The value of a setting, in its unit; one for all legs where they share it."""
    of_each = [np.asarray(parameter_tree.get(ik, leaf)) for leaf in setting.ours]
    if any(not np.allclose(value, of_each[0], rtol=RTOL, atol=ATOL) for value in of_each[1:]):
        shown = ", ".join(f"{leaf} = {parameter_tree.shown(ik, leaf)}" for leaf in setting.ours)
        raise ValueError(f"{setting.name} is one setting, but {shown}; make them equal")
    value, single = of_each[0], _shape(ik, setting)
    if value.shape != single:
        if np.all(value == value[:1]):
            value = value[0]
        elif not original.per_leg:
            raise ValueError(
                f"{setting.ours[0]} is {value.tolist()}; {setting.name} is one for all legs"
            )
    if setting.unit == SWITCH:
        return value.tolist()
    if not np.isfinite(value).all():
        raise ValueError(f"{setting.ours[0]} is {value.tolist()}; {setting.name} is finite")
    return (value.astype(np.float64) * np.asarray(setting.unit.factor)).tolist()


def _checked(ik: jaxik.FootIK, setting: Setting, value: Value, original: Original) -> np.ndarray:
    """The value of a setting, in our unit."""
    single = _shape(ik, setting)
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        array = np.asarray(None)
    is_switch = setting.unit == SWITCH
    if array.dtype.kind not in ("b" if is_switch else "iuf"):
        wanted = "true or false" if is_switch else "a number"
        raise ValueError(f"{setting.name} is {value!r}; wanted {wanted}")
    if array.shape != single and not (original.per_leg and array.shape[1:] == single):
        raise ValueError(f"{setting.name} has shape {array.shape}; wanted {single}")
    return array if is_switch else array / np.asarray(setting.unit.factor)


def _shape(ik: jaxik.FootIK, setting: Setting) -> tuple[int, ...]:
    """Of one value for all legs."""
    return next(slot.shape for slot in parameter_tree.slots(ik) if slot.name == setting.ours[0])
