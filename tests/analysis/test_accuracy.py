"""The benchmark's figures, held against the benchmark's own program."""

import dataclasses
import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fitting.analysis import accuracy
from fitting.analysis.accuracy import COLUMNS, Agreement
from fitting.datasets import clip_frames
from fitting.datasets.clips import load_clip

KEYS = {  # of score.py, in the units of our columns
    "pelvis": "pelvis_height_cm",
    "ankle": "ankle_cm",
    "ankle_stance": "ankle_stance_cm",
    "knee": "knee_cm",
    "knee_stance": "knee_stance_cm",
    "knee_angle": "knee_angle_deg",
    "knee_angle_stance": "knee_angle_stance_deg",
    "straight": "straight_percent",
    "pop": "pop_max_cm_per_frame",
    "added_slip": "added_slip_stance_mm_per_frame",
    "bone_length": "bone_length_error_max_mm",
}
Score = Callable[[dict, dict], dict[str, float]]


@pytest.fixture(scope="module")
def score(shared: Path) -> Score:
    """The benchmark's own function."""
    spec = importlib.util.spec_from_file_location("score", shared / "mocap/blocks/score.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.score


def made(seed: int, frames: int = 50, near: float = 0.05) -> tuple[dict, dict]:
    """A captured clip with its base, and a result near it; some legs are nearly straight."""
    random = np.random.default_rng(seed)

    def joints(wander: float) -> dict[str, np.ndarray]:
        pelvis = np.cumsum(random.normal(0, 0.01, (frames, 3)), axis=0) + [0, 0.9, 0]
        hip = pelvis[:, None] + [[0.1, -0.05, 0], [-0.1, -0.05, 0]]
        bend = random.uniform(0, 0.02, (frames, 2))[..., None]
        knee = hip + [0, -0.43, 0] + bend * random.normal(0, 1, (frames, 2, 3))
        ankle = knee + [0, -0.41, 0] + bend * random.normal(0, 1, (frames, 2, 3))
        drawn = {"pelvis": pelvis, "hip": hip, "knee": knee, "ankle": ankle}
        return {k: v + wander * random.normal(0, 1, v.shape) for k, v in drawn.items()}

    clip = joints(0.0)
    clip["base_ankle"] = clip["ankle"] + random.normal(0, 0.02, (frames, 2, 3))
    clip["stance"] = random.random((frames, 2)) < 0.6
    clip["leg_lengths"] = np.array([[0.43, 0.41], [0.435, 0.405]])
    return clip, {k: v + near * random.normal(0, 1, v.shape) for k, v in joints(0.0).items()}


def measured(clip: dict, result: dict) -> Agreement:
    given = clip["base_ankle"], clip["stance"].astype(bool), clip["leg_lengths"]
    return accuracy.agreement([accuracy.errors(result, clip, *given)])


def assert_scored(
    found: Agreement, told: dict[str, float], rtol: float = 1e-9, atol: float = 1e-9
) -> None:
    assert set(KEYS.values()) == set(told)
    for key, theirs in KEYS.items():
        ours = COLUMNS[key].factor * getattr(found, key)
        np.testing.assert_allclose(ours, told[theirs], rtol=rtol, atol=atol, err_msg=key)


def test_every_figure_has_a_column_in_the_same_order():
    assert list(COLUMNS) == [field.name for field in dataclasses.fields(Agreement)]
    assert list(KEYS) == list(COLUMNS)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("near", [0.0, 0.05])
def test_figures_of_random_motions_are_those_of_the_benchmark(score, seed, near):
    clip, result = made(seed, near=near)
    found = measured(clip, result)
    assert_scored(found, score(clip, result))
    assert near or 0 < found.straight < 1


def test_a_clip_in_which_no_foot_stands_has_no_figures_of_stances(score):
    clip, result = made(1)
    clip["stance"][:] = False
    found = measured(clip, result)
    with np.errstate(all="ignore"), pytest.warns(RuntimeWarning, match="empty slice"):
        told = score(clip, result)  # of no slip it takes the mean
    assert_scored(found, told)
    assert np.isnan([found.ankle_stance, found.knee_stance, found.added_slip]).all()
    assert accuracy.table(found)[3] == ["ankle in stance, cm", "–"]


def test_the_captured_motion_agrees_with_itself():
    clip, _ = made(2)
    found = measured(clip, clip)
    assert (found.pelvis, found.ankle, found.knee_angle, found.added_slip) == (0, 0, 0, 0)
    assert found.pop > 0, "the base is another one"


def test_several_clips_count_by_their_frames_and_nothing_is_seen_across_a_cut(score):
    clip, result = made(3, frames=60)
    parts = [slice(0, 20), slice(20, 60)]
    found = accuracy.agreement(
        [
            accuracy.errors(
                {k: v[part] for k, v in result.items()},
                {k: clip[k][part] for k in accuracy.JOINTS},
                clip["base_ankle"][part], clip["stance"][part], clip["leg_lengths"],
            )
            for part in parts
        ]
    )  # fmt: skip
    whole = measured(clip, result)
    for key in ("pelvis", "ankle", "ankle_stance", "knee_angle_stance", "straight", "bone_length"):
        assert getattr(found, key) == pytest.approx(getattr(whole, key), rel=1e-12)
    pops = []
    for part in parts:
        told = score(
            {k: v if k == "leg_lengths" else v[part] for k, v in clip.items()},
            {k: v[part] for k, v in result.items()},
        )
        pops.append(told["pop_max_cm_per_frame"])
    assert 100 * found.pop == pytest.approx(max(pops))


def test_figures_of_the_benchmark_s_base_are_those_of_its_program(score, mocap):
    path = mocap / "blocks" / "03_03.npz"
    captured, base = (load_clip(path, variant=name) for name in ("captured", "base"))
    found = accuracy.agreement([accuracy.errors_of_clips(base, captured, base)])
    told = score(dict(np.load(path)), clip_frames.positions_by_role(base))
    assert told["pelvis_height_cm"] > 9, "without foot IK"
    # The file holds single precision, and the rig's lengths are measured.
    assert_scored(found, told, rtol=1e-4, atol=1e-3)
