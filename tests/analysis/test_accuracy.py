"""Figures of the blocks benchmark, compared with those of its own scoring script."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fitting.clips import clip_frames, load_clip
from fitting.clips.formats.npz import read_base
from fitting.motion import accuracy
from fitting.motion.accuracy import ACCURACY, Accuracy
from fitting.report.formatting import figures_table
from support.benchmark import scoring_program

SCORE_KEYS = {  # keys of the scoring script, whose units are those of `ACCURACY`
    "pelvis": "pelvis_height_cm",
    "ankle": "ankle_cm",
    "ankle_stance": "ankle_stance_cm",
    "knee": "knee_cm",
    "knee_stance": "knee_stance_cm",
    "knee_angle": "knee_angle_deg",
    "knee_angle_stance": "knee_angle_stance_deg",
    "straight": "straight_percent",
    "lift_change": "pop_max_cm_per_frame",
    "added_slip": "added_slip_stance_mm_per_frame",
    "bone_length": "bone_length_error_max_mm",
}
Joints = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def score(mocap: Path) -> Callable[[Joints, Joints], dict[str, float]]:
    """The function of the benchmark's scoring script."""
    return scoring_program(mocap).score


def random_clip(seed: int, *, frames: int = 50, noise: float = 0.05) -> tuple[Joints, Joints]:
    """A captured clip with its flat animation, and a result near it; some legs are straight."""
    random = np.random.default_rng(seed)

    def joints(jitter: float) -> Joints:
        pelvis = np.cumsum(random.normal(0, 0.01, (frames, 3)), axis=0) + [0, 0.9, 0]
        hip = pelvis[:, None] + [[0.1, -0.05, 0], [-0.1, -0.05, 0]]
        bend = random.uniform(0, 0.02, (frames, 2))[..., None]
        knee = hip + [0, -0.43, 0] + bend * random.normal(0, 1, (frames, 2, 3))
        ankle = knee + [0, -0.41, 0] + bend * random.normal(0, 1, (frames, 2, 3))
        exact = {"pelvis": pelvis, "hip": hip, "knee": knee, "ankle": ankle}
        return {k: v + jitter * random.normal(0, 1, v.shape) for k, v in exact.items()}

    clip = joints(0.0)
    clip["base_ankle"] = clip["ankle"] + random.normal(0, 0.02, (frames, 2, 3))
    clip["stance"] = random.random((frames, 2)) < 0.6
    clip["leg_lengths"] = np.array([[0.43, 0.41], [0.435, 0.405]])
    return clip, {k: v + noise * random.normal(0, 1, v.shape) for k, v in joints(0.0).items()}


def errors(clip: Joints, result: Joints) -> accuracy.Errors:
    stance = clip["stance"].astype(bool)
    return accuracy.errors(result, clip, clip["base_ankle"], stance, clip["leg_lengths"])


def measure(clip: Joints, result: Joints) -> Accuracy:
    return accuracy.summarise([errors(clip, result)])


def cut(clip: Joints, part: slice) -> Joints:
    return {k: v if k == "leg_lengths" else v[part] for k, v in clip.items()}


def assert_scores(
    ours: Accuracy, theirs: dict[str, float], rtol: float = 1e-9, atol: float = 1e-9
) -> None:
    assert set(SCORE_KEYS.values()) == set(theirs)
    for key, score_key in SCORE_KEYS.items():
        value = ACCURACY[key].factor * getattr(ours, key)
        np.testing.assert_allclose(value, theirs[score_key], rtol=rtol, atol=atol, err_msg=key)


def test_figures_of_random_motions_equal_those_of_the_scoring_script(score):
    for seed in range(5):
        for noise in (0.0, 0.05):
            clip, result = random_clip(seed, noise=noise)
            ours = measure(clip, result)
            assert_scores(ours, score(clip, result))
            assert noise or 0 < ours.straight < 1
    of_captured = measure(clip, clip)
    errors = (of_captured.pelvis, of_captured.ankle, of_captured.knee_angle, of_captured.added_slip)
    assert errors == (0, 0, 0, 0)
    assert of_captured.lift_change > 0, "it is measured against the flat animation"


def test_a_clip_in_which_no_foot_stands_has_no_figures_of_stances(score):
    clip, result = random_clip(1)
    clip["stance"][:] = False
    ours = measure(clip, result)
    with np.errstate(all="ignore"), pytest.warns(RuntimeWarning, match="empty slice"):
        theirs = score(clip, result)  # takes the mean of an empty array
    assert_scores(ours, theirs)
    assert np.isnan([ours.ankle_stance, ours.knee_stance, ours.added_slip]).all()
    rows = dict(figures_table("", {"solved": ours})[1:])
    assert rows["ankle, cm"] == f"{100 * ours.ankle:.2f}" and "ankle in stance, cm" not in rows


def test_several_clips_count_by_their_frames_without_changes_across_the_cut(score):
    clip, result = random_clip(3, frames=60)
    parts = [[cut(of, part) for of in (clip, result)] for part in (slice(0, 20), slice(20, 60))]
    ours, whole = accuracy.summarise([errors(*part) for part in parts]), measure(clip, result)
    for key in ("pelvis", "ankle", "ankle_stance", "knee_angle_stance", "straight", "bone_length"):
        assert getattr(ours, key) == pytest.approx(getattr(whole, key), rel=1e-12)
    changes = [score(*part)["pop_max_cm_per_frame"] for part in parts]
    assert 100 * ours.lift_change == pytest.approx(max(changes))


def test_figures_of_the_flat_animation_equal_those_of_the_scoring_script(score, mocap):
    path = mocap / "blocks" / "03_03.npz"
    captured, base = load_clip(path), read_base(path)
    ours = accuracy.summarise([accuracy.clip_errors(base, captured, base)])
    theirs = score(dict(np.load(path)), clip_frames.positions_by_role(base))
    assert theirs["pelvis_height_cm"] > 9, "without foot IK"
    # The file holds single precision, and the rig's lengths are measured.
    assert_scores(ours, theirs, rtol=1e-4, atol=1e-3)
