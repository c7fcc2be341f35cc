"""Systems by name: presets, other rules for some stages, parameters fixed or free."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from inspect import signature
from typing import Literal, NamedTuple, TypeVar

import equinox as eqx
import numpy as np

import jaxik
from fitting.clips.clip import Clip
from fitting.inference.sensitivity import FreeTable
from fitting.problem.space import Override
from fitting.runtime import activity
from fitting.runtime.declarations import check_table, keys
from fitting.runtime.validation import Content, Table, check_keys, flatten
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.world import body
from jaxik.world.arguments import LAYERS

from .former import FORMER_RULES, FormerRule, free_with_half_lives, parameters_with_half_lives


def _concrete_rules(rule: type[eqx.Module]) -> list[type[eqx.Module]]:
    """All subclasses of an abstract rule that have no subclasses themselves."""
    children = [child for child in rule.__subclasses__() if child.__module__.startswith("jaxik.")]
    return [leaf for child in children for leaf in _concrete_rules(child)] or [rule]


STAGES: dict[str, dict[str, type[eqx.Module]]] = {  # the rules to choose from, by stage and name
    stage.name: {rule.__name__: rule for rule in _concrete_rules(stage.type)}  # type: ignore[arg-type]
    for stage in fields(jaxik.FootIK)
}


OWN_ROOT = "root.enabled"  # set by an experiment only to overrule where clips put the root

Rule = TypeVar("Rule", bound=eqx.Module)


def register_rule(rule: type[Rule]) -> type[Rule]:
    """Makes a rule of your own known by its name to experiments and parameter files.

    Call it, or put `@register_rule` above the class, before a file that names the rule is read.

    Returns:
        The rule itself.

    Raises:
        ValueError: a class that derives from no stage's abstract rule.
    """
    for stage in fields(jaxik.FootIK):
        if isinstance(stage.type, type) and issubclass(rule, stage.type):
            STAGES[stage.name][rule.__name__] = rule
            return rule
    raise ValueError(f"{rule.__name__} is not a rule of a stage; the stages are {list(STAGES)}")


def _are_numbers(values: np.ndarray) -> bool:
    """Whether 32 bits hold each; inf stands for no limit."""
    if values.dtype.kind not in "iuf" or np.isnan(values).any():
        return False
    return bool(((np.abs(values) <= LARGEST) | np.isinf(values)).all())


def _are_masks(values: np.ndarray) -> bool:
    return values.dtype.kind in "iu" and bool(((values >= 0) & (values < 2**LAYERS)).all())


LARGEST = float(np.finfo(np.float32).max)
VALUES: dict[str, tuple[str, Callable[[np.ndarray], bool]]] = {  # of leaves, by their kind
    "b": ("true or false", lambda values: values.dtype.kind == "b"),
    "u": (f"a whole number from 0 to {2**LAYERS - 1}: a bit for each layer", _are_masks),
    "f": (f"a number of at most {LARGEST:.2g}, or inf", _are_numbers),
}
Body = Literal["clip", "adult"]  # whose defaults are meant


FREE_KEYS = keys(Override)
MOVED_KEYS = {"prior_mean": "centre", "prior_sd": "spread"}  # from [free] to [prior]


class Preset(NamedTuple):
    """A preset as files name it."""

    name: str = "record"
    faithful: bool = False
    """Whether it is the original, as faithful as it is known."""

    def system(self, rig: jaxik.Rig | None = None) -> jaxik.FootIK:
        """The system of the preset; see `preset_system`."""
        return preset_system(self.name, rig, faithful=self.faithful)

    def keys(self) -> dict[str, object]:
        """The keys that name it in a file."""
        keys: dict[str, object] = {"preset": self.name}
        return keys | {"faithful": True} if self.faithful else keys


DEFAULT_PRESET = Preset()
WALKING = Preset("stride")


def choose_preset(clips: Iterable[Clip]) -> Preset:
    """The preset that serves clips best, which is logged: `stride` for legs that walk.

    It knows each foothold of a clip in advance. Where a foot never stands, as a rider's or a
    swimmer's, there is none: the preset of files that name none follows the ground from frame to
    frame.
    """
    if all(clip.stance_labels().any(axis=0).all() for clip in clips):
        preset, reason = WALKING, "as all feet stand in turn"
    else:
        preset, reason = DEFAULT_PRESET, "as a foot never stands"
    activity.log(f"preset {preset.name}, {reason}; --preset takes another")
    return preset


def preset_names() -> list[str]:
    """Names of all presets, sorted."""
    return sorted(name for name, value in vars(presets).items() if _is_preset(value))


def preset_system(
    name: object, rig: jaxik.Rig | None = None, *, faithful: object = False
) -> jaxik.FootIK:
    """The system of a preset.

    Args:
        name: of a function of `jaxik.presets`.
        rig: whose body it is for; None is the adult.
        faithful: whether it should be the original where the preset differs from it.

    Raises:
        ValueError: there is no such preset, or it has no other original.
    """
    known = preset_names()
    if name not in known:
        raise ValueError(f"no preset named {name!r}; there are {known}")
    if not isinstance(faithful, bool):
        raise ValueError(f"faithful is {faithful!r}; wanted true or false")
    if not faithful:
        return getattr(presets, str(name))(rig)
    if name not in (originals := _names_of_originals()):
        raise ValueError(f"{name!r} has no other original; faithful is for {originals}")
    return getattr(presets, str(name))(rig, faithful=True)


def all_presets() -> list[Preset]:
    """Every preset, and then every original."""
    originals = [Preset(name, faithful=True) for name in _names_of_originals()]
    return [*map(Preset, preset_names()), *originals]


def _names_of_originals() -> list[str]:
    return [n for n in preset_names() if "faithful" in signature(getattr(presets, n)).parameters]


def _is_preset(value: object) -> bool:
    return getattr(value, "__module__", "") == presets.__name__ and callable(value)


def rule_names(ik: jaxik.FootIK) -> dict[str, str]:
    """The name of the rule at each stage."""
    return {stage: type(rule).__name__ for stage, rule in vars(ik).items()}


def with_rules(
    ik: jaxik.FootIK, names: Table, where: str, rig: jaxik.Rig | None = None
) -> jaxik.FootIK:
    """The system with other rules at some stages.

    A rule that the system has already keeps its values; a new one has its defaults. Names of
    earlier releases mean what they meant then.

    Args:
        ik: the system.
        names: names of rules, by stage.
        where: place of the names in their file, for the error message.
        rig: whose body the defaults are for; None is the adult.

    Raises:
        ValueError: a stage is unknown, or does not have the rule.
    """
    check_keys(names, list(STAGES), where)
    present = rule_names(ik)
    rules = {}
    for stage, name in names.items():
        former = FORMER_RULES.get(str(name), FormerRule(str(name), {}, lambda rule: True))
        if former.name not in STAGES[stage]:
            known = list(STAGES[stage])
            raise ValueError(f"{where}: {stage} has no rule {name!r}; it has {known}")
        if former.name != present[stage] or not np.all(former.is_meant(getattr(ik, stage))):
            rules[stage] = body.scale(STAGES[stage][former.name](**former.values), rig)
    return replace(ik, **rules)


def changed_rules(ik: jaxik.FootIK, preset: jaxik.FootIK) -> dict[str, str]:
    """The names of a system's rules, by stage, where they differ from its preset's."""
    originals = rule_names(preset)
    return {stage: name for stage, name in rule_names(ik).items() if name != originals[stage]}


def own_root(ik: jaxik.FootIK, preset: jaxik.FootIK) -> dict[str, bool]:
    """`root.enabled`, if the preset's rule, or else a new one of its kind, has it otherwise."""
    kind = type(ik.root)
    if kind not in STAGES["root"].values() or OWN_ROOT not in leaf_names(ik):
        return {}
    usual = preset if isinstance(preset.root, kind) else replace(preset, root=kind())
    enabled = bool(parameter_tree.get(ik, OWN_ROOT))
    return {OWN_ROOT: enabled} if enabled != bool(parameter_tree.get(usual, OWN_ROOT)) else {}


def changed_values(ik: jaxik.FootIK, other: jaxik.FootIK) -> dict[str, object]:
    """Values in which a system differs from another one with the same rules, by dotted name."""
    values = {name: np.asarray(parameter_tree.get(ik, name)) for name in leaf_names(ik)}
    changed: dict[str, object] = {
        name: value.tolist()
        for name, value in values.items()
        if not np.array_equal(value, np.asarray(parameter_tree.get(other, name)))
    }
    options, others = parameter_tree.options(ik), parameter_tree.options(other)
    return changed | {name: on for name, on in options.items() if on != others[name]}


def with_parameters(ik: jaxik.FootIK, values: Table, where: str) -> jaxik.FootIK:
    """The system with other values, by dotted name: parameters, conventions, switches, options.

    Raises:
        ValueError: a name is unknown, or a value has the wrong type or shape.
    """
    options = parameter_tree.options(ik)
    check_keys(values, [*leaf_names(ik), *options], where)
    for name in options & values.keys():
        if not isinstance(values[name], bool):
            raise ValueError(f"{where}: {name} is {values[name]!r}; wanted true or false")
        ik = parameter_tree.with_option(ik, name, values[name])
    values = {name: value for name, value in values.items() if name not in options}
    shapes = {slot.name: slot.shape for slot in parameter_tree.slots(ik)}
    for name, value in values.items():
        old = parameter_tree.get(ik, name)
        try:
            new = np.asarray(value)
        except ValueError:  # lists of different lengths
            new = np.asarray(None)
        wanted, accepts = VALUES[old.dtype.kind]
        if not accepts(new):
            raise ValueError(f"{where}: {name} is {value!r}; wanted {wanted}")
        single = shapes.get(name, old.shape)  # of a value that all legs share
        if new.shape != single and (new.shape[1:] != single or not new.size):
            raise ValueError(f"{where}: {name} has shape {new.shape}; wanted {single}")
    return parameter_tree.replace(ik, dict(values))


def without_own_root(ik: jaxik.FootIK) -> jaxik.FootIK:
    """The system without a root rule of its own, for characters whose root is placed already."""
    own = OWN_ROOT in leaf_names(ik)
    return parameter_tree.replace(ik, {OWN_ROOT: False}) if own else ik


def leaf_names(ik: jaxik.FootIK) -> list[str]:
    """Dotted names of all parameters, conventions and switches of a system."""
    return [slot.name for slot in parameter_tree.slots(ik)]


def read_parameters(table: Table, ik: jaxik.FootIK) -> Content:
    """The values in a table of a system's parameters by dotted name; nothing is checked."""
    return parameters_with_half_lives(flatten(table, 2), leaf_names(ik))


def read_free_table(table: Table, ik: jaxik.FootIK, where: str) -> FreeTable:
    """The entries of a [free] table by dotted name; ValueError for a wrong key or value."""
    named = free_with_half_lives(flatten(table, 2), leaf_names(ik))
    for name, entry in named.items():
        if isinstance(entry, Mapping) and (old := [key for key in MOVED_KEYS if key in entry]):
            moved = ", ".join(f"{MOVED_KEYS[key]} = {entry[key]}" for key in old)
            raise ValueError(
                f"{where} {name}: {old[0]} is not a key of [free] any more; write it in the table"
                f" [prior] of the experiment, as {name} = {{ {moved} }}"
            )
        check_table(entry, FREE_KEYS, f"{where} {name}")
    return named
