"""The tables of an experiment that are read with its system or its clips."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import numpy as np

import jaxik
from fitting.inference.mixed_model import Grouping
from fitting.inference.sensitivity import FreeTable
from fitting.problem.capture_system import PREFIX, is_of_capture, without_ends
from fitting.problem.scene import SHIFT, SPREAD, Capture, Scene
from fitting.problem.space import ParameterPrior, Priors, Space
from fitting.runtime import validation
from fitting.runtime.declarations import NEEDED, NUMBER, Key, check_table, key, keys
from fitting.runtime.validation import Content, Table, check_keys, flatten, nest
from jaxik.maths import parameter_tree

from .systems import (
    FREE_KEYS,
    leaf_names,
    read_free_table,
    read_parameters,
    with_parameters,
    with_rules,
)

COMPLETE = "all rules"  # the name of the experiment with nothing left out

Entry = TypeVar("Entry")
CAPTURE_NAMES = tuple(parameter_tree.declarations(Capture()))

LEVELS = ("per_subject", "per_clip")
NAMES = "a list of names of free parameters"
PRIOR_KEYS = keys(ParameterPrior)
DEFAULT_KEYS = {name: PRIOR_KEYS[name] for name in ("shape", "spread")}


@dataclass(frozen=True)
class Ablation:
    """A named variant of the experiment."""

    name: str = key(NEEDED, "What is left out.")
    rules: Mapping[str, str] = key({}, "Other rules, by stage.")
    parameters: Mapping[str, object] = key({}, "Fixed at these values, even if they are free else.")
    free: FreeTable = key({}, "Fitted in addition.")


def read_ablations(
    tables: Sequence[Ablation], ik: jaxik.FootIK, where: str
) -> tuple[Ablation, ...]:
    """Ablations of a system by the dotted names of parameters.

    Raises:
        ValueError: a stage, rule or parameter is unknown; a value is wrong; a name is empty or
            taken; an ablation changes nothing. The message begins with `where`.
    """
    ablations: list[Ablation] = []
    for table in tables:
        if table.name in (COMPLETE, *(earlier.name for earlier in ablations)):
            raise ValueError(f"{where}: there already is a variant named {table.name!r}")
        ablations.append(_read(table, ik, where))
    return tuple(ablations)


def _read(table: Ablation, ik: jaxik.FootIK, where: str) -> Ablation:
    if not table.name.strip():
        raise ValueError(f"{where}: a variant without a name; wanted name = 'what is left out'")
    where = f"{where} {table.name}"
    other = with_rules(ik, table.rules, f"{where}: rules")
    parameters = read_parameters(table.parameters, other)
    free = read_free_table(table.free, other, f"{where}: free")
    with_parameters(other, parameters, f"{where}: parameters")
    leaves = {full.partition("[")[0]: None for full in free}  # one leg's element has an index
    validation.check_keys(leaves, leaf_names(other), f"{where}: free")
    if not parameters and not free and eqx.tree_equal(other, ik):
        raise ValueError(f"{where}: changes nothing; wanted other rules or parameters")
    return dataclasses.replace(table, parameters=parameters, free=free)


def read_capture(table: Table, clips: int, where: str) -> FreeTable:
    """The entries of a [capture] table by name.

    Raises:
        ValueError: a name or a clip is unknown, or a value is wrong.
    """
    check_keys(
        {name.partition("[")[0]: entry for name, entry in table.items()}, CAPTURE_NAMES, where
    )
    numbers = [f"[{clip}]" for clip in range(clips)]
    for name in table:
        if "[" in name and name[name.index("[") :] not in numbers:
            raise ValueError(f"{where}: no clip for {name!r}; wanted a number of {numbers}")
        check_table(table[name], FREE_KEYS, f"{where} {name}")
    return table


def free_table(capture: FreeTable, clips: int) -> FreeTable:
    """The entries by dotted name: one for each clip, with its number where there are several."""
    table = {}
    for name, overrides in capture.items():
        of_all = clips > 1 and "[" not in name
        names = [f"{name}[{clip}]" for clip in range(clips)] if of_all else [name]
        table |= {f"{PREFIX}{each}": overrides for each in names}
    return table


def known_names(capture: FreeTable, clips: int) -> list[str]:
    """Dotted names that may stand in [prior] and [start]; without a number for all clips."""
    return [*(f"{PREFIX}{name}" for name in capture), *free_table(capture, clips)]


def entry_for(name: str, table: Mapping[str, Entry]) -> Entry | None:
    """The entry of a free parameter in a table; one of captures may stand there for all clips."""
    of_all = name.partition("[")[0] if is_of_capture(name) else name
    return table.get(name, table.get(of_all))


def with_narrow_priors(priors: Priors, names: Iterable[str]) -> Priors:
    """The priors with those of captures by name, which are narrow unless specified otherwise."""
    named = dict(priors.named)
    for name in names:
        prior = entry_for(name, priors.named) or ParameterPrior()
        if prior.shape == "normal" and prior.spread is None:
            prior = dataclasses.replace(prior, spread=SPREAD)
        named[name] = prior
    return dataclasses.replace(priors, named=named)


def prepare(scenes: Sequence[Scene], space: Space[jaxik.FootIK], where: str) -> list[Scene]:
    """The scenes of clips whose captures are fitted.

    Each has a ground of its own. Where the capture is shifted in time, frames at the ends of its
    clip do not count, of which it may show nothing.

    Raises:
        ValueError: nothing is left of a clip.
    """
    prepared = list(scenes)
    for parameter in space.parameters:
        if parameter.leaf == f"{PREFIX}{SHIFT}":
            reach = max(-parameter.low, parameter.high)
            for clip in range(len(scenes)) if parameter.leg is None else [parameter.leg]:
                prepared[clip] = without_ends(scenes[clip], reach)
                if not np.any(prepared[clip].reference.observed):
                    raise ValueError(
                        f"{where}: nothing is left of clip {clip + 1} without the {reach:g} s at "
                        f"its ends that {SHIFT} may shift away; use a longer part of it, or a "
                        "narrower range"
                    )
    return prepared


def check_unnumbered(capture: FreeTable, where: str) -> None:
    """Checks that a table goes for each clip alone.

    Raises:
        ValueError: something in it is of one of several clips only.
    """
    if numbered := [name for name in capture if "[" in name]:
        raise ValueError(
            f"{where} [capture]: {numbered} are of one of several clips, but each is fitted alone; "
            "leave the numbers out, or fit the clips --together"
        )


def refuse(capture: FreeTable, where: str, command: str) -> None:
    """Refuses an experiment with a capture for a command that fits systems only.

    Raises:
        ValueError: there is something in the table.
    """
    if capture:
        raise ValueError(
            f"{where} [capture]: {sorted(capture)} cannot be fitted by `jaxik {command}`, which "
            "uses clips as they are; leave the table out, or see by `jaxik fit` what it finds"
        )


@dataclass(frozen=True)
class Hierarchy:
    """Which parameters several clips and subjects share."""

    per_subject: tuple[str, ...] = key(
        (), "Free parameters of which each subject has its own value.", wanted=NAMES
    )
    per_clip: tuple[str, ...] = key(
        (), "Free parameters of which each clip has its own value.", wanted=NAMES
    )
    scale_with_body: bool = key(
        False, "Whether lengths, speeds and times follow the legs of each clip's body."
    )

    @property
    def varying(self) -> tuple[str, ...]:
        """Names of the parameters that are not shared by all clips."""
        return (*self.per_subject, *self.per_clip)

    def level(self, name: str) -> str:
        """Where a parameter varies: by `clip` or `subject`; else it is `shared`."""
        return (
            "clip" if name in self.per_clip else "subject" if name in self.per_subject else "shared"
        )

    def grouping(
        self, names: Sequence[str], clips: Sequence[str], subjects: Sequence[str]
    ) -> Grouping:
        """Which clips share the values of these parameters; all names of clips differ."""
        if not self.varying:
            return Grouping.pooled(len(clips), len(names))
        labels = {"clip": clips, "subject": subjects, "shared": None}
        return Grouping.of_labels([labels[self.level(name)] for name in names])


def check_hierarchy(
    hierarchy: Hierarchy, free: Collection[str], subjects: Sequence[str | None], where: str
) -> None:
    """Checks the [hierarchy] of an experiment; a clip without a subject has None.

    Raises:
        ValueError: a name is not free or stands twice; a parameter should vary between subjects,
            and a clip does not name its subject, or all name the same; a parameter should vary
            between clips, and there is only one.
    """
    for name in hierarchy.varying:
        if name not in free:
            raise ValueError(f"{where}: {name!r} is not free; free are {sorted(free)}")
        if hierarchy.varying.count(name) > 1:
            raise ValueError(f"{where}: {name!r} stands twice; wanted it per clip or per subject")
    if hierarchy.per_clip and len(subjects) < 2:
        raise ValueError(f"{where}: per_clip needs two clips or more; there is one")
    if hierarchy.per_subject:
        if None in subjects:
            number = subjects.index(None) + 1
            raise ValueError(
                f"{where}: per_subject needs a subject in each of [[clips]]; clip {number} has none"
            )
        if len(set(subjects)) < 2:
            raise ValueError(
                f"{where}: per_subject needs two subjects or more; all clips are of {subjects[0]!r}"
            )


def read_priors(table: Table, free: Collection[str], where: str) -> Priors:
    """The priors in a [prior] table of parameters with these names.

    A parameter without a shape or a spread of its own has the table's.

    Raises:
        ValueError: a key is neither of the table nor a free parameter, or a value is wrong.
    """
    entries = flatten(table, 2)
    check_keys(entries, [*DEFAULT_KEYS, *free], where)
    default = {name: entries.pop(name) for name in DEFAULT_KEYS if name in entries}
    default = check_table(default, DEFAULT_KEYS, where)
    named = {}
    for name, entry in entries.items():
        own = check_table(entry, PRIOR_KEYS, f"{where} {name}")
        normal = own.get("shape", default.get("shape")) != "uniform"
        inherited: Content = default if normal else {"shape": "uniform"}
        with validation.error_context(f"{where} {name}"):
            named[name] = ParameterPrior(**(inherited | own))
    with validation.error_context(where):
        return Priors(ParameterPrior(**default), named)


def priors_to_table(priors: Priors) -> Content:
    """The [prior] table; empty for the default."""
    if priors == Priors():
        return {}
    tables = {name: vars(prior) for name, prior in priors.named.items()}
    return {**vars(priors.default), **nest(tables)}


def read_start(table: Table, free: Collection[str], where: str) -> Mapping[str, float]:
    """The values in a [start] table by dotted name; arguments as for `read_priors`.

    Raises:
        ValueError: a name is not free, or a value is not a number.
    """
    values = flatten(table, 2)
    return check_table(values, dict.fromkeys(free, Key(NUMBER, "A value.")), where)
