"""The finished stages of searches and profiles, in a file from which a killed process continues.

A stage follows from the state before it and from nothing else that changes. So a search that is
begun again takes the ends of its first stages from the file, in their order, and computes the
others: the result is to the last bit that of a search without interruption. Jacobians are computed
again, where they are needed.

A fit makes several searches: each has its own list of stages, under a digest of all that it follows
from. Of the profiles of a solution only the last stage is stored, which holds all before it. The
file belongs to one fit, which its identity names; stages of another are not used.
"""

import dataclasses
import time
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, TypedDict

import numpy as np
from jaxtyping import Float

from fitting.problem.problem import Problem, digest_with
from fitting.runtime import activity, program_cache
from fitting.runtime.declarations import count
from fitting.runtime.json_files import Finite, JsonFile, Store, length
from fitting.runtime.validation import Content, in_one_line

from .solution import Elite, Point, Progress, Search, SearchState, Stage, StepsUsedUp

# What a state with the right names and types raises where its numbers make no sense.
DAMAGES = (ValueError, TypeError, KeyError, OverflowError)
SECONDS_BETWEEN_WRITES = 1.0  # a kill loses no more than these and the stage that is running


class StoredPoint(TypedDict):
    """A point without its Jacobian."""

    u: list[Finite]
    cost: float


class StoredElite(TypedDict):
    """The elite of an evolution."""

    u: list[list[Finite]]
    cost: list[float]


class StoredStage(TypedDict):
    """The state in which a stage ended, as far as stages change it."""

    name: str
    point: StoredPoint
    best: StoredPoint
    random: Content
    """State of the random generator."""
    converged: bool
    start_steps: int
    steps: int
    sweeps: int
    elite: StoredElite | None
    history: list[Annotated[Content, Progress]]
    """The lines that the stage added."""
    used_up: bool
    """Whether it ended because the start had no steps left."""


class StoredPoints(TypedDict):
    """Points of a profile."""

    u: list[list[Finite]]
    values: list[list[Finite]]
    cost: list[float]


class StoredProfiles(TypedDict):
    """The profiles of a solution as they were after some stages."""

    stages: Annotated[int, count(0, 100)]
    """Finished ones."""
    curves: list[StoredPoints]
    """Of each parameter."""
    plateaus: StoredPoints
    cliffs: list[Annotated[list[Finite], length(2)]]
    """At which nothing is tried again: index of the parameter, fraction of its range."""
    crossed: bool
    """Whether no further cliff can be crossed."""
    random: Content
    """State of the random generator."""


class StoredSearches(TypedDict):
    """The content of the file."""

    identity: str
    """Of the fit."""
    searches: dict[str, list[StoredStage]]
    profiles: dict[str, StoredProfiles]


FILE = JsonFile(StoredSearches, "the state of a search", "the fit begins anew", indent=None)


class Checkpoints:
    """The stages of the searches and profiles of one fit, in memory and in a file.

    While it is entered as a context, the searches and profiles of this thread go on after its
    stages, and add theirs.
    """

    def __init__(self, folder: Path | None, name: str, identity: str):
        """Reads the stages that a killed process has left; logs why some cannot be used.

        Args:
            folder: of the file; None writes none.
            name: of the file, which is written when a stage is finished.
            identity: of the fit. Stages of another one, or of another version of this program, are
                not used.
        """
        identity = f"{identity} {program_cache.sources()} {dict(program_cache.versions())}"
        self._store = Store(FILE, folder, "the state of another fit, or of another version")
        self._path, self._written = Path(folder or "", name), -np.inf
        begun: StoredSearches = {"identity": identity, "searches": {}, "profiles": {}}
        try:
            self._content = self._store.read(name, {"identity": identity}) or begun
        except ValueError as error:
            self._content = begun
            activity.log(f"{error}")

    def __enter__(self) -> "Checkpoints":
        self._token = _current.set(self)
        return self

    def __exit__(self, *error: object) -> None:
        _current.reset(self._token)

    @property
    def count(self) -> int:
        """Number of stages, of all searches."""
        return sum(map(len, self._content["searches"].values()))

    @property
    def profile_count(self) -> int:
        """Number of stages of profiles."""
        return sum(stored["stages"] for stored in self._content["profiles"].values())

    def recall_profiles(
        self,
        problem: Problem,
        u: Float[np.ndarray, " free"],
        restore: Callable[[StoredProfiles], None],
    ) -> Callable[[StoredProfiles], None]:
        """Calls `restore` with the profiles of a solution, where some of their stages are stored.

        `restore` raises one of `DAMAGES` if they are not profiles of this problem.

        Returns:
            A function that stores the profiles, to call after every stage.
        """
        if self._store.folder is None:
            return lambda stored: None
        profiles, key = self._content["profiles"], digest_with(problem, u.tolist())[:16]
        if key in profiles:
            try:
                restore(profiles[key])
            except DAMAGES as error:
                activity.log(
                    f"{self._path}: damaged ({in_one_line(error)}); the profiles begin anew"
                )
                del profiles[key]

        def store(stored: StoredProfiles) -> None:
            profiles[key] = stored
            self._write()

        return store

    def attach(self, search: Search, state: SearchState, starts: int) -> Search:
        """The search with its stages recalled from here, and stored here."""
        if self._store.folder is None:
            return search
        first = (state.best.u.tolist(), state.random.bit_generator.state)
        key = digest_with(search.problem, search.settings, first, starts)[:16]
        stages = self._content["searches"].setdefault(key, [])
        try:
            for stage in stages:
                _check(stage, state)
        except DAMAGES as error:
            activity.log(f"{self._path}: damaged ({in_one_line(error)}); the search begins anew")
            stages.clear()
        lines = [line for stage in stages for line in stage["history"]]
        elapsed = lines[-1]["seconds"] if lines else 0.0
        recall = _Recall(stages, self._write)
        return dataclasses.replace(search, began=search.began - elapsed, recall=recall)

    def flush(self) -> None:
        """Writes what is not on disk yet."""
        if self.count or self.profile_count:
            self._store.write(self._path.name, self._content)
            self._written = time.monotonic()

    def remove(self) -> None:
        """Deletes the file: the fit is finished."""
        self._store.remove(self._path.name)

    def _write(self) -> None:
        if time.monotonic() - self._written >= SECONDS_BETWEEN_WRITES:
            self.flush()


_current: ContextVar[Checkpoints | None] = ContextVar("current", default=None)


def current() -> Checkpoints:
    """The checkpoints that are entered; else some that store nothing."""
    return _current.get() or Checkpoints(None, "", "")


@dataclasses.dataclass
class _Recall:
    """Gives a search the ends of its stages, first those that are stored."""

    stages: list[StoredStage]
    write: Callable[[], None]
    position: int = 0

    def __call__(self, search: Search, name: str, state: SearchState, stage: Stage) -> SearchState:
        used_up = False
        if self.position < len(self.stages):
            stored = self.stages[self.position]
            after, used_up = _restored(stored, state), stored["used_up"]
            search.reached(after)
        else:
            try:
                after = stage()
            except StepsUsedUp as error:
                after, used_up = error.state, True
            self.stages.append(_stored(name, state, after, used_up))
            self.write()
        self.position += 1
        if used_up:
            raise StepsUsedUp(after)
        return after


def _stored(name: str, before: SearchState, after: SearchState, used_up: bool) -> StoredStage:
    """A stage that led from one state to another."""
    elite = after.elite
    return {
        "name": name,
        "point": _stored_point(after.point),
        "best": _stored_point(after.best),
        "random": dict(after.random.bit_generator.state),
        "converged": after.converged,
        "start_steps": after.start_steps,
        "steps": after.steps,
        "sweeps": after.sweeps,
        "elite": elite and {"u": elite.u.tolist(), "cost": elite.cost.tolist()},
        "history": [dataclasses.asdict(line) for line in after.history[len(before.history) :]],
        "used_up": used_up,
    }


def _stored_point(point: Point) -> StoredPoint:
    return {"u": point.u.tolist(), "cost": point.cost}


def _restored(stored: StoredStage, before: SearchState) -> SearchState:
    """The state after a stage."""
    random = np.random.default_rng()
    random.bit_generator.state = stored["random"]
    elite = stored["elite"]
    return dataclasses.replace(
        before,
        point=_point(stored["point"], before),
        best=_point(stored["best"], before),
        random=random,
        converged=stored["converged"],
        start_steps=stored["start_steps"],
        steps=stored["steps"],
        sweeps=stored["sweeps"],
        elite=elite and Elite(np.array(elite["u"]), np.array(elite["cost"])),
        history=(*before.history, *(Progress(**line) for line in stored["history"])),
    )


def _check(stored: StoredStage, state: SearchState) -> None:
    """Raises one of `DAMAGES` for a stage of another search."""
    restored, size = _restored(stored, state), len(state.point.u)
    elite = np.empty((0, size)) if restored.elite is None else restored.elite.u
    if {len(restored.point.u), len(restored.best.u), elite.shape[-1]} != {size}:
        raise ValueError(f"a point has not {size} numbers")


def _point(stored: StoredPoint, before: SearchState) -> Point:
    """The point, with its Jacobian where the search has met it just now."""
    u = np.array(stored["u"])
    for known in (before.best, before.point):
        if np.array_equal(u, known.u) and stored["cost"] == known.cost:
            return known
    return Point(u, stored["cost"])
