"""An experiment that fits only what the 128 bytes of the game's record hold."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from fitting.problem.capture.system import is_of_capture
from fitting.runtime import validation
from fitting.runtime.precision import in_float64
from jaxik import record
from jaxik.maths import parameter_tree

from .experiment import Experiment
from .systems import Preset, changed_rules

ORIGINAL = Preset("record", faithful=True)  # whose parameters the record has room for
Entry = TypeVar("Entry")
PLACES = {ours for _, ours, _ in record.FLOATS}  # of single numbers; of a vector, one each


@in_float64
def restrict(experiment: Experiment) -> Experiment:
    """The experiment with only such free parameters as the game's record has room for.

    Whatever else the system has is fixed at what a reader of the record assumes. So its fit loses
    nothing when it is written as a record. What the restriction was made of stays in `whole`.

    Raises:
        ValueError: the experiment has another preset, other rules, or parameters that differ
            between legs; its parameters follow the body; or none that is free has room.
    """
    with validation.error_context(experiment.path):
        _check(experiment)
    assumed = ORIGINAL.system()
    fixed = {
        name: np.asarray(parameter_tree.get(assumed, name)).tolist()
        for name in parameter_tree.docs(assumed)
        if name not in record.PARAMETERS
    }
    hierarchy = replace(
        experiment.hierarchy,
        per_clip=_within(experiment.hierarchy.per_clip),
        per_subject=_within(experiment.hierarchy.per_subject),
    )
    return replace(
        experiment,
        free=_kept(experiment.free),
        parameters={**experiment.parameters, **fixed},
        prior=replace(experiment.prior, named=_kept(experiment.prior.named)),
        start=_kept(experiment.start),
        hierarchy=hierarchy,
        record_only=True,
        whole=replace(experiment, record_only=False),
    )


def left_out(experiment: Experiment) -> list[str]:
    """Names of the free parameters that a restricted experiment leaves out."""
    whole = experiment.whole or experiment
    return [name for name in whole.free if name not in experiment.free]


def set_aside(experiment: Experiment) -> dict[str, tuple[str, str]]:
    """Fixed parameters that a restricted experiment has changed: as they were, and as they are."""
    whole = experiment.whole or experiment
    lost = record.dropped(whole.starting_system())
    return {name: values for name, values in lost.items() if name in whole.parameters}


def _kept(table: Mapping[str, Entry]) -> dict[str, Entry]:
    """The entries of parameters that the record has room for, and of captures."""
    return {name: entry for name, entry in table.items() if name in PLACES or is_of_capture(name)}


def _within(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in names if name in PLACES)


def _check(experiment: Experiment) -> None:
    """Raises ValueError for an experiment whose fit could not be a record."""
    own = Preset(experiment.preset, experiment.faithful)
    if own != ORIGINAL:
        raise ValueError(
            "record_only is for preset = 'record' with faithful = true; the experiment has preset "
            f"= {own.name!r} with faithful = {str(own.faithful).lower()}; `jaxik init "
            "--record-only` writes one that has them"
        )
    ik = experiment.starting_system()
    if rules := changed_rules(ik, ORIGINAL.system()):
        raise ValueError(f"record_only is for the record's own rules; these are others: {rules}")
    if experiment.hierarchy.scale_with_body:
        raise ValueError(
            "record_only and [hierarchy] scale_with_body exclude each other: a record's numbers "
            "are the same for every body"
        )
    if experiment.free and not PLACES.intersection(experiment.free):
        raise ValueError(
            f"record_only: the record has no room for any of {list(experiment.free)}; it has for "
            f"{sorted(PLACES)}"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is dropped, which is about to be fixed
        record.from_ik(ik, record.Record(), record.Reading(length_unit="m"), drop=True)
