"""Parameter files: a system as TOML or JSON; the README shows one."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

import jaxik
from fitting.runtime import validation
from fitting.runtime.declarations import key, keys, read
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree
from jaxik.world import body

from . import systems
from .systems import DEFAULT_PRESET, Body, Preset


@dataclass(frozen=True)
class ParameterFile:
    """The keys of a parameter file beside a table for each stage."""

    rules: Mapping[str, str] = key({}, "Rules that differ from the preset's, by stage.")
    body: Body | None = key(None, "Whose numbers are meant where the file leaves them out.")
    leg_length: float | None = key(None, "Of the body that all numbers are for.", "m", 0.01, 100.0)


def system_to_toml(
    ik: jaxik.FootIK, preset: Preset = DEFAULT_PRESET, leg_length: float | None = None
) -> str:
    """All rules, parameters, conventions, switches and options of a system, as TOML.

    `leg_length`, m, is that of the body that its numbers are for; None if they fit any as they are.
    """
    return tomli_w.dumps(_tables(ik, preset, leg_length))


def system_to_json(
    ik: jaxik.FootIK, preset: Preset = DEFAULT_PRESET, leg_length: float | None = None
) -> str:
    """The same as JSON, in which null stands for inf; arguments as for `system_to_toml`."""
    content = _replaced(_tables(ik, preset, leg_length), math.inf, None)
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _tables(ik: jaxik.FootIK, preset: Preset, leg_length: float | None) -> Content:
    values = {
        name: np.asarray(parameter_tree.get(ik, name)).tolist() for name in systems.leaf_names(ik)
    }
    values |= parameter_tree.options(ik)
    rules = systems.changed_rules(ik, preset.system())
    keys = preset.keys() | ({} if leg_length is None else {"leg_length": leg_length})
    return keys | ({"rules": rules} if rules else {}) | validation.nest(values)


def _replaced(content: Any, old: float | None, new: float | None) -> Any:
    """The content with one value in place of another: JSON has None where numbers are infinite."""
    if isinstance(content, Mapping):
        return {key: _replaced(entry, old, new) for key, entry in content.items()}
    if isinstance(content, list):
        return [_replaced(entry, old, new) for entry in content]
    return new if content == old else content


def _read(path: Path) -> Content:
    """The tables of a parameter file."""
    if path.suffix.lower() != ".json":
        return validation.read_toml(path, "a parameter")
    if reason := validation.why_unreadable(path):
        raise ValueError(f"{path}: {reason}, wanted a parameter file")
    try:
        content = validation.read_json(path)
    except ValueError as error:
        raise ValueError(
            f"{path}: not JSON: {validation.in_one_line(error, validation.QUOTED)}"
        ) from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: wanted an object with a preset, rules or parameters")
    return _replaced(content, None, math.inf)


def leg_length_of(path: Path) -> float | None:
    """Leg length, m, of the body that a parameter file is for; None if it fits any as it is."""
    return _read(path).get("leg_length")


def load_system(path: str | Path, rig: jaxik.Rig | None = None) -> tuple[jaxik.FootIK, Preset]:
    """Reads a parameter file; returns the system and its preset.

    What the file leaves out stays as in the preset.

    Args:
        path: the file.
        rig: whose body the preset is for, unless the file says otherwise; None is the adult. If the
            file has a leg length, the system is made similar for this body, or with None left as it
            is.

    Raises:
        ValueError: the file does not exist, is empty or is not TOML; a preset, stage, rule or
            parameter is unknown; a value is wrong.
    """
    path = Path(path)
    content = _read(path)
    if not content:  # the defaults would pass for what somebody has fitted
        raise ValueError(f"{path}: nothing is in it; wanted a preset, rules or parameters")
    preset = Preset(content.pop("preset", DEFAULT_PRESET.name), content.pop("faithful", False))
    own_keys = {name: content.pop(name) for name in keys(ParameterFile) if name in content}
    top = read(own_keys, ParameterFile, str(path))
    own = None if top.body == "adult" or top.leg_length is not None else rig
    with validation.error_context(path):
        ik = preset.system(own)
    ik = systems.with_rules(ik, top.rules, f"{path} [rules]", own)
    validation.check_keys(content, list(vars(ik)), str(path))
    ik = systems.with_parameters(ik, systems.read_parameters(content, ik), str(path))
    if top.leg_length is not None and rig is not None:
        ik = body.similar(ik, body.leg_length(rig) / top.leg_length)
    return ik, preset
