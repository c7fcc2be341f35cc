"""The table [capture] of an experiment: what of the captures is fitted beside the system.

[capture]
ground_height = {}                    # for each clip; {} takes the range from `Capture`
time_shift = { low = -0.05, high = 0.05 }
"ankle_up[1]" = {}                    # of the second clip only
[prior.capture]                       # narrow unless it says otherwise
ground_height = { centre = 0.03 }
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np

import jaxik
from fitting.inference.sensitivity import FreeTable
from fitting.problem.capture.parameters import GROUND, SHIFT, SPREAD, Capture
from fitting.problem.capture.system import PREFIX, is_of_capture, without_ends
from fitting.problem.prior import ParameterPrior, Priors
from fitting.problem.scene import Scene
from fitting.problem.space import Space
from fitting.runtime.validation import Table, check_keys, check_table
from jaxik.maths import parameter_tree
from jaxik.stages.probe.capsule import SweepProbe

from .systems import FREE_KEYS

Entry = TypeVar("Entry")
NAMES = tuple(parameter_tree.declarations(Capture()))


def read_capture(table: Table, clips: int, where: str) -> FreeTable:
    """The entries of a [capture] table by name.

    Args:
        table: as TOML reads it.
        clips: how many the experiment has.
        where: the table's place in its file, for error messages.

    Raises:
        ValueError: a name or a clip is unknown, or a value is wrong.
    """
    check_keys({name.partition("[")[0]: entry for name, entry in table.items()}, NAMES, where)
    numbers = [f"[{clip}]" for clip in range(clips)]
    for name in table:
        if "[" in name and name[name.index("[") :] not in numbers:
            raise ValueError(f"{where}: no clip for {name!r}; wanted a number of {numbers}")
    return {name: check_table(entry, FREE_KEYS, f"{where} {name}") for name, entry in table.items()}


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
    """What a table has for a free parameter; that of a clip's capture may stand there for all."""
    of_all = name.partition("[")[0] if is_of_capture(name) else name
    return table.get(name, table.get(of_all))


def with_narrow_priors(priors: Priors, names: Iterable[str]) -> Priors:
    """The priors with those of a capture, which are narrow where nothing else is said.

    Args:
        priors: as the experiment states them.
        names: dotted, of the free parameters of captures.
    """
    named = dict(priors.named)
    for name in names:
        prior = entry_for(name, priors.named) or ParameterPrior()
        if prior.shape == "normal" and prior.spread is None:
            prior = dataclasses.replace(prior, spread=SPREAD)
        named[name] = prior
    return dataclasses.replace(priors, named=named)


def prepare(scenes: Sequence[Scene], space: Space[jaxik.FootIK], where: str) -> list[Scene]:
    """The scenes of clips whose captures are fitted.

    Each keeps a ground of its own. Where the capture is shifted in time, frames at the ends of its
    clip do not count, of which it may show nothing.

    Args:
        scenes: of all clips.
        space: of the free parameters.
        where: the table's place in its file, for error messages.

    Raises:
        ValueError: the system sweeps shapes over ground that is to move, or nothing is left of a
            clip.
    """
    ground = [name for name in GROUND for p in space.parameters if p.leaf == f"{PREFIX}{name}"]
    if ground and isinstance(space.system.probe, SweepProbe):
        raise ValueError(
            f"{where}: {ground} cannot be fitted with the probe SweepProbe, whose shapes need the "
            "ground as it is; leave them out, or take another probe in [rules]"
        )
    prepared = list(scenes)
    for parameter in space.parameters:
        if parameter.leaf == f"{PREFIX}{SHIFT}":
            reach = max(-parameter.low, parameter.high)
            for clip in range(len(scenes)) if parameter.leg is None else [parameter.leg]:
                prepared[clip] = without_ends(scenes[clip], reach)
                if not np.any(prepared[clip].reference.observed):
                    raise ValueError(
                        f"{where}: nothing is left of clip {clip + 1} without the {reach:g} s at "
                        f"its ends that {SHIFT} may shift away; take a longer part of it, or a "
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
            "takes clips as they are; leave the table out, or see by `jaxik fit` what it finds"
        )
