"""The parameters that made a synthetic reference, for comparing a fit with the truth."""

from collections.abc import Mapping

import numpy as np

from fitting.runtime.validation import flatten, read_toml

from .experiment import Experiment
from .systems import with_parameters


def load_known_values(experiment: Experiment) -> Mapping[str, float] | None:
    """Known parameters by dotted name, from the first clip that names a truth file.

    Tables in the file that belong to no stage are ignored, and so are switches. A leaf with several
    values has each of them under its name with `[index]`, and their mean under its own name.

    Returns:
        The values; None if no clip names a truth file.

    Raises:
        ValueError: the file is not TOML, a name is unknown, a value is not a number.
    """
    path = next((clip.truth for clip in experiment.clips if clip.truth is not None), None)
    if path is None:
        return None
    ik = experiment.preset_system()
    content = read_toml(path, "a truth")
    leaves = flatten({stage: table for stage, table in content.items() if stage in vars(ik)}, 2)
    with_parameters(ik, leaves, str(path))
    known: dict[str, float] = {}
    for name, value in leaves.items():
        if not isinstance(value, bool):
            elements = value if isinstance(value, list) else []
            known |= {f"{name}[{i}]": float(element) for i, element in enumerate(elements)}
            known[name] = float(np.mean(value))
    for name in experiment.free:  # one leg's element of a leaf for which the file has one value
        leaf = name.partition("[")[0]
        if leaf in known:
            known.setdefault(name, known[leaf])
    return known
