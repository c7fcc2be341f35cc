"""Run folders that need no search: fits with invented numbers."""

import dataclasses
import re
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fitting.experiment import experiment_files, problems
from fitting.inference.identifiability import Identifiability
from fitting.inference.optimise.solution import Progress, Solution
from fitting.motion import playback
from fitting.motion.playback import ClipActivity
from fitting.studies.fit import fit_report, run_folder
from fitting.studies.fit.fit import Fit
from fitting.studies.fit.fit_report import Measured

from .experiments import CLIP, ROOT, write
from .profiles import parabolas

LIMITS = {"leg.max_knee_angle": 0.5, "pelvis.limit": 0.0}  # fractions of the frames
NAMES = ("pelvis.half_life", "foot.max_pitch")


def invented_fit(folder: Path, more: str = "", clips: str = CLIP) -> Fit:
    """A fit with invented numbers; its experiment, with more tables, is written to the folder."""
    rest = f"[sigmas]\nbody = inf\ncorrelation = 0.4\n[parameters]\nlock.enabled = false\n{more}"
    top = "faithful = true"  # compiles in two thirds of the time
    path = write(folder, top=top, rest=rest, clips=clips, clip="start = 1.0\nend = 1.5")
    experiment = experiment_files.load_experiment(path)
    problem = problems.make_problem(experiment)
    u = np.array([0.3, -0.2])
    solution = Solution(
        names=NAMES,
        u=u,
        values=np.asarray(problem.space.values(jnp.asarray(u))),
        cost_before=90.0,
        cost=10.0,
        converged=True,
        message="Converged.",
        jacobian=np.zeros((1, 2)),
        history=(Progress("start", 0, 0, 90.0, 90.0, 1.0),),
        steps=8,
        seconds=9.0,
    )
    identifiability = Identifiability(
        names=NAMES,
        contraction=np.array([0.9, 0.2]),
        profiles=parabolas(problem.space.parameters, [(0.1, 0.4), (0.2, 0.9)]),
        sd=np.array([0.01, np.nan]),
        at_bound=("", "high"),
        eigenvalues=np.array([0.1, 20.0]),
        weakest=("foot.max_pitch",),
        correlated=((*NAMES, 0.95),),
        ridges=(),
        best_u=u,
        best_cost=10.0,
        improvement=0.0,
    )
    return Fit(experiment, problem, solution, identifiability)


def with_own_files(folder: Path) -> Fit:
    """The fit with its clips, of which the folder has copies, beside which files may be written."""
    for name in ("uneven_walk.npz", "uneven_walk_base.npz"):
        shutil.copy(ROOT / "data" / "clips" / name, folder)
    clips = CLIP.replace(f"{ROOT}/data/clips", f"{folder}")
    return with_clips(invented_fit(folder, clips=clips))


def with_clips(fitted: Fit) -> Fit:
    """The fit with the clips of its problem, which its page shows."""
    return dataclasses.replace(fitted, clips=problems.load_clips(fitted.experiment))


def write_run(run: Path, fitted: Fit) -> None:
    """Writes a fit that has its clips, and its page with invented activities."""
    save(run, fitted)
    (scene,), foot = fitted.problem.data, np.array([0.5, 0.75])
    counts = (scene.rig.names, scene.frames.dt.size, 0.2)
    activity = ClipActivity(*counts, foot, foot, foot, foot, (1, 2), (1, 1), LIMITS)
    before = playback.run(fitted.problem.space.unpack(fitted.problem.space.pack({})), scene)
    fit_report.fit_document(fitted, Measured([before], [activity], {})).write(run, stored=True)


def save(run: Path, fitted: Fit) -> None:
    """Writes a fit as a job does."""
    run_folder.save_solution(run, fitted.experiment, fitted.problem, fitted.solution)
    run_folder.save_fit(run, fitted)


def placeless(run: Path) -> str:
    """The experiment of a run, without where it was written."""
    text = (run / run_folder.EXPERIMENT).read_text()
    return re.sub(r"^written_in = .*\n", "", text, flags=re.MULTILINE)
