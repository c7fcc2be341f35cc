"""Several systems on one clip: their measures side by side, and a figure."""

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

import jaxik
from fitting.analysis import measures
from fitting.analysis.measures import FootStates, Measures
from fitting.analysis.playback import RAY_START, Motion
from fitting.datasets import clip_frames
from fitting.datasets.clips.clip import Clip
from fitting.experiments import parameter_files
from fitting.experiments.experiment import check_shapes
from fitting.experiments.systems import leaf_names, name_preset
from fitting.report import formatting
from fitting.report.labels import MEASURES, explanations, headings
from fitting.report.plots import comparison_plots, style
from fitting.runtime import files, program_cache
from fitting.runtime.validation import error_context
from jaxik.maths import parameter_tree, vec
from jaxik.world.terrain import Terrain, cast

ANIMATED = "as animated"  # the name of the animation itself, without foot IK
TABLE, NUMBERS, FIGURE = "compare.md", "compare.json", "compare.png"


@dataclass(frozen=True)
class Comparison:
    """One clip under several systems, by name; the animation itself comes first."""

    title: str
    legs: tuple[str, ...]
    fps: float
    ground: Float64[np.ndarray, "frames legs"]  # m, height under the animated ankles; NaN without
    unseen: float  # share of all points of soles that have no ground
    motions: Mapping[str, Motion]
    measures: Mapping[str, Measures]


def name_systems(
    asked: Iterable[tuple[str, str]], *, grounded: bool = True
) -> dict[str, jaxik.FootIK]:
    """The systems that are asked for, by preset or stem of their file, in that order.

    Args:
        asked: the option, `--presets` or `--parameters`, and its text: names of presets, or
            parameter files, with commas between.
        grounded: presets that leave the character's height to their game have it on the ground.

    Raises:
        ValueError: none, the same name twice, a preset or a file that is not there, a bad file.
    """
    systems: dict[str, jaxik.FootIK] = {}
    for option, text in asked:
        for given in (part.strip() for part in text.split(",")):
            if not given:
                raise ValueError(f"{option} {text!r}: wanted names with commas between them")
            of_file = option == "--parameters"
            name = Path(given).stem if of_file else given
            ik = parameter_files.load_system(given)[0] if of_file else name_preset(given)
            if grounded and not of_file and "root.enabled" in leaf_names(ik):
                ik = parameter_tree.replace(ik, {"root.enabled": True})
            if name in (*systems, ANIMATED):
                raise ValueError(f"{option} {text!r}: there already is a system named {name!r}")
            systems[name] = ik
    if not systems:
        raise ValueError("nothing to compare; wanted --presets or --parameters")
    return systems


def solve(
    ik: jaxik.FootIK, clip: Clip, ground: Terrain, motion: jaxik.Frame, floor: float
) -> tuple[jaxik.Result, Clip]:
    """The result of a system on a clip, and the clip as it left it.

    Args:
        ik: the system.
        clip: the animation.
        ground: the terrain.
        motion: the clip as `clip_frames.frames_from_clip` gives it.
        floor: of the clip, m.

    Raises:
        ValueError: for poses that are not finite.
    """
    result = program_cache.run(ik, clip.rig, ground, motion)
    solved = clip_frames.clip_from_result(clip, result, floor=floor)
    if not np.isfinite(solved.positions_ws).all():
        raise ValueError("these parameters give poses that are not finite; nothing was written")
    return result, solved


def compare(
    systems: Mapping[str, jaxik.FootIK],
    clip: Clip,
    ground: Terrain,
    *,
    floor: float = 0.0,
    title: str = "",
    during: Callable[[str], AbstractContextManager] = nullcontext,
) -> Comparison:
    """Runs all systems on a clip and measures what they make of it.

    A foot stands where the animation says so, under every system alike.

    Args:
        systems: by name.
        clip: the flat animation, its bones of the rig's lengths (`base.load_flat_animation`).
        ground: the terrain, y up.
        floor: height of the floor on which the clip was animated, m.
        title: of tables and figures.
        during: a context for the run of a system, given its name.

    Raises:
        ValueError: parameters that do not fit the legs, or that give poses that are not finite.
    """
    motion = clip_frames.frames_from_clip(clip, floor=floor)
    for name, ik in systems.items():
        with error_context(name):
            check_shapes(ik, clip.rig, ground, motion)
    clips = {ANIMATED: clip}
    reached = {ANIMATED: np.full((clip.frame_count, len(clip.rig.joints)), np.nan)}
    for name, ik in systems.items():
        with error_context(name), during(name):
            result, clips[name] = solve(ik, clip, ground, motion, floor)
        found = np.asarray(result.trace.sensed.foothold.found) > 0
        reached[name] = np.where(found, np.asarray(result.reached, np.float64), np.nan)

    depths = measures.sole_depths(clip, floor)
    soles_ws = np.stack([measures.soles(one, depths) for one in clips.values()])
    under = heights_under(ground, soles_ws)
    motions = {name: _motion(one) for name, one in clips.items()}
    measured = {
        name: measures.measure(
            motions[name],
            motions[ANIMATED],
            FootStates(
                measures.gaps(soles_ws[index], under[index]), clip.stance_labels(), reached[name]
            ),
            clip.fps,
        )
        for index, name in enumerate(clips)
    }
    unseen = float(np.mean(np.isnan(under)))
    return Comparison(title, clip.rig.names, clip.fps, under[0, :, :, 0], unseen, motions, measured)


def heights_under(
    ground: Terrain, points_ws: Float64[np.ndarray, "systems ... 3"]
) -> Float64[np.ndarray, "systems ..."]:
    """Height of the ground under the points of several systems, m; NaN where there is none.

    The rays of a point start over the highest place to which any system brings it: an animation
    that is deep in a hill finds the hill's top where another has been lifted onto it.
    """
    highest = points_ws[..., 1].max(axis=0)
    origins = points_ws.copy()
    origins[..., 1] = highest + RAY_START
    hit = cast(ground, jnp.asarray(origins), jnp.inf)
    height = np.asarray(vec.dot(hit.point, ground.up_ws), np.float64)
    return np.where(np.asarray(hit.found) > 0, height, np.nan)


def table(compared: Comparison) -> formatting.Table:
    """A row a system, the measures in the units of `MEASURES`."""
    rows = [
        [name, *(MEASURES[key].format(value) for key, value in asdict(measured).items())]
        for name, measured in compared.measures.items()
    ]
    return [["system", *headings(MEASURES)], *rows]


def write(folder: Path, compared: Comparison) -> None:
    """Writes the table with what it means, the numbers and the figure into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    figure = comparison_plots.overview(
        np.arange(len(compared.ground)) / compared.fps,
        compared.legs,
        compared.ground,
        compared.motions,
        compared.measures,
        compared.title,
    )
    style.save(folder / FIGURE, figure)
    files.write_text(folder / NUMBERS, json.dumps(_numbers(compared), indent=2) + "\n")
    files.write_text(folder / TABLE, _summary(compared))


def _motion(clip: Clip) -> Motion:
    named = clip_frames.positions_by_role(clip)
    return Motion(**{"toe" if part == "ball" else part: at for part, at in named.items()})


def _numbers(compared: Comparison) -> dict:
    """What JSON holds: metres, seconds, radians and shares of 1; null where nothing is known."""
    return {
        "title": compared.title,
        "frames": len(compared.ground),
        "fps": compared.fps,
        "soles_without_ground": compared.unseen,
        "systems": [
            {"name": name}
            | {key: None if np.isnan(value) else value for key, value in asdict(one).items()}
            for name, one in compared.measures.items()
        ],
    }


def _summary(compared: Comparison) -> str:
    count = len(compared.ground)
    parts = [
        f"# {compared.title}",
        f"{count} frames, {(count - 1) / compared.fps:.2f} s at {compared.fps:g} Hz. "
        f"`{ANIMATED}` is the animation without foot IK, on its flat floor.",
        formatting.markdown(table(compared)),
        f"![Feet and pelvis over the ground, and the measures]({FIGURE})",
        "## What the columns mean",
        explanations(MEASURES),
        "Presets that leave the character's height to their game (`unreal`, `mec`) have the root "
        "on the ground below it, unless `--roots animated` was given.",
        "A foot stands where the animation says so: by its contact labels or, without them, by its "
        "motion. The ground under a point is what a ray from above meets first.",
    ]
    if compared.unseen:
        share = formatting.percent(compared.unseen)
        parts.append(f"No ground is under {share} of the soles' points; they are left out.")
    return "\n\n".join(parts) + "\n"
