"""What studies keep of a folder's work, from which an interrupted call goes on: whole, and read."""

import dataclasses
import json
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np

from fitting.inference.optimise import search
from fitting.inference.optimise.checkpoints import Checkpoints
from fitting.inference.optimise.solution import Search, SearchSettings, SearchState, Solution
from fitting.inference.profiles.profiling import Profiling
from fitting.motion.accuracy import Accuracy
from fitting.motion.goodness import CLOSE, MOTIONS, PARTS
from fitting.problem.problem import Problem
from fitting.runtime.precision import in_float64
from fitting.studies import ablation, population
from fitting.studies.ablation import Row
from fitting.studies.calibrate import calibration, wrong_model
from fitting.studies.calibrate.replicates import (
    DRAWS,
    LEVELS,
    LOG_PROBABILITY,
    make_replicates,
)
from support.curves import curve_problem
from support.watching import listening

SETTINGS = SearchSettings(descents=2, max_rounds=1, generations=1, population=20, elite=5)
PARAMETER = {
    **{"name": "lean.half_life", "kind": "smooth", "unit": "1", "u": 0.5, "start_sd": 0.1},
    **{"value": 0.2, "before": 0.1, "low": 0.0, "high": 1.0, "interval": [0.1, 0.3]},
    **{"verdict": "two-sided", "contraction": 0.9, "at_bound": "", "determined": True},
    "prior": {"shape": "normal", "centre": 0.1, "spread": 1.6, "interval": [0.05, 0.9]},
    "valleys": [{"value": 0.2, "rise": 0.0, "interval": [0.1, 0.3], "values": [0.2]}],
}
ENDING = {"converged": True, "message": "Converged.", "seconds": 1.5}
SEARCH = ENDING | {"cost_before": 99.5, "cost": 10.5, "steps": 8, "starts": 2, "agreeing": 2}
REPLICATE = SEARCH | {"number": 0, "parameters": [PARAMETER]}
FIT = {"truth_u": [0.4], "truth": [0.21], "truth_levels": [0.3], "truth_valley_cost": 10.0}
CHAIN = {"number": 0, "ranks": {"lean.half_life": DRAWS // 2, LOG_PROBABILITY: 3}}
CHAIN |= {"intervals": {"lean.half_life": [[0.1, 0.3]] * len(LEVELS)}, "draws": DRAWS}
DISTANCES = {motion: dict.fromkeys(CLOSE, 0.02) for motion in MOTIONS}
JUDGEMENT = {"fits": True, "sentence": "Fits.", "distances": dict.fromkeys(PARTS, DISTANCES)}
WRONG_MODEL = {"truth_values": {"lean.half_life": 0.2}, "errors": {"drift": 0.01}}
WRONG_MODEL |= dict.fromkeys(("captured", "lasting", "noise_free"), JUDGEMENT)
REPLICATES = {
    "fits": REPLICATE | FIT,
    "chains": CHAIN | ENDING,
    "wrong_model": REPLICATE | WRONG_MODEL,
}
KINDS = {
    kind.folder: kind for kind in (calibration.FITS, calibration.CHAINS, wrong_model.WRONG_MODEL)
}


def text_of(content: Mapping[str, object]) -> bytes:
    """A file of the present format."""
    return json.dumps({"format": 1, **content}, indent=2).encode()


def _refuse(reason: object) -> NoReturn:
    raise ValueError(reason)


@cache
@in_float64
def solved() -> tuple[Problem, Solution, bytes]:
    """A problem, its solution, and the file that the search and the begun profiles leave."""
    problem = curve_problem()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "search.json"
        checkpoints = Checkpoints(path.parent, path.name, "a fit")
        with checkpoints:
            solution = search.find_best_fit(problem, SETTINGS, starts=1)
        keep = checkpoints.recall_profiles(problem, solution.u, _refuse)
        keep(Profiling.around(problem, solution).stored())
        checkpoints.flush()
        return problem, solution, path.read_bytes()


@in_float64
def load_search(path: Path) -> None:
    """Goes on from a file; what a fit only warns of is an error."""
    problem, solution, _ = solved()
    with listening(_refuse):
        _go_on(problem, solution, path)


def _go_on(problem: Problem, solution: Solution, path: Path) -> None:
    checkpoints = Checkpoints(path.parent, path.name, "a fit")
    first = SearchState.at(np.asarray(problem.space.start), seed=0)
    attached = checkpoints.attach(Search(problem, SETTINGS), first, 1)
    assert attached.recall is not None
    profiling = Profiling.around(problem, solution)
    checkpoints.recall_profiles(problem, solution.u, profiling.restore)
    assert all(np.isfinite(curve.values).all() for curve in profiling.curves.curves)


def found_text() -> bytes:
    return text_of({"name": "all clips", "u": [0.5, -0.25], **SEARCH})


def load_found(path: Path) -> None:
    """As `jaxik population` reads it."""
    found = population.search_store(path.parent, 2).read(path.name)
    assert found is not None and np.isfinite([*found["u"], found["cost"]]).all()


def rows_text() -> bytes:
    names = [field.name for field in dataclasses.fields(Accuracy)]
    accuracy = Accuracy(**{name: 0.01 * place for place, name in enumerate(names)})
    row = Row("0123abcd", "locks", 1, accuracy, {"lean.half_life": 0.2}, cast(Any, SEARCH))
    return text_of({"rows": [dataclasses.asdict(row)]})


def load_rows(path: Path) -> None:
    """As `jaxik ablate` reads them."""
    for row in ablation.read(path.parent):
        assert isinstance(row.agreement, Accuracy) and isinstance(row.variant, str)


def load_replicate(path: Path) -> None:
    """As `jaxik calibrate` reads it."""
    kind, folder = KINDS[path.parent.name], path.parents[1]
    (result,) = make_replicates(kind, folder, ["lean.half_life"], _refuse, [0])
    assert result["number"] == 0 and isinstance(result["seconds"], float)
