"""What is fitted: each clip of each experiment, with each seed, in a run folder of its own.

runs/EXPERIMENT/CLIP/seed_0   where a clip is fitted alone
runs/EXPERIMENT/seed_0        where the clips of an experiment are fitted together
"""

import dataclasses
import functools
import hashlib
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from fitting.experiments import captures
from fitting.experiments.experiment import ClipEntry, Experiment
from fitting.experiments.experiment_files import experiment_to_toml
from fitting.studies.hierarchy.population import clip_names

RUNS = "runs"
TOGETHER = "all clips"
MAX_SEEDS = 10_000


@dataclasses.dataclass(frozen=True)
class FitTask:
    """One fit."""

    experiment: Experiment
    """As it is fitted: with its own clips and seed."""
    name: str
    """Of the experiment from which it comes."""
    clip: str
    run: Path
    """From the folder of all fits."""

    def identity(self) -> str:
        """64 characters that change with the experiment and with the content of its files."""
        entries = tuple(_with_paths(entry, _name_of) for entry in self.experiment.clips)
        text = experiment_to_toml(dataclasses.replace(self.experiment, clips=entries))
        contents = [
            _digest(value)
            for entry in self.experiment.clips
            for value in vars(entry).values()
            if isinstance(value, Path)
        ]
        return hashlib.sha256(repr((text, contents)).encode()).hexdigest()


def plan(
    experiments: Sequence[Experiment], seeds: int = 1, *, together: bool = False
) -> list[FitTask]:
    """All fits, in the order of experiments, clips and seeds.

    Args:
        experiments: each with one clip or more.
        seeds: fits of each clip, with the experiment's seed and those that follow it.
        together: whether the clips of an experiment are fitted together, as `jaxik fit` does.

    Raises:
        ValueError: there is no experiment, or not one seed; a capture of one of several clips is
            fitted, which each would be alone.
    """
    if not experiments:
        raise ValueError("no experiments; wanted one or more")
    if not 1 <= seeds <= MAX_SEEDS:
        raise ValueError(f"seeds is {seeds}; wanted 1 to {MAX_SEEDS}")
    names = _distinct([_stem(experiment) for experiment in experiments])
    tasks = []
    for name, experiment in zip(names, experiments, strict=True):
        for clip, part, folder in _parts(_with_whole_paths(experiment), together=together):
            for seed in range(experiment.seed, experiment.seed + seeds):
                run = Path(RUNS, name, *folder, f"seed_{seed}")
                tasks.append(FitTask(dataclasses.replace(part, seed=seed), name, clip, run))
    return tasks


def _parts(
    experiment: Experiment, *, together: bool
) -> list[tuple[str, Experiment, tuple[str, ...]]]:
    """The name of what is fitted, its experiment, and its folder."""
    clips = clip_names(experiment.clips)
    if together:
        return [(clips[0] if len(clips) == 1 else TOGETHER, experiment, ())]
    captures.check_unnumbered(experiment.capture, str(experiment.path))
    folders = _distinct([_file_name(clip) for clip in clips])
    return [
        (clip, _alone(experiment, entry), (folder,))
        for clip, entry, folder in zip(clips, experiment.clips, folders, strict=True)
    ]


def _alone(experiment: Experiment, entry: ClipEntry) -> Experiment:
    """The experiment with one of its clips, from which nothing differs any more."""
    shared = dataclasses.replace(experiment.hierarchy, per_clip=(), per_subject=())
    whole = None if experiment.whole is None else _alone(experiment.whole, entry)
    return dataclasses.replace(experiment, clips=(entry,), hierarchy=shared, whole=whole)


def _with_whole_paths(experiment: Experiment) -> Experiment:
    """The experiment for a process in another folder."""
    whole = None if experiment.whole is None else _with_whole_paths(experiment.whole)
    clips = tuple(_with_paths(entry, Path.absolute) for entry in experiment.clips)
    return dataclasses.replace(experiment, clips=clips, whole=whole)


def _stem(experiment: Experiment) -> str:
    return _file_name(experiment.path.stem or experiment.name or "experiment")


def _file_name(text: str) -> str:
    """A name as a folder may have it on any system."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._")[:80] or "unnamed"


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, with a number where several are alike."""
    counts = Counter(name.casefold() for name in names)
    return [
        f"{name}_{number}" if counts[name.casefold()] > 1 else name
        for number, name in enumerate(names, 1)
    ]


def _with_paths(entry: ClipEntry, change: Callable[[Path], Path]) -> ClipEntry:
    """An entry with each of its paths changed."""
    paths = {key: change(value) for key, value in vars(entry).items() if isinstance(value, Path)}
    return dataclasses.replace(entry, **paths)


def _name_of(path: Path) -> Path:
    """A file by its name only: it may be moved."""
    return Path(path.name)


def _digest(path: Path) -> str:
    """Of a file's content; of one that cannot be read, why, which the fit then says better."""
    try:
        status = path.stat()
        return _digest_of_state(path, status.st_size, status.st_mtime_ns)
    except OSError as error:
        return str(error.strerror)


@functools.lru_cache(maxsize=4096)  # a terrain may belong to thousands of clips
def _digest_of_state(path: Path, size: int, changed: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
