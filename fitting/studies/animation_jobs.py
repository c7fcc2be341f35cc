"""Jobs that run finished systems on flat animations, and measure what comes out."""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import jaxik
from fitting.clips import Clip, flight, save_clip
from fitting.clips.formats.saving import check_clip_file
from fitting.ground.meshes import mesh_of
from fitting.motion import accuracy
from fitting.report.formatting import aligned, figures_table, joined
from fitting.runtime import activity
from fitting.runtime.precision import in_float64, with_floats

from . import animations, comparison, comparison_report, suite, suite_report
from .animations import AnimationFiles, load_animation
from .comparison import Comparison
from .fit import run_folder
from .output import output_folder, publish
from .suite import Plan, Suite, SystemsOf


@in_float64
def compare(
    systems: Mapping[str, jaxik.FootIK],
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    rates: Sequence[float] = (),
) -> Comparison:
    """Runs several systems on a flat animation and measures them side by side; warns as `solve`.

    Args:
        systems: by name.
        animation: the clip, the terrain, and where the root is put for all systems.
        output: folder for the table, the numbers, the figure and the page.
        rates: Hz, at which each system runs too, to see how much its motion depends on them.

    Raises:
        ValueError: there is no system, a file cannot be read, a system does not fit the clip or
            gives poses that are not finite, a rate is above the clip's, or the folder cannot be
            made.
    """
    if not systems:
        raise ValueError("systems is empty; wanted one or more")
    with output_folder(output) as folder:
        systems = {name: with_floats(ik, np.float64) for name, ik in systems.items()}
        title = f"{Path(animation.clip).name} on {Path(animation.terrain).name}"
        loaded = load_animation(animation)
        compared = comparison.compare(systems, loaded, title=title)
        differences = animations.measure(systems, loaded, rates)
        compared = dataclasses.replace(compared, rates=differences)
        publish(folder, comparison_report.document(compared))
        for name, cause in compared.causes.items():
            animations.warn(compared.motions[name].measures, loaded.bounds, cause, name)
        return compared


@in_float64
def run_suite(
    systems_of: SystemsOf,
    plan: Plan,
    output: str | Path | None = None,
) -> Suite:
    """Runs systems through made situations and measures each against stated bounds.

    KeyboardInterrupt (Ctrl-C) ends the suite; the finished situations are written and returned,
    with `interrupted` set.

    Args:
        systems_of: makes systems for the body of a rig, by name.
        plan: which situations; see `fitting.studies.suite.choose`.
        output: folder for the table, the numbers, the pictures and the page.

    Raises:
        ValueError: the folder cannot be made.
    """
    with output_folder(output) as folder:
        finished = suite.run_suite(systems_of, plan)
        if finished.interrupted:
            activity.log("interrupted; drawing and writing the finished situations")
        publish(folder, suite_report.document(finished))
        return finished


@in_float64
def apply(
    run: str | Path,
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    with_terrain: bool = False,
) -> Clip:
    """Solves a flat animation with the fitted system of a run; see `solve`.

    Raises:
        ValueError: as `solve`, or the folder holds no finished fit.
    """
    ik = run_folder.load_fitted_system(Path(run), animation.flat_clip.rig)
    return solve(ik, animation, output, with_terrain=with_terrain)


@in_float64
def solve(
    ik: jaxik.FootIK,
    animation: AnimationFiles,
    output: str | Path | None = None,
    *,
    with_terrain: bool = False,
) -> Clip:
    """Solves a flat animation, and measures how its feet are placed on the ground.

    Where a captured motion is known, the log also shows the difference. What is beyond its bound is
    a warning, with the most likely cause of feet off the ground.

    Args:
        ik: the system.
        animation: the clip, the terrain, and where the root is put.
        output: .npz, .bvh, .glb or .csv file for the solved clip; see `save_clip`.
        with_terrain: whether a .glb gets the terrain beside the skeleton.

    Raises:
        ValueError: a file cannot be read or written, or the system does not fit the clip or gives
            poses that are not finite.
    """
    path = None if output is None else Path(output)
    if path is not None:
        check_clip_file(path, with_ground=with_terrain)
        if path.exists() and path.samefile(animation.clip):
            raise ValueError(f"{path}: is the clip that is read; name another file")
    ik, loaded = with_floats(ik, np.float64), load_animation(animation)
    if path is not None:
        check_clip_file(path, loaded.clip)
    loaded.check_shapes(ik)
    began = time.perf_counter()
    with activity.announced("Compiling and running the system"):
        result, solved = loaded.solve(ik)
    seconds = time.perf_counter() - began
    with activity.announced("Measuring how the feet are placed"):
        motion = loaded.place(solved, result)
        cause = loaded.cause(motion)
    if path is not None:
        joints = animations.arrays(motion)
        ground = mesh_of(loaded.terrain) if with_terrain else None
        save_clip(path, solved, joints=joints, ground=ground)
    written = "" if path is None else f"; written to {path}"
    activity.log(f"{solved.frame_count} frames in {seconds:.1f} s{written}")
    where = [
        f"root: {loaded.root.reason}",
        flight.describe(loaded.clip),
        animations.trunk_text(result, solved),
        *(f"note: {remark}" for remark in loaded.clip.remarks),
    ]
    table = figures_table("feet on the ground", {"solved": motion.measures})
    activity.log(joined([*filter(None, where), "", aligned(table)]))
    if loaded.captured is not None:
        errors = accuracy.clip_errors(solved, loaded.captured, loaded.placed_clip)
        accuracies = {"solved": accuracy.summarise([errors])}
        table = figures_table("difference from the captured motion", accuracies)
        activity.log(joined(["", aligned(table)]))
    animations.warn(motion.measures, loaded.bounds, cause)
    return solved
