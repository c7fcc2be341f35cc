"""Several systems on one flat animation, measured side by side."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import jaxik
from fitting.experiment.parameter_files import load_system
from fitting.experiment.systems import preset_system
from fitting.motion import accuracy
from fitting.motion.accuracy import Accuracy
from fitting.motion.measures import (
    MEASURES,
    Bounded,
    Cause,
    PlacedMotion,
    Soles,
    with_soles_of,
)
from fitting.motion.worst_window import SECONDS, window_sums
from fitting.runtime import activity
from fitting.runtime.display import Shown, data_frame
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context

from .animations import Animation, RateDifference
from .fit.run_folder import PARAMETERS

if TYPE_CHECKING:
    import pandas


ANIMATED = "as animated"  # the name of the animation itself, without foot IK


@dataclass(frozen=True)
class Comparison(Shown):
    """One clip under several systems, by name; the animation itself comes first."""

    title: str
    animation: Animation
    motions: Mapping[str, PlacedMotion]
    """The animation as foot IK gets it, and what systems make of it."""
    causes: Mapping[str, Cause | None]
    """Why feet are off their ground, of the systems; None where they are not."""
    failures: Mapping[str, str] = field(default_factory=dict)
    """What went wrong, of systems that gave no motion."""
    rates: Sequence[RateDifference] = ()
    """At other frame rates, system by system."""

    @property
    def animated(self) -> PlacedMotion:
        """The animation as foot IK gets it."""
        return self.motions[ANIMATED]

    @property
    def systems(self) -> tuple[str, ...]:
        """Names of the systems that gave a motion."""
        return tuple(self.causes)

    @property
    def bounds(self) -> dict[str, float]:
        """The bounds of all systems, by measure."""
        return self.animation.bounds

    @cached_property
    def captured(self) -> PlacedMotion | None:
        """The captured motion, where it is known."""
        captured = self.animation.captured
        if captured is None:
            return None
        return self.animation.place(with_soles_of(captured, self.animation.clip))

    @cached_property
    def accuracy(self) -> dict[str, Accuracy]:
        """How far each is from the captured motion; of none where that is unknown."""
        captured, flat = self.animation.captured, self.animated.clip
        if captured is None:
            return {}
        return {
            name: accuracy.summarise([accuracy.clip_errors(motion.clip, captured, flat)])
            for name, motion in self.motions.items()
        }

    def against(self, system: str) -> list[Bounded]:
        """What is measured of a system beside its bounds, the worst first."""
        return self.motions[system].measures.against(self.bounds)

    def table(self) -> "pandas.DataFrame":
        """The measures in SI units, a row for each system, as pandas has tables.

        Raises:
            ImportError: pandas is not installed.
        """
        rows = (
            {"system": name} | {key: getattr(motion.measures, key) for key in MEASURES}
            for name, motion in self.motions.items()
        )
        return data_frame(rows, "system")


@in_float64
def named_systems(
    options: Iterable[tuple[str, str]], rig: jaxik.Rig | None = None
) -> dict[str, jaxik.FootIK]:
    """Systems by the name of their preset, parameter file or run, in the order of the options.

    Args:
        options: pairs of `--presets` and names of presets, or of `--parameters` and parameter
            files or folders of runs, separated by commas.
        rig: whose body they are for; None is the adult.

    Raises:
        ValueError: there is no system; a name occurs twice; a preset or a file does not exist, or
            a file is wrong.
    """
    entries = []
    for option, text in options:
        for entry in (part.strip() for part in text.split(",")):
            if not entry:
                raise ValueError(f"{option} {text!r}: wanted names with commas between them")
            entries.append((option, entry))
    files = _file_names([Path(entry) for option, entry in entries if option == "--parameters"])
    systems: dict[str, jaxik.FootIK] = {}
    for option, entry in entries:
        is_file = option == "--parameters"
        name = files[Path(entry)] if is_file else entry
        if name in (*systems, ANIMATED):
            raise ValueError(f"{option} {entry!r}: there already is a system named {name!r}")
        systems[name] = (
            load_system(_parameter_file(Path(entry)), rig)[0]
            if is_file
            else preset_system(entry, rig)
        )
    if not systems:
        raise ValueError("nothing to compare; wanted --presets or --parameters")
    return systems


def _parameter_file(path: Path) -> Path:
    """The parameter file at a path, or in the folder of a run."""
    return path / PARAMETERS if path.is_dir() else path


def _file_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Short names of parameter files: their stem, and of a run's that of its folder.

    Those that would be alike have as many folders before them as it takes.
    """
    parts = {}
    for path in paths:
        whole = _parameter_file(path).resolve()
        parts[path] = (
            whole.parent.parts if whole.name == PARAMETERS else whole.with_suffix("").parts
        )
    names = {}
    for path, own in parts.items():
        endings = range(1, len(own) + 1)
        alone = (n for n in endings if sum(x[-n:] == own[-n:] for x in parts.values()) == 1)
        names[path] = "/".join(own[-next(alone, 1) :])
    return names


def compare(
    systems: Mapping[str, jaxik.FootIK],
    animation: Animation,
    *,
    title: str = "",
    keep_going: bool = False,
) -> Comparison:
    """Runs all systems on an animation and measures the motions.

    Stances are those of the animation, the same for every system.

    Args:
        systems: by name.
        animation: the flat animation and the terrain, y up.
        title: of tables and figures.
        keep_going: whether a system that gives no motion is noted, and the others go on.

    Raises:
        ValueError: parameters do not fit the legs, or give poses that are not finite.
    """
    if not keep_going:
        for name, ik in systems.items():
            with error_context(name):
                animation.check_shapes(ik)
    solved, failures = {}, {}
    for name, ik in systems.items():
        try:
            with activity.announced(f"Compiling and running {name}"):
                animation.check_shapes(ik)
                solved[name] = animation.solve(ik)
        except ValueError as error:
            if not keep_going:
                raise ValueError(f"{name}: {error}") from error
            failures[name] = str(error)
    with activity.announced("Measuring the motions"):
        motions = {ANIMATED: animation.place(animation.placed_clip)}
        motions |= {name: animation.place(clip, result) for name, (result, clip) in solved.items()}
        causes = {name: animation.cause(motions[name]) for name in solved}
    return Comparison(title, animation, motions, causes, failures)


def worst_seconds(feet: Soles, fps: float) -> tuple[int, int]:
    """First and last frame of the `SECONDS` in which feet are furthest off their ground.

    What counts is the depth of any foot in the ground and the height of standing ones above it,
    summed over feet and frames. A foot without ground counts for nothing.

    Args:
        feet: soles over the ground.
        fps: frames per second.
    """
    gap = np.nan_to_num(feet.gap)
    off = np.sum(np.maximum(-gap, 0.0) + np.where(feet.stance, np.maximum(gap, 0.0), 0.0), axis=1)
    frames = min(len(off), round(SECONDS * fps) + 1)
    start = int(np.argmax(window_sums(off, frames)))
    return start, start + frames - 1
