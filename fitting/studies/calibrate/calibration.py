"""Many replicates of an experiment, each kept on disk as soon as it is finished.

identity.json           what is calibrated; another experiment is refused
fits/0000.json          the fit of a replicate
chains/0000.json        its posterior, where chains were wanted
wrong_model/0000.json   the fit of a replicate whose motion another system makes

A call continues where an earlier one ended, also with more replicates, or with chains for fits that
have none yet. All replicates of a process share their compiled programs.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict, TypeVar

import numpy as np

import jaxik
from fitting.experiment.experiment import Experiment
from fitting.problem.problem import Problem, digest
from fitting.runtime import activity, cluster
from fitting.runtime.json_files import JsonFile
from fitting.runtime.store import Store
from fitting.runtime.validation import Content, error_context
from fitting.studies.translation import NamedSystem

from . import wrong_model
from .replicates import (
    LOG_PROBABILITY,
    ReplicateChain,
    ReplicateFit,
    chain_line,
    fit_line,
    fit_replicate,
    sample_replicate,
)
from .wrong_model import WrongModelFit, fit_wrong_model, identity_of

if TYPE_CHECKING:
    from distributed import Client

IDENTITY, FITS, CHAINS, WRONG_MODEL = "identity.json", "fits", "chains", "wrong_model"
WRITER, ADVICE = "written by `jaxik calibrate`", "delete it to make it anew, or name another folder"
FILES = {
    FITS: JsonFile(ReplicateFit, WRITER, ADVICE),
    CHAINS: JsonFile(ReplicateChain, WRITER, ADVICE),
    WRONG_MODEL: JsonFile(WrongModelFit, WRITER, ADVICE),
}
LINES: dict[str, Callable[[Any], str]] = {
    FITS: fit_line,
    CHAINS: chain_line,
    WRONG_MODEL: wrong_model.fit_line,
}
WORDS = {FITS: "fits", CHAINS: "chains", WRONG_MODEL: "fits"}  # for what a stage makes
PER_PARAMETER = ("truth_u", "truth", "truth_levels", "parameters")
Result = TypeVar("Result", bound=Mapping[str, Any])


class Identity(TypedDict):
    """What is calibrated: everything that a replicate follows from, except the program itself."""

    name: str
    problem: str
    """Digest."""
    start: list[float]
    seed: int
    noise_factor: float
    noise: Content
    fit: Content
    sample: Content
    truth: NotRequired[Content]
    """Of another system, where one makes the motion; see `wrong_model.identity_of`."""


IDENTITY_FILE = JsonFile(Identity, WRITER, "name another folder")


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Finished replicates, in the order of their numbers."""

    fits: list[ReplicateFit]
    chains: list[ReplicateChain]
    """None, or as many as there are fits."""


def calibrate(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    folder: Path | None,
    replicates: int,
    *,
    chains: bool = False,
    noise_factor: float = 1.0,
    client: "Client | None" = None,
) -> Calibration:
    """Makes the replicates that a folder does not hold yet: first all fits, then all chains.

    An interrupt (Ctrl-C) loses the fit or the chain that is running and no other.

    Args:
        experiment: its settings of the search and the sampler, and the seed.
        problem: of the experiment; its references only say which frames count.
        folder: where finished replicates are kept. None keeps them in memory.
        replicates: number of truths.
        chains: whether each posterior is sampled, too.
        noise_factor: how much larger the simulated noise is than the experiment says.
        client: of the Dask cluster that computes. None computes in this process.

    Raises:
        ValueError: there is not one replicate; the noise is not positive; the folder holds
            something else; a replicate cannot be made.
    """
    _begin(folder, replicates, _identity(experiment, problem, noise_factor))
    names = problem.space.names
    stage = functools.partial(_Stage, folder, replicates, client, names)
    fit = functools.partial(fit_replicate, problem, experiment, noise_factor=noise_factor)
    fits = stage(FITS).run(fit, range(replicates))
    if not chains:
        return Calibration(fits, [])
    sample = functools.partial(sample_replicate, problem, experiment, noise_factor=noise_factor)
    return Calibration(fits, stage(CHAINS).run(sample, fits))


def calibrate_wrong_model(
    experiment: Experiment,
    problem: Problem[jaxik.FootIK],
    truth: NamedSystem,
    folder: Path | None,
    replicates: int,
    *,
    noise_factor: float = 1.0,
    client: "Client | None" = None,
) -> list[WrongModelFit]:
    """Makes the replicates that a folder does not hold yet, of motion that another system makes.

    Args:
        experiment: as for `calibrate`.
        problem: of the experiment; some of its frames are held out.
        truth: the other system.
        folder: as for `calibrate`.
        replicates: number of truths.
        noise_factor: how much larger the errors of the captures are than usual.
        client: as for `calibrate`.

    Raises:
        ValueError: as `calibrate`, or no frame is held out.
    """
    if not any(np.any(scene.reference.held_out) for scene in problem.data):
        raise ValueError(
            f"{experiment.path}: no frame is held out, which would show what a fit under a wrong "
            "model is worth; give `holdout` a fraction above 0, and clips 3 s or more"
        )
    identity = _identity(experiment, problem, noise_factor)
    _begin(folder, replicates, {**identity, "truth": identity_of(truth)})
    stage = _Stage(folder, replicates, client, problem.space.names, WRONG_MODEL)
    fit = functools.partial(fit_wrong_model, problem, experiment, truth.ik)
    return stage.run(functools.partial(fit, noise_factor=noise_factor), range(replicates))


def _begin(folder: Path | None, replicates: int, identity: Identity) -> None:
    """Checks what all kinds of replicates have in common, and claims the folder."""
    if replicates < 1:
        raise ValueError(f"replicates is {replicates}; wanted 1 or more")
    factor = identity["noise_factor"]
    if not 0 < factor < math.inf:
        raise ValueError(f"noise_factor is {factor:g}; wanted a positive number")
    if folder is not None:
        _claim(folder, identity)


@dataclasses.dataclass(frozen=True)
class _Stage:
    """The fits, or the chains, of all replicates."""

    folder: Path | None
    replicates: int
    client: "Client | None"
    parameters: Sequence[str]
    """Their names."""
    name: str

    def run(self, make: Callable[[Any], Result], arguments: Sequence[Any]) -> list[Result]:
        """The results of all replicates; those that the folder has are not made again.

        Args:
            make: makes one from its argument.
            arguments: of each replicate.
        """
        other = f"not {WRITER}: it is of replicate {{number}}"
        store: Store[Any] = Store(FILES[self.name], self.folder, other, self._check)
        paths = [f"{self.name}/{number:04}.json" for number in range(self.replicates)]
        stored = [store.read(path, {"number": number}) for number, path in enumerate(paths)]
        results: dict[int, Result] = {n: row for n, row in enumerate(stored) if row is not None}
        missing = [number for number in range(self.replicates) if number not in results]
        title = f"Making the {WORDS[self.name]} of {self.replicates} replicates"
        with activity.announced(title, self.replicates, done=len(results)) as making:
            for number, call in self._calls(make, arguments, missing):
                with error_context(f"replicate {number + 1}"):
                    result = call()
                store.write(paths[number], result)
                results[number] = result
                activity.report(result)
                activity.log(LINES[self.name](result))
                making.advance()
        return [results[number] for number in range(self.replicates)]

    def _calls(
        self, make: Callable[[Any], Result], arguments: Sequence[Any], missing: Sequence[int]
    ) -> Iterator[tuple[int, Callable[[], Result]]]:
        """What to call for each missing replicate, and its number; as they end on a cluster."""
        if self.client is None:
            for number in missing:
                yield number, functools.partial(make, arguments[number])
            return
        wanted = [arguments[number] for number in missing]
        for index, future in cluster.compute(self.client, make, wanted):
            yield missing[index], future.result

    def _check(self, result: Mapping[str, Any]) -> None:
        """Raises ValueError for a result of other parameters, or one that contradicts itself."""
        for key, names in self._names(result).items():
            if sorted(names) != sorted(self.parameters):
                raise ValueError(f"{key} has {names}; wanted {self.parameters}")
        sizes = {key: len(result[key]) for key in PER_PARAMETER if key in result}
        if len(set(sizes.values())) > 1:
            raise ValueError(f"its lists have different lengths, {sizes}")

    def _names(self, result: Mapping[str, Any]) -> dict[str, list[str]]:
        """The parameters of which a result says something, in each of its parts."""
        if self.name != CHAINS:
            return {"parameters": [row["name"] for row in result["parameters"]]}
        ranks = set(result["ranks"]) ^ {LOG_PROBABILITY}  # which is ranked beside them
        return {"ranks": list(ranks), "intervals": list(result["intervals"])}


def _claim(folder: Path, own: Identity) -> None:
    """Writes into a folder what is calibrated there, or compares it with what is written there.

    Raises:
        ValueError: the folder is that of another calibration, or of something else.
    """
    if not (folder / IDENTITY).exists() and any((folder / name).exists() for name in FILES):
        raise ValueError(f"{folder}: has replicates but no {IDENTITY}; name another folder")
    other = "holds the calibration of {name!r}, which differs from this one in: {changed}"
    key = {**own, "truth": own.get("truth")}
    del key["name"]
    Store(IDENTITY_FILE, folder, other).remember(IDENTITY, lambda: own, key)


def _identity(
    experiment: Experiment, problem: Problem[jaxik.FootIK], noise_factor: float
) -> Identity:
    identity: Identity = {
        "name": experiment.name,
        "problem": digest(problem),
        "start": np.asarray(problem.space.start).tolist(),
        "seed": experiment.seed,
        "noise_factor": noise_factor,
        "noise": dataclasses.asdict(experiment.noise),
        "fit": dataclasses.asdict(experiment.fit),
        "sample": dataclasses.asdict(experiment.sample),
    }
    return json.loads(json.dumps(identity))
