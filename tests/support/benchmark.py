"""The blocks benchmark's own scoring program, which is not a package."""

import importlib.util
from pathlib import Path
from types import ModuleType


def scoring_program(mocap: Path) -> ModuleType:
    """The program of the folder of captured clips; its `score` compares two clips."""
    spec = importlib.util.spec_from_file_location("score", mocap / "blocks" / "score.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
