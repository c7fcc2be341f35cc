"""Several systems on one flat animation, measured side by side."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64

import jaxik
from fitting.clips import Clip
from fitting.clips.clip_frames import positions_by_role
from fitting.experiment.parameter_files import load_system
from fitting.experiment.systems import preset_system
from fitting.ground import ground_patch
from fitting.ground.ground_patch import GroundPatch
from fitting.motion import accuracy, measures
from fitting.motion.accuracy import Accuracy
from fitting.motion.measures import (
    Cause,
    FootStates,
    Measures,
    PlacedMotion,
    Placement,
    Soles,
    place,
    with_soles_of,
)
from fitting.motion.playback import RAY_START, Motion
from fitting.motion.worst_window import SECONDS
from fitting.runtime import activity
from fitting.runtime.display import Shown, data_frame
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context
from jaxik.maths import vec
from jaxik.world.terrain import Terrain, cast

from .animations import Animation, RateDifference
from .fit.run_folder import PARAMETERS
from .suite import Scene

if TYPE_CHECKING:
    import pandas


ANIMATED = "as animated"  # the name of the animation itself, without foot IK


@dataclass(frozen=True)
class Comparison(Shown):
    """One clip under several systems, by name; the animation itself comes first."""

    title: str
    legs: tuple[str, ...]
    fps: float
    ground: Float64[np.ndarray, "frames legs"]
    """m, height under the animated ankles, or NaN."""
    groundless: float
    """Fraction of all points of soles that have no ground under them."""
    animation: Animation
    clips: Mapping[str, Clip]
    """As the systems leave it."""
    motions: Mapping[str, Motion]
    measures: Mapping[str, Measures]
    placements: Mapping[str, tuple[Placement, Cause | None]]
    """Of the systems, without the animation; see `Animation.assess`."""
    rates: Sequence[RateDifference] = ()
    """At other frame rates, system by system."""

    def table(self) -> "pandas.DataFrame":
        """The measures in SI units, a row for each system, as pandas has tables.

        Raises:
            ImportError: pandas is not installed.
        """
        rows = ({"system": name} | vars(measures) for name, measures in self.measures.items())
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
) -> Comparison:
    """Runs all systems on an animation and measures the motions.

    Stances are those of the animation, the same for every system.

    Args:
        systems: by name.
        animation: the flat animation and the terrain, y up.
        title: of tables and figures.

    Raises:
        ValueError: parameters do not fit the legs, or give poses that are not finite.
    """
    clip = animation.placed_clip
    for name, ik in systems.items():
        with error_context(name):
            animation.check_shapes(ik)
    clips = {ANIMATED: clip}
    reached = {ANIMATED: np.full((clip.frame_count, len(clip.rig.joints)), np.nan)}
    for name, ik in systems.items():
        with error_context(name), activity.announced(f"Compiling and running {name}"):
            result, clips[name] = animation.solve(ik)
        reached[name] = animation.reached(result)

    with activity.announced("Measuring the motions"):
        soles_ws = np.stack([measures.sole_points(solved) for solved in clips.values()])
        ground = ground_heights(animation.terrain, soles_ws)
        motions = {name: motion_of(solved) for name, solved in clips.items()}
        measured = {}
        for index, name in enumerate(clips):
            gaps = measures.gaps(soles_ws[index], ground[index])
            gaps[~clip.observed] = np.nan
            feet = FootStates(gaps, clip.observed_stances(), reached[name])
            measured[name] = measures.measure(
                motions[name], motions[ANIMATED], feet, clip.fps, clip.cuts
            )
        return Comparison(
            title=title,
            legs=clip.rig.names,
            fps=clip.fps,
            ground=ground[0, :, :, 0],
            groundless=float(np.mean(np.isnan(ground))),
            animation=animation,
            clips=clips,
            motions=motions,
            measures=measured,
            placements={name: animation.assess(clips[name]) for name in systems},
        )


def ground_heights(
    terrain: Terrain, points_ws: Float64[np.ndarray, "systems ... 3"]
) -> Float64[np.ndarray, "systems ..."]:
    """Height of the ground under points of several systems, m; NaN where there is none.

    The rays for a point start above the highest place where any system puts it, so that an
    animation deep inside a hill finds the top of the hill, as a system does that climbs it.
    """
    highest = points_ws[..., 1].max(axis=0)
    origins = points_ws.copy()
    origins[..., 1] = highest + RAY_START
    hit = cast(terrain, jnp.asarray(origins), jnp.inf)
    height = np.asarray(vec.dot(hit.point, terrain.up_ws), np.float64)
    return np.where(np.asarray(hit.found) > 0, height, np.nan)


def motion_of(clip: Clip) -> Motion:
    """Joints of a clip by their role."""
    joints = positions_by_role(clip)
    return Motion(**{"toe" if role == "ball" else role: at for role, at in joints.items()})


@dataclass(frozen=True)
class ComparedMotions:
    """What several systems make of one animation."""

    motions: Mapping[str, PlacedMotion]
    """By name; the animation itself comes first, with its root where foot IK gets it."""
    worst: Mapping[str, tuple[int, int]]
    """First and last frame of the `SECONDS` in which the feet of each are furthest off."""
    captured: PlacedMotion | None
    """Where it is known."""
    accuracy: Mapping[str, Accuracy]
    """How far each is from the captured motion; of none where that is unknown."""
    stance: Bool[np.ndarray, "frames legs"]
    """Where the animation says that a foot stands."""
    ground: GroundPatch


@in_float64
def of_comparison(comparison: Comparison) -> ComparedMotions:
    """The motions of a comparison."""
    animation = comparison.animation
    measured = {name: animation.place(clip) for name, clip in comparison.clips.items()}
    return _compared(animation, comparison.clips, measured)


@in_float64
def of_scene(scene: Scene) -> ComparedMotions:
    """The motions of a situation of the suite, without systems that gave none."""
    animation = scene.animation
    clips = {name: outcome.clip for name, outcome in scene.outcomes.items()}
    measured = {name: (own.soles, own.placement) for name, own in scene.outcomes.items()}
    flat = animation.placed_clip
    first = {ANIMATED: flat}, {ANIMATED: animation.place(flat)}
    return _compared(animation, first[0] | clips, first[1] | measured)


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
    sums = np.convolve(off, np.ones(frames), mode="valid")
    start = int(np.argmax(sums))
    return start, start + frames - 1


def _compared(
    animation: Animation,
    clips: Mapping[str, Clip],
    measured: Mapping[str, tuple[Soles, Placement]],
) -> ComparedMotions:
    flat, captured = animation.placed_clip, animation.captured
    if captured is not None:
        captured = with_soles_of(captured, animation.clip)
    # Rays start above the highest motion, so that one inside a hill does not hide the hill.
    highest = max(clips.values(), key=lambda clip: float(clip.positions_ws[..., 1].max()))
    return ComparedMotions(
        motions={name: place(clip, *measured[name]) for name, clip in clips.items()},
        worst={name: worst_seconds(feet, flat.fps) for name, (feet, _) in measured.items()},
        captured=None if captured is None else place(captured, *animation.place(captured)),
        accuracy={
            name: accuracy.summarise([accuracy.clip_errors(clip, captured, flat)])
            for name, clip in clips.items()
        }
        if captured is not None
        else {},
        stance=flat.stance_labels(),
        ground=ground_patch.around_path(highest, animation.terrain),
    )
