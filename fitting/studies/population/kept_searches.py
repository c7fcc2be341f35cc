"""Searches whose results are kept on disk, each in a file that is named after what it follows from.

An interrupted study continues: called again, it finds what it had, and the search that was running
goes on after its last stage. A search of another problem, with other settings or another seed has
another name.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NotRequired, TypedDict

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.inference.noise import NoiseModel, NoiseOptions, noise_of, with_noise
from fitting.inference.optimise.checkpoints import KeptStages
from fitting.inference.optimise.solution import Progress
from fitting.problem.problem import Problem, digest_with
from fitting.runtime.json_files import Finite, JsonFile
from fitting.runtime.validation import Content, error_context
from fitting.studies.ablation import labelled
from fitting.studies.fit.assess import search_with_noise

SEARCHES = "searches"


class Found(TypedDict):
    """The result of a search, as its file holds it."""

    name: str
    """What was fitted."""
    u: list[Finite]
    cost: Finite
    converged: bool
    message: str
    seconds: float
    noise: NotRequired[Annotated[Content, NoiseModel]]
    """Where it was estimated."""


FOUND_FILE = JsonFile(
    Found, "written by `jaxik population`", "delete it, and its search is made anew"
)


@dataclasses.dataclass(frozen=True)
class KeptSearches:
    """Searches with the settings of an experiment."""

    experiment: Experiment
    folder: Path | None
    """Where they are kept; None keeps none."""
    progress: Callable[[Progress], None] | None = None
    on_found: Callable[[Found], object] = lambda found: None
    """Called with each new result."""

    def fit(
        self, name: str, problem: Problem[jaxik.FootIK], *, with_its_noise: bool = False
    ) -> tuple[Problem[jaxik.FootIK], Found]:
        """The best fit, and the problem with the noise that was found.

        Args:
            name: of what is fitted, for the reader.
            problem: what to fit.
            with_its_noise: whether the noise that the experiment estimates is estimated here.

        Raises:
            KeyboardInterrupt: the search was interrupted; it goes on when it is called again.
            ValueError: a file in the folder is something else.
        """
        noise = self.experiment.noise if with_its_noise else NoiseOptions(correlation="given")
        path = self._path(problem, noise)
        found = None if path is None else _read(path, problem.space.size)
        if found is None:
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
            kept = None if path is None else KeptStages(path.with_suffix(".part"), path.stem)
            found = self._search(name, problem, noise, kept)
            if path is not None and kept is not None:
                FOUND_FILE.write(path, found)
                kept.remove()
            self.on_found(found)
        if "noise" in found:
            problem = with_noise(problem, NoiseModel(**found["noise"]))
        return problem, found

    def _search(
        self,
        name: str,
        problem: Problem[jaxik.FootIK],
        noise: NoiseOptions,
        kept: KeptStages | None,
    ) -> Found:
        experiment = dataclasses.replace(self.experiment, noise=noise)
        progress = labelled(self.progress, name)
        fitted, solution = search_with_noise(problem, experiment, progress, kept)
        if solution.interrupted:
            raise KeyboardInterrupt
        found: Found = {
            "name": name,
            "u": solution.u.tolist(),
            "cost": solution.cost,
            "converged": solution.converged,
            "message": solution.message,
            "seconds": solution.seconds,
        }
        if noise.estimates_any:
            found["noise"] = dataclasses.asdict(noise_of(fitted))
        return found

    def _path(self, problem: Problem[jaxik.FootIK], noise: NoiseOptions) -> Path | None:
        if self.folder is None:
            return None
        key = digest_with(problem, self.experiment.fit, self.experiment.seed, noise)
        return self.folder / SEARCHES / f"{key[:16]}.json"


def _read(path: Path, size: int) -> Found | None:
    """The result that a file holds, of so many parameters; None if there is no file."""
    if not path.exists():
        return None
    found = FOUND_FILE.read(path)
    with error_context(f"{path}: not written by `jaxik population`"):
        if len(found["u"]) != size:
            raise ValueError(
                f"u has {len(found['u'])} numbers; wanted {size}, one of each parameter; "
                f"{FOUND_FILE.advice}"
            )
        if "noise" in found:
            NoiseModel(**found["noise"])  # checks its numbers
    return found
