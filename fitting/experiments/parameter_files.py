"""Parameter files: a system as TOML, with a preset, changed rules, and one table per stage.

preset = "record"
[rules]                     # where they differ from the preset's
pelvis = "SupportPelvis"
[pelvis]                    # names and units as the rules declare them
lowest_share = 0.4
"""

from pathlib import Path

import numpy as np
import tomli_w

import jaxik
from fitting.runtime.validation import TABLE, check_keys, check_table, flatten, nest, read_toml
from jaxik.maths import parameter_tree

from .systems import changed_rules, leaf_names, preset_system, with_parameters, with_rules


def system_to_toml(ik: jaxik.FootIK, preset: str = "record") -> str:
    """All rules, parameters, conventions and switches of a system, as TOML."""
    values = {name: np.asarray(parameter_tree.get(ik, name)).tolist() for name in leaf_names(ik)}
    rules = changed_rules(ik, preset_system(preset))
    return tomli_w.dumps({"preset": preset} | ({"rules": rules} if rules else {}) | nest(values))


def load_system(path: str | Path) -> tuple[jaxik.FootIK, str]:
    """Reads a parameter file; returns the system and the name of its preset.

    What the file leaves out stays as in the preset.

    Raises:
        ValueError: the file does not exist or is not TOML; a preset, stage, rule or parameter is
            unknown; a value is wrong.
    """
    path = Path(path)
    content = read_toml(path, "a parameter")
    preset = content.pop("preset", "record")
    ik = preset_system(preset)
    rules = content.pop("rules", {})
    check_table({"rules": rules}, {"rules": TABLE}, str(path))
    ik = with_rules(ik, rules, f"{path} [rules]")
    check_keys(content, list(vars(ik)), str(path))
    return with_parameters(ik, flatten(content, 2), str(path)), preset
