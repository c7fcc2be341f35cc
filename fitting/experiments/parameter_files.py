"""Parameter files: a system as TOML, with a preset, changed rules, and one table per stage.

preset = "record"
faithful = true             # the original, where the preset differs from it
body = "clip"               # for what is left out: the rig of the clip, or "adult"
[rules]                     # where they differ from the preset's
pelvis = "SupportPelvis"
[pelvis]                    # names and units as the rules declare them
lowest_share = 0.4
"""

from pathlib import Path

import numpy as np
import tomli_w

import jaxik
from fitting.runtime.validation import (
    TABLE,
    check_keys,
    check_table,
    error_context,
    flatten,
    nest,
    read_toml,
)
from jaxik.maths import parameter_tree

from .systems import (
    BODY,
    DEFAULT_PRESET,
    Preset,
    changed_rules,
    leaf_names,
    with_parameters,
    with_rules,
)


def system_to_toml(ik: jaxik.FootIK, preset: Preset = DEFAULT_PRESET) -> str:
    """All rules, parameters, conventions, switches and options of a system, as TOML."""
    values = {name: np.asarray(parameter_tree.get(ik, name)).tolist() for name in leaf_names(ik)}
    values |= parameter_tree.options(ik)
    rules = changed_rules(ik, preset.system())
    return tomli_w.dumps(preset.keys() | ({"rules": rules} if rules else {}) | nest(values))


def load_system(path: str | Path, rig: jaxik.Rig | None = None) -> tuple[jaxik.FootIK, Preset]:
    """Reads a parameter file; returns the system and its preset.

    What the file leaves out stays as in the preset.

    Args:
        path: the file.
        rig: whose body the preset is for, unless the file says otherwise; None is the adult.

    Raises:
        ValueError: the file does not exist or is not TOML; a preset, stage, rule or parameter is
            unknown; a value is wrong.
    """
    path = Path(path)
    content = read_toml(path, "a parameter")
    preset = Preset(content.pop("preset", DEFAULT_PRESET.name), content.pop("faithful", False))
    rules, body = content.pop("rules", {}), content.pop("body", "clip")
    check_table({"rules": rules, "body": body}, {"rules": TABLE, "body": BODY}, str(path))
    rig = rig if body == "clip" else None
    with error_context(path):
        ik = preset.system(rig)
    ik = with_rules(ik, rules, f"{path} [rules]", rig)
    check_keys(content, list(vars(ik)), str(path))
    return with_parameters(ik, flatten(content, 2), str(path)), preset
