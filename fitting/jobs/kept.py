"""The finished stages of a fit, which are kept in its folder until it is finished."""

from pathlib import Path

import jaxik
from fitting.experiments.experiment import Experiment
from fitting.inference.optimisation.kept_stages import KeptStages
from fitting.problem.digest import digest_with
from fitting.problem.problem import Problem
from fitting.studies import run_folder
from fitting.studies.fit import Fit

from .output import Log


def kept_stages(
    run: Path | None, experiment: Experiment, problem: Problem[jaxik.FootIK], log: Log
) -> KeptStages | None:
    """The finished stages of a fit that was killed in this folder, and room for those of this."""
    if run is None:
        return None
    identity = digest_with(problem, experiment.fit, experiment.seed, experiment.noise)
    kept = KeptStages(run / run_folder.SEARCH, identity, log)
    if kept.count:
        stages = f"{kept.count} stages of its search"
        if kept.profile_count:
            stages += f" and {kept.profile_count} of its profiles"
        log(f"a fit that was interrupted here goes on after {stages}")
    return kept


def remove(kept: KeptStages | None, fitted: Fit) -> None:
    """Removes the stages of a fit that is finished; an interrupted one goes on from them."""
    if kept is not None and not fitted.solution.interrupted:
        kept.remove()
