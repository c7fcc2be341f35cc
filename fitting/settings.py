"""Parameters of a system as TOML: a preset's name and a table a stage, in our names and units."""

from pathlib import Path

import numpy as np
import tomli_w

import jaxik
from jaxik import rule

from .checks import check_keys, flat, nested, read_toml
from .experiment import leaf_names, name_preset, with_parameters


def to_toml(ik: jaxik.FootIK, preset: str = "record") -> str:
    """Every parameter, convention and switch of a system; units as the rules declare them."""
    values = {name: np.asarray(rule.get(ik, name)).tolist() for name in leaf_names(ik)}
    return tomli_w.dumps({"preset": preset} | nested(values))


def from_toml(path: str | Path) -> tuple[jaxik.FootIK, str]:
    """The system in a TOML file, and its preset; what the file leaves out is the preset's.

    Raises:
        ValueError: a file that is not there or no TOML, a preset, name or value that is unknown.
    """
    path = Path(path)
    content = read_toml(path, "a parameter")
    preset = content.pop("preset", "record")
    ik = name_preset(preset)
    check_keys(content, list(vars(ik)), str(path))
    return with_parameters(ik, flat(content, 2), str(path)), preset
