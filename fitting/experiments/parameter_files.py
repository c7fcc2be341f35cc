"""A system as TOML: a preset's name, other rules by stage, and a table of parameters a stage.

preset = "record"
[rules]                     # where they differ from the preset's
pelvis = "SupportPelvis"
[pelvis]                    # in our names and units
lowest_share = 0.4
"""

from pathlib import Path

import numpy as np
import tomli_w

import jaxik
from fitting.runtime.validation import TABLE, check_keys, check_table, flatten, nest, read_toml
from jaxik.maths import parameter_tree

from .systems import exchanged, leaf_names, name_preset, with_parameters, with_rules


def to_toml(ik: jaxik.FootIK, preset: str = "record") -> str:
    """Every rule, parameter, convention and switch of a system; units as the rules declare them."""
    values = {name: np.asarray(parameter_tree.get(ik, name)).tolist() for name in leaf_names(ik)}
    other = exchanged(ik, name_preset(preset))
    return tomli_w.dumps({"preset": preset} | ({"rules": other} if other else {}) | nest(values))


def from_toml(path: str | Path) -> tuple[jaxik.FootIK, str]:
    """The system in a TOML file, and its preset; what the file leaves out is the preset's.

    Raises:
        ValueError: a file that is not there or no TOML; a preset, stage, rule, name or value that
            is unknown.
    """
    path = Path(path)
    content = read_toml(path, "a parameter")
    preset = content.pop("preset", "record")
    ik = name_preset(preset)
    other = content.pop("rules", {})
    check_table({"rules": other}, {"rules": TABLE}, str(path))
    ik = with_rules(ik, other, f"{path} [rules]")
    check_keys(content, list(vars(ik)), str(path))
    return with_parameters(ik, flatten(content, 2), str(path)), preset
