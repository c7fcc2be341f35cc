"""Parameters as settings of an original, and settings as parameters.

The settings of each original: their names, units, and the parameters that they are.

Names are spelled as where they are set: members of ozz's sample (constants of its source among
them), variables of Unreal's character in C++, and fields of Mec's inspector in Unity.

Tables of settings as files: TOML, JSON and CSV.

TOML and JSON have the name of the original, the settings, and their units where they have one:

system = "unreal"
[settings]
m_IKTraceDistance = 50.0
[units]
m_IKTraceDistance = "cm"

CSV has a row for each setting, with the columns system, setting, value and unit.
"""

import contextlib
import csv
import io
import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import tomli_w

import jaxik
from fitting.runtime import validation
from fitting.runtime.declarations import NEEDED, key, read
from fitting.runtime.validation import Content, check_keys
from jaxik.maths import parameter_tree

from .systems import Preset, changed_rules, with_parameters

Value: TypeAlias = bool | int | float | Sequence
"""Of a setting: a sequence for a vector, or where legs differ."""
RTOL, ATOL = 1e-6, 1e-9  # within which values are the same


COLUMNS = ["system", "setting", "value", "unit"]
SUFFIXES = (".toml", ".json", ".csv")


@dataclass(frozen=True)
class SettingsFile:
    """Settings of an original, as a file has them."""

    system: str = key(NEEDED, "The original.")
    settings: Mapping[str, Any] = key(NEEDED, "By the names of the original.")
    units: Mapping[str, str] = key({}, "Of those settings that have one.")


class Unit(NamedTuple):
    """A unit of a setting."""

    name: str
    """Empty for switches."""
    factor: float | tuple[float, float, float] = 1.0
    """Of ours: how many of it are one of ours, for each component of a vector."""


METRES, CENTIMETRES = Unit("m"), Unit("cm", 100.0)
DEGREES, SECONDS, RATE = Unit("deg", 180.0 / math.pi), Unit("s"), Unit("1/s")
PLAIN, SWITCH = Unit("1"), Unit("")
TO_THE_RIGHT = Unit("m", (-1.0, 1.0, 1.0))  # Unity's x; ours is to the left


class Setting(NamedTuple):
    """A setting of an original, and its parameters here."""

    name: str
    ours: tuple[str, ...]
    """The parameters that it is; where there are two, they have the same value."""
    unit: Unit


class Original(NamedTuple):
    """A system elsewhere."""

    preset: Preset
    settings: tuple[Setting, ...]
    per_leg: bool
    """Whether feet have settings of their own."""
    has_no_effect: Callable[[jaxik.FootIK], tuple[str, ...]]
    """Names, or their beginnings, of parameters that change nothing in a system."""

    @property
    def parameters(self) -> frozenset[str]:
        """Our names of all that the settings hold."""
        return frozenset(name for setting in self.settings for name in setting.ours)


LIMITS = ("probe.max_step_up", "probe.max_step_down", "probe.max_slope", "probe.step_fade")
SUPPORT = ("probe.min_support", "probe.support_radius")
ROOT = ("root.ray_", "root.layers", "root.half_life", "root.max_")
SMOOTH_ROOT = ("root.max_speed", "root.max_step", "root.max_gap")


def _is_on(ik: jaxik.FootIK, name: str) -> bool:
    return bool(np.any(np.asarray(parameter_tree.get(ik, name))))


def _off(ik: jaxik.FootIK) -> tuple[str, ...]:
    """Parameters of something that is switched off, or that no original has."""
    options = parameter_tree.options(ik)
    names = ("warp.",)  # of `Frame.stride_scale`
    names += () if options.get("probe.limited") else LIMITS
    names += () if options.get("probe.check_support") else SUPPORT
    names += () if options.get("leg.allow_stretch") else ("leg.max_stretch",)
    names += () if options.get("probe.simple_in_flight") else ("probe.flight_layers",)
    names += () if options.get("foot.bend_toes") else ("foot.toe_length", "foot.max_toe_")
    if not _is_on(ik, "root.enabled"):
        return names + ROOT
    return names + (() if _is_on(ik, "root.half_life") else SMOOTH_ROOT)


def _off_in_ozz(ik: jaxik.FootIK) -> tuple[str, ...]:
    others = ("probe.use_toe", "probe.toe_ls", "pelvis.vertical_only", "pelvis.wait_to_rise")
    return (*_off(ik), *others, "pelvis.airborne_half_life", "leg.hint_offset")


def _off_in_mec(ik: jaxik.FootIK) -> tuple[str, ...]:
    by_speed = _is_on(ik, "probe.by_speed")
    return _off(ik) if by_speed else (*_off(ik), "probe.stable_speed")


ORIGINALS = {
    "ozz": Original(
        Preset("ozz", faithful=True),
        (
            Setting("foot_heigh_", ("target.foot_height",), METRES),  # its own spelling
            Setting("weight_", ("leg.weight", "foot.weight"), PLAIN),
            Setting("soften_", ("leg.soften",), PLAIN),
            Setting("auto_character_height_", ("root.enabled",), SWITCH),
            Setting("pelvis_correction_", ("pelvis.enabled",), SWITCH),
            Setting("two_bone_ik_", ("leg.enabled",), SWITCH),
            Setting("aim_ik_", ("foot.enabled",), SWITCH),
            Setting("kCharacterRayHeightOffset.y", ("root.ray_up",), METRES),
            Setting("kFootRayHeightOffset.y", ("probe.ray_up",), METRES),
        ),
        per_leg=False,
        has_no_effect=_off_in_ozz,
    ),
    "unreal": Original(
        Preset("unreal", faithful=True),
        (
            Setting("m_IKCapsuleHalfHeight", ("pelvis.half_height", "probe.ray_up"), CENTIMETRES),
            Setting("m_IKTraceDistance", ("probe.ray_down",), CENTIMETRES),
            Setting("m_IKAdjustFootOffset", ("target.adjust",), CENTIMETRES),
            Setting("m_IKInterpSpeed", ("effector.speed",), RATE),
            Setting("m_IKHipInterpSpeed", ("pelvis.speed",), RATE),
        ),
        per_leg=False,
        has_no_effect=_off,
    ),
    "mec": Original(
        Preset("mec", faithful=True),
        (
            Setting("Plant Foot", ("lock.plant",), SWITCH),
            Setting("IK Hint Offset", ("leg.hint_offset",), TO_THE_RIGHT),
            Setting("Foot Offset Dist", ("probe.ray_up",), METRES),
            Setting("Foot Length", ("probe.foot_length",), METRES),
            Setting("Foot Half Width", ("probe.half_width",), METRES),
            Setting("Foot Height", ("target.foot_height",), METRES),
            Setting("Foot Rotation Limit", ("foot.max_tilt",), DEGREES),
            Setting("Transition Time", ("effector.transition_time",), SECONDS),
            Setting("Extra Ray Distance Check", ("probe.extra",), METRES),
            Setting("Set Extra Ray Distance Check Automatically", ("probe.by_height",), SWITCH),
            Setting("Foot Distance from Ground Threshold", ("probe.stable_height",), METRES),
            Setting("Extra Ray Distance Check Min", ("probe.extra_min",), METRES),
            Setting("Extra Ray Distance Check Max", ("probe.extra_max",), METRES),
            Setting("Adjust Pelvis Vertically", ("pelvis.enabled",), SWITCH),
            Setting("Damp Pelvis", ("pelvis.damp",), SWITCH),
            Setting("Max Leg Length", ("pelvis.max_length",), METRES),
            Setting("Min Leg Length", ("pelvis.min_length",), METRES),
            Setting("Pelvis Adjustment Speed", ("pelvis.speed",), RATE),
            Setting("SetActive", ("probe.active",), SWITCH),  # here and below, functions
            Setting("SetPlantBlendWeight", ("lock.plant_weight",), PLAIN),
        ),
        per_leg=True,
        has_no_effect=_off_in_mec,
    ),
}


def original_of(name: str) -> Original:
    """The original with this name; ValueError if there is none."""
    if name not in ORIGINALS:
        raise ValueError(f"no settings of {name!r}; there are those of {list(ORIGINALS)}")
    return ORIGINALS[name]


def to_settings(ik: jaxik.FootIK, name: str, *, drop: bool = False) -> dict[str, Value]:
    """The settings with which an original does the same as a system.

    Args:
        ik: the system.
        name: of the original.
        drop: whether to leave out, with a warning, parameters without a setting.

    Raises:
        ValueError: there is no such original; the system has other rules than it, or values that it
            has no setting for, unless they are dropped; two parameters that are one setting
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
    """The system of an original with these settings; others have their defaults.

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
        values = ", ".join(f"{leaf} = {parameter_tree.shown(ik, leaf)}" for leaf in setting.ours)
        raise ValueError(f"{setting.name} is one setting, but {values}; make them equal")
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


def settings_text(values: Mapping[str, Value], name: str, suffix: str) -> str:
    """A table of settings of the original `name`, for a file with one of `SUFFIXES`."""
    units = {setting.name: setting.unit.name for setting in original_of(name).settings}
    if suffix == ".csv":
        out = io.StringIO()
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(COLUMNS)
        rows.writerows([name, key, json.dumps(value), units[key]] for key, value in values.items())
        return out.getvalue()
    named = {key: unit for key, unit in units.items() if unit not in ("", "1")}
    content = {"system": name, "settings": dict(values), "units": named}
    return json.dumps(content, indent=1) + "\n" if suffix == ".json" else tomli_w.dumps(content)


def has_settings(path: Path) -> bool:
    """Whether a file looks like a table of settings rather than anything else."""
    if validation.why_unreadable(path) or path.suffix.lower() not in SUFFIXES:
        return False
    with contextlib.suppress(ValueError):
        return "settings" in _read(path)
    return False


def load_settings(path: Path) -> tuple[jaxik.FootIK, str]:
    """The system in a table of settings, and the name of its original.

    Raises:
        ValueError: the file does not exist or is not such a table; a setting is unknown, has
            another unit than the original's, or a value that it cannot have.
    """
    if reason := validation.why_unreadable(path):
        raise ValueError(f"{path}: {reason}, wanted a table of settings")
    with validation.error_context(path):
        content = _read(path)
        table = read(content, SettingsFile, "a table of settings")
        name = table.system
        own = {setting.name: setting.unit.name for setting in original_of(name).settings}
        for setting, unit in table.units.items():
            if unit != own.get(setting, unit):
                raise ValueError(f"{setting} is in {unit!r}; {name} has it in {own[setting]!r}")
        return to_ik(table.settings, name), name


def _read(path: Path) -> Content:
    if path.suffix.lower() == ".toml":
        return validation.read_toml(path, "a settings")
    if path.suffix.lower() == ".json":
        content = validation.read_json(path)
        return content if isinstance(content, dict) else {}
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    except csv.Error as error:
        raise ValueError(f"not a table of settings: {error}") from None
    if not rows or rows[0] != COLUMNS or any(len(row) != len(COLUMNS) for row in rows):
        raise ValueError(f"not a table of settings; wanted the columns {COLUMNS}")
    if len(systems := {row[0] for row in rows[1:]}) != 1:
        raise ValueError(f"settings of {sorted(systems)}; wanted those of one system")
    try:
        settings = {name: json.loads(value) for _, name, value, _ in rows[1:]}
    except RecursionError:
        raise ValueError("not a table of settings: a value is nested too deeply") from None
    units = {name: unit for _, name, _, unit in rows[1:]}
    return {"system": systems.pop(), "settings": settings, "units": units}
