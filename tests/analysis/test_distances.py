"""Distances from the capture, against plain NumPy, and what is said of them."""

from typing import Any, get_args

import numpy as np
import pytest

from fitting.motion import goodness
from fitting.motion.goodness import (
    CLOSE,
    MOTIONS,
    PARTS,
    UNSEEN,
    Assumed,
    Distances,
    Kinds,
    Motion,
    Part,
    measure_groups,
)
from support.playbacks import FRAMES, SHAPES, playback

NEAR = dict.fromkeys(CLOSE, 0.01)  # m and rad


def random_errors(seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    return {kind: 0.02 * random.normal(size=(FRAMES, *SHAPES[kind])) for kind in CLOSE}


def test_distances_are_those_of_the_frames_and_legs_that_were_captured():
    seen = np.arange(FRAMES) < 200
    held_out = np.arange(FRAMES) >= 250
    rows: dict[str, Any] = {"seen": seen, "held_out": held_out}
    fitted = [playback(random_errors(0), **rows)]
    fitted.append(playback(random_errors(1), **rows, present=np.array([True, False])))
    before = [playback(random_errors(seed), **rows) for seed in (2, 3)]
    measured = goodness.measure_distances(before, fitted).parts
    by_motion: dict[Motion, list] = {
        "animation": [clip.animated_errors for clip in fitted],
        "before": [clip.errors for clip in before],
        "fitted": [clip.errors for clip in fitted],
    }
    assert tuple(measured) == PARTS and tuple(by_motion) == MOTIONS == get_args(Motion)
    for part, frames in zip(PARTS, (seen, held_out), strict=True):
        for motion, (first, second) in by_motion.items():
            for kind in CLOSE:
                one_leg = second[kind][:, 0] if second[kind].ndim == 3 else second[kind]
                rows_of_both = (first[kind][frames].reshape(-1, 3), one_leg[frames])
                lengths = np.linalg.norm(np.concatenate(rows_of_both), axis=1)
                expected = np.sqrt(np.mean(lengths**2))
                assert measured[part][motion][kind] == pytest.approx(expected), (part, kind)
    unseen = playback(seen=np.zeros(FRAMES, bool))
    assert goodness.measure_distances([unseen], [unseen]).parts == {}


def of(fitted: dict, animation: dict, before: dict, part: Part = "fitted") -> Distances:
    """Of one part, where kinds that are not named are 1 cm or 0.01 rad off."""
    motions: dict[Motion, Kinds] = {"animation": NEAR | animation, "before": NEAR | before}
    motions["fitted"] = NEAR | fitted
    return Distances({part: motions})


ANKLES_WORSE = "Worse: ankles 4.0 cm off the capture in fitted frames, 1.0 cm"
NEAR_IN_WORDS = "ankles 1.0 cm, knees 1.0 cm, pelvis 1.0 cm, orientation of the feet 0.6°"


@pytest.mark.parametrize(
    ("measured", "setbacks", "better", "sentence"),
    [
        (of({}, {}, {}), [], "fitted", f"Fits: {NEAR_IN_WORDS} off the capture in fitted frames;"),
        (of({"ankle": 0.0119}, {}, {}), [], "fitted", "Fits: ankles 1.2 cm"),
        (
            of({"ankle": 0.04}, {"ankle": 0.05}, {}),
            [("ankle", "before")],
            "before",
            f"{ANKLES_WORSE} before the fit. The parameters from before the fit are the better",
        ),
        (
            of({"ankle": 0.04, "foot": 0.05}, {}, {"ankle": 0.05, "foot": 0.05}),
            [("ankle", "animation"), ("foot", "animation")],
            "fitted",
            f"{ANKLES_WORSE} without foot IK, and in 1 more of the distances below. The parameters "
            "of the fit are",
        ),
        (  # a turn of 6 mm at heel and tip, of a foot that is 8 mm nearer, and then 2 mm
            of({"foot": 0.06, "ankle": 0.012}, {"foot": 0.0, "ankle": 0.02}, {"foot": 0.06}),
            [],
            "fitted",
            "Fits: ankles 1.2 cm",
        ),
        (
            of({"foot": 0.06, "ankle": 0.012}, {"foot": 0.0, "ankle": 0.014}, {"foot": 0.06}),
            [("foot", "animation")],
            "fitted",
            "Worse: orientation of the feet 3.4° off the capture in fitted frames, 0.0° without",
        ),
        (  # however much nearer the ankles are
            of({"pelvis": 0.013}, {"ankle": 0.1}, {"ankle": 0.05}),
            [("pelvis", "animation"), ("pelvis", "before")],
            "fitted",
            "Worse: pelvis 1.3 cm off the capture in fitted frames, 1.0 cm without foot IK, and in "
            "1 more of the distances below. The parameters of the fit are",
        ),
        (
            of({"knee": 0.035}, {"knee": 0.3}, {"knee": 0.2}, "held_out"),
            [],
            "fitted",
            "Does not fit: knees 3.5 cm off the capture in held-out frames, and 3.0 cm would be",
        ),
        (Distances({}), [], "fitted", "Nothing was observed"),
    ],
)
def test_the_verdict_is_about_what_is_seen(measured, setbacks, better, sentence):
    assert [(setback.kind, setback.other) for setback in measured.setbacks] == setbacks
    assert measured.better == better
    assumed = Assumed(counted=True)
    judged = goodness.judge(measure_groups([playback()], [{}], assumed), assumed, measured)
    assert judged.sentence.startswith(sentence), judged.sentence
    assert judged.fits == sentence.startswith(("Fits", "Nothing"))


def test_what_the_fit_was_told_to_ignore_is_shown_and_not_judged():
    errors = {kind: np.full((FRAMES, *SHAPES[kind]), 0.001) for kind in CLOSE}
    errors["foot"] = 200.0 * errors["foot"]
    near = playback({kind: 0.0 * error for kind, error in errors.items()})
    fitted = [playback(errors, {"foot": sigma}) for sigma in (0.1, np.inf)]
    judged, shown = (goodness.measure_distances([near], [clip]) for clip in fitted)
    assert judged.parts == shown.parts and shown.parts["fitted"]["fitted"]["foot"] > CLOSE["foot"]
    assert {setback.kind for setback in judged.setbacks} == {"foot"}
    assert judged.far and judged.better == "before"
    assert not shown.setbacks and not shown.far and shown.better == "fitted"


def test_a_difference_counts_once_it_can_be_seen():
    for kind, unseen in UNSEEN.items():
        for factor, count in ((0.99, 0), (1.01, 1)):
            measured = of({kind: NEAR[kind] + factor * unseen}, {kind: 1.0}, {})
            assert len(measured.setbacks) == count, (kind, factor)
