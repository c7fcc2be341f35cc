"""Studies that need no pipeline: their experiments, and what takes the place of slow parts."""

import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pytest import MonkeyPatch

from fitting.experiment import problems
from fitting.studies import ablation, population
from fitting.studies.animations import Animation
from fitting.studies.calibrate import replicates
from jaxik.maths import parameter_tree

from . import quick
from .experiments import CLIP, write

HALF_SECOND = CLIP + "start = 1.0\nend = 1.5\n"
TWO_HALF_SECONDS = f"{HALF_SECOND}{CLIP}start = 2.0\nend = 2.5\n"
ONE_START = "[fit]\nstarts = 1\n[fit.search]\nagreeing_starts = 1\n"
SIX_SECONDS = CLIP + "end = 6.0\n"
FREE = "pelvis.half_life = {}\nfoot.max_pitch = { low = 0.1 }\n"
GIVEN = '[noise]\ncorrelation = "given"\n'  # what the residuals of a pipeline say is not asked
SQUARES = 'loss = "squares"\n'
SAMPLE = "[sample]\nwalkers = 8\nstop_at = 15.0\nmax_steps = 120\n"
WITHOUT = """
[[without]]
name = "pitch"
parameters = { foot.max_pitch = 0.2 }
[[without]]
name = "both"
parameters = { foot.max_pitch = 0.2, pelvis.half_life = 0.6 }
"""
VARYING = GIVEN + '[hierarchy]\nper_clip = ["pelvis.half_life"]\n'
SUBJECTS = ("ann", "ann", "ben")  # of the clips of a population
MEASURED = ((0.2, 0.41), (0.45, 0.39), (0.3, 0.4))  # in them, in the order of FREE


def quick_fits(patch: MonkeyPatch) -> None:
    """Fits take no time."""
    patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)


# Ablation


def write_ablation(folder: Path, **parts: str) -> Path:
    """Six seconds of the uneven walk, without one parameter and without both."""
    return write(folder, **({"rest": WITHOUT, "clips": SIX_SECONDS} | parts))


def lift(animation, ik):
    """A result that needs no pipeline: everything is raised by the value of a half-life, m."""
    base = animation.clip
    up = [0.0, float(parameter_tree.get(ik, "pelvis.half_life")), 0.0]
    return None, base.with_motion(base.positions_ws + up, base.rotations_ws)


def without_solver(patch: MonkeyPatch) -> None:
    """Replaces the pipeline of animations by `lift`."""
    patch.setattr(Animation, "solve", lift)
    patch.setattr(Animation, "check_shapes", lambda *_: None)


SCENES: dict = {}  # by clip: making one takes longer than the test that uses it


def without_pipeline(patch: MonkeyPatch) -> None:
    """Replaces the pipeline by `lift`, and makes each scene once for all tests."""
    make_scene = problems.make_scene

    def cached(data, sigmas, label, held_out):
        captured = data.reference
        mask = b"" if captured.mask is None else captured.mask.tobytes()
        key = captured.positions_ws.tobytes(), mask, held_out.tobytes(), tuple(sigmas.items())
        if key not in SCENES:
            SCENES[key] = make_scene(data, sigmas, label, held_out)
        return SCENES[key]

    patch.setattr(problems, "make_scene", cached)
    without_solver(patch)
    patch.setattr(ablation.jax, "clear_caches", lambda: None)


def quick_ablation(folder: Path, patch: MonkeyPatch) -> Path:
    """An ablation whose fits take no time."""
    quick_fits(patch)
    without_pipeline(patch)
    return write_ablation(folder, rest=WITHOUT + GIVEN)


# Calibration


def write_calibration(folder: Path, top: str = "", rest: str = SAMPLE) -> Path:
    """Half a second of the uneven walk."""
    more = {"top": SQUARES + top, "rest": rest + GIVEN}
    return write(folder, "hill.toml", clips=HALF_SECOND, free=FREE, **more)


def simulate(problem, u, seed, noise: float = 1.0, shift: float = 0.0):
    """Writes the truth, plus noise and a shift in standard deviations, into the reference."""
    errors = quick.SIGMA * (shift + noise * np.random.default_rng(seed).normal(size=2))
    return quick.with_measured(problem, [quick.values_of(problem.space.unpack(u)) + errors])


def quick_calibration(folder: Path, patch: MonkeyPatch, **wrong: float) -> Path:
    """A calibration whose motion is two numbers, simulated rightly or not."""
    patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_references)
    patch.setattr(replicates, "simulate", functools.partial(simulate, **wrong))
    return write_calibration(folder)


# Population


def write_population(
    folder: Path,
    rest: str = VARYING,
    top: str = "",
    free: str = FREE,
    subjects: Sequence[str] = SUBJECTS,
) -> Path:
    """A clip of a tenth of a second for each subject."""
    clips = "".join(
        f'{CLIP}start = {c}.0\nend = {c}.1\nsubject = "{subject}"\n'
        for c, subject in enumerate(subjects)
    )
    return write(folder, "walks.toml", top=SQUARES + top, clips=clips, free=free, rest=rest)


def error_at(problem, u) -> float:
    """How far two parameters are from what was measured."""
    (scene,) = problem.data
    measured = np.asarray(scene.reference.pelvis.pos[0, :2])
    return float(np.linalg.norm(np.asarray(problem.space.values(u)) - measured))


def quick_population(
    folder: Path,
    patch: MonkeyPatch,
    measured: Sequence = MEASURED,
    rest: str = VARYING,
    subjects: Sequence[str] = SUBJECTS,
) -> Path:
    """A population whose clips are two numbers each."""
    make = problems.make_problem
    patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_references)
    patch.setattr(population, "make_problem", lambda e: quick.with_measured(make(e), measured))
    patch.setattr(population, "error_at", error_at)
    without_solver(patch)
    return write_population(folder, rest, subjects=subjects)


# Many fits


def quick_many(folder: Path, patch: MonkeyPatch) -> Path:
    """Two clips whose fits take no time."""
    quick_fits(patch)
    return write(folder, "walks.toml", clips=TWO_HALF_SECONDS, rest=ONE_START)


# What is on disk

TIMES = {"seconds", "search_seconds", "effort"}


def kept(folder: Path) -> dict[str, Any]:
    """The content of all JSON files of a folder, without how long anything took."""
    paths = sorted(folder.rglob("*.json"))
    contents = {path: json.loads(path.read_text()) for path in paths}
    return {path.relative_to(folder).as_posix(): _timeless(contents[path]) for path in paths}


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(entry) for key, entry in value.items() if key not in TIMES}
    return [_timeless(entry) for entry in value] if isinstance(value, list) else value
