"""A made clip with a quarter of its labels wrong, and what correcting them by hand brings back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fitting.clips import Clip, save_clip
from fitting.clips.stances import Stance, contacts_path, save_stances, stances_of, with_stances
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import load, make_problem
from fitting.experiment.systems import with_parameters
from fitting.motion.flat_animation import load_flat_animation
from fitting.problem.problem import digest
from fitting.runtime.precision import in_float64, with_floats
from fitting.studies.animations import AnimationFiles, load_animation
from fitting.studies.fit.assess import search_with_noise
from jaxik import presets
from support.experiments import ROOT, write

BASE = ROOT / "data/clips/uneven_walk_base.npz"
TERRAIN = ROOT / "data/terrains/uneven_walk.ply"
TRUTH = {
    "pelvis.highest_share": 0.4,
    "pelvis.extension": 0.94,
    "pelvis.rise_half_life": 0.03,
    "probe.steepness": 2.6,
}
NOISE = 0.002  # m
CLOSE = 0.05  # of a range
PARTS = {"top": 'preset = "stride"\nholdout = 0.0', "rest": "[fit]\nstarts = 2"}
SIGMAS = f"[sigmas]\nankle = {NOISE}\nknee = {NOISE}\npelvis = {NOISE}\nfoot = 0.01\n"


def by_hand(stance: Stance, start: float = 0.0, end: float = 0.0) -> Stance:
    """The stance with its ends moved, s."""
    return Stance(round(stance.start + start, 6), round(stance.end + end, 6))


def with_wrong_labels(clip: Clip) -> Clip:
    """Six of 21 stances are shifted, merged, missing or invented."""
    left, right = (list(of_leg) for of_leg in stances_of(clip).values())
    left[1], left[8] = by_hand(left[1], 0.25, 0.25), by_hand(left[8], -0.2, -0.2)
    left[4:6] = [Stance(left[4].start, left[5].end)]
    right[6:6] = [Stance(6.4, 6.6)]
    del right[3]
    return with_stances(clip, {"left": tuple(left), "right": tuple(right)})


def corrected_by_hand(clip: Clip, wrong: Clip) -> Clip:
    """The clip with wrong stances put right to within a frame, as a hand does it."""
    random = np.random.default_rng(1)

    def dragged(stance: Stance) -> Stance:
        start, end = int(random.integers(-1, 2)), int(random.integers(-1, 2))
        return by_hand(stance, start / clip.fps, end / clip.fps)

    known = stances_of(wrong)
    return with_stances(
        clip,
        {
            name: tuple(each if each in known[name] else dragged(each) for each in of_leg)
            for name, of_leg in stances_of(clip).items()
        },
    )


def test_corrected_labels_make_the_problem_that_true_labels_make(tmp_path):
    """To the last digit, so that its fit is the same, too."""
    clip = load_flat_animation(BASE)
    save_clip(tmp_path / "true.npz", clip)
    save_clip(tmp_path / "wrong.npz", with_wrong_labels(clip))

    def digest_with(name: str) -> str:
        files = f'[[clips]]\nreference = "{name}.npz"\nterrain = "{TERRAIN}"\nend = 9.0\n'
        return digest(make_problem(load_experiment(write(tmp_path, clips=files))))

    true, wrong = digest_with("true"), digest_with("wrong")
    assert wrong != true
    save_stances(contacts_path(tmp_path / "wrong.npz"), clip)
    assert digest_with("wrong") == true


@in_float64
def write_made_clip(folder: Path) -> Clip:
    """What known parameters make of an animation whose labels are true; the animation."""
    animation = load_animation(AnimationFiles(BASE, TERRAIN))
    stride = with_floats(presets.stride(), np.float64)
    _, solved = animation.solve(with_parameters(stride, TRUTH, "truth"))
    noise = NOISE * np.random.default_rng(0).normal(size=solved.positions_ws.shape)
    captured = solved.with_motion(solved.positions_ws + noise, solved.rotations_ws)
    save_clip(folder / "captured.npz", replace(captured, remarks=()))
    return animation.clip


@pytest.mark.slow
def test_a_fit_with_wrong_labels_is_bad_and_says_so_and_labels_by_hand_bring_the_truth_back(
    tmp_path,
):
    animation = write_made_clip(tmp_path)

    def search(name: str, clip: Clip, corrected: Clip | None = None):
        save_clip(tmp_path / f"{name}.npz", clip)
        if corrected is not None:
            save_stances(contacts_path(tmp_path / f"{name}.npz"), corrected)
        files = f'[[clips]]\nreference = "captured.npz"\nbase = "{name}.npz"\nterrain = "{TERRAIN}"'
        free = "\n".join(f"{parameter} = {{}}" for parameter in TRUTH)
        rest = f"{SIGMAS}{PARTS['rest']}"
        path = write(tmp_path, f"{name}.toml", **(PARTS | {"rest": rest}), clips=files, free=free)
        loaded = load(load_experiment(path))
        _, solution = search_with_noise(loaded.problem, loaded.experiment)
        ranges = {p.name: p.high - p.low for p in loaded.problem.space.parameters}
        values = dict(zip(solution.names, solution.values, strict=True))
        off = max(abs(values[p] - true) / ranges[p] for p, true in TRUTH.items())
        return off, solution.cost

    wrong_clip = with_wrong_labels(animation)
    true_off, true_cost = search("true", animation)
    wrong_off, wrong_cost = search("wrong", wrong_clip)
    hand_off, hand_cost = search("hand", wrong_clip, corrected_by_hand(animation, wrong_clip))
    assert true_off < CLOSE and wrong_cost > 3 * true_cost and wrong_off > 2 * CLOSE
    assert hand_off < CLOSE and hand_cost < 0.5 * wrong_cost
