"""The worst two seconds, of playbacks that are made by hand so that the answers are known."""

import dataclasses
import struct

import numpy as np
import pytest

from fitting.analysis import worst_window
from fitting.analysis.playback import RESIDUAL_KINDS, Motion, Playback
from fitting.analysis.worst_window import find_worst_window
from fitting.problem.scene import Sigmas
from fitting.report import worst_window_report
from fitting.report.plots import worst_window_plots
from fitting.report.plots.style import save

FPS, FRAMES = 30.0, 300
LEGS = ("left", "right")
SEEN = np.ones(FRAMES, bool)
SIGMAS = {"ankle": 0.02, "knee": 0.03, "pelvis": 0.02, "foot": np.inf, "body": np.inf}
SIGMAS |= {"contact": np.inf, "smooth": np.inf}
SHAPES = {"ankle": (2, 3), "knee": (2, 3), "pelvis": (3,), "foot": (2, 3), "body": (3,)}
SHAPES |= {"contact": (2,), "smooth": (2, 3)}
SOLE, LEVEL = 0.05, 0.30  # m, of the ball over its sole, and of the ground


def standing(height: float) -> Motion:
    """A body at rest, its ankles and balls over a ground of this height."""
    joints = {"pelvis": 0.95, "hip": 0.9, "knee": 0.5, "ankle": 0.09, "toe": SOLE}
    made = {}
    for name, up in joints.items():
        at = np.zeros((FRAMES, 2, 3)) + [0.0, height + up, 0.05 if name == "knee" else 0.0]
        made[name] = at[:, 0] if name == "pelvis" else at
    return Motion(**made)


def played(
    errors: dict[str, np.ndarray] | None = None, seen: np.ndarray = SEEN, **changed
) -> Playback:
    """A playback whose fitted motion is off by these errors, and by none of the others."""
    full = {
        kind: np.zeros((FRAMES - 2 if kind == "smooth" else FRAMES, *shape))
        for kind, shape in SHAPES.items()
    } | (errors or {})
    captured = standing(LEVEL)
    after = dataclasses.replace(
        captured, **{k: getattr(captured, k) + full[k] for k in ("ankle", "knee", "pelvis")}
    )
    sigmas = SIGMAS | changed.pop("sigmas", {})
    inside = {k: seen[1:-1] if k == "smooth" else seen for k in RESIDUAL_KINDS}
    rows = {
        k: error * inside[k].reshape(-1, *[1] * (error.ndim - 1)) / sigmas[k]
        for k, error in full.items()
    }
    ones, zeros = np.ones((FRAMES, 2)), np.zeros((FRAMES, 2))
    ground = np.zeros((FRAMES, 2, 3)) + [0.0, LEVEL, 0.0]
    given = {
        "before": standing(0.0), "after": after, "captured": captured,
        "up_ws": np.array([0.0, 1.0, 0.0]), "forward_ws": np.zeros((FRAMES, 3)) + [0.0, 0.0, 1.0],
        "ground_ws": ground, "grounded": ones, "ball_ground_ws": ground, "ball_grounded": ones,
        "floor": np.zeros(FRAMES), "dt": np.full(FRAMES, 1 / FPS), "contact": ones,
        "locked": zeros, "reached": ones, "stance": ones, "slide": np.zeros(FRAMES), "seen": seen,
        "errors": full, "residuals": rows, "sigmas": {k: np.asarray(v) for k, v in sigmas.items()},
        "label": "captured",
    } | changed  # fmt: skip
    return Playback(**given)


def at(kind: str, frames: slice | int, *error: float, leg: int | None = None) -> dict:
    """Errors of a kind, m, in some frames; of one leg, or of the body."""
    made = np.zeros((FRAMES, *SHAPES[kind]))
    made[(frames,) if leg is None else (frames, leg)] = error
    return {kind: made}


def test_every_kind_of_residual_is_known_here():
    sigmas = {field.name for field in dataclasses.fields(Sigmas)} - {"correlation"}
    assert set(SHAPES) == set(RESIDUAL_KINDS) == sigmas
    assert set(worst_window.PER_LEG) == {
        kind for kind in RESIDUAL_KINDS if kind not in ("pelvis", "body")
    }


def test_the_window_is_two_seconds_with_the_largest_rows():
    low = at("pelvis", slice(20, 80), 0.0, -0.02, 0.0)["pelvis"]
    errors = at("pelvis", slice(150, 200), 0.0, -0.06, 0.0)["pelvis"] + low
    found = find_worst_window(played({"pelvis": errors}))
    assert found.end - found.start == 60 and found.start <= 150 and found.end >= 199
    # 50 of 61 frames are three sigmas off in one of their fifteen rows.
    assert found.rms == pytest.approx(np.sqrt(50 * 9 / (61 * 15)))
    assert found.clip_rms == pytest.approx(np.sqrt((50 * 9 + 60) / (FRAMES * 15)))
    assert found.fractions == {"pelvis": 1.0, "ankle": 0.0, "knee": 0.0}
    assert found.leg is None and found.size == pytest.approx(0.06)
    assert found.pelvis == pytest.approx(-0.06 * 50 / 61)


def test_a_clip_shorter_than_that_is_the_window():
    play = played(at("ankle", 5, 0.1, 0.0, 0.0, leg=0))
    short = {
        name: value
        for name, value in vars(play).items()
        if isinstance(value, np.ndarray) and len(value) == FRAMES
    }
    cut = dataclasses.replace(
        play,
        **{name: value[:40] for name, value in short.items()},
        errors={k: v[:40] for k, v in play.errors.items()},
        residuals={k: v[: 38 if k == "smooth" else 40] for k, v in play.residuals.items()},
        **{
            name: Motion(**{k: v[:40] for k, v in vars(getattr(play, name)).items()})
            for name in ("before", "after", "captured")
        },
    )
    found = find_worst_window(cut)
    assert (found.start, found.end, found.frame) == (0, 39, 5)


def test_frames_that_were_not_seen_do_not_count_however_large_their_errors_are():
    seen = np.ones(FRAMES, bool)
    seen[200:280] = False
    errors = at("ankle", slice(200, 280), 0.0, 5.0, 0.0, leg=1)["ankle"]
    errors += at("ankle", slice(60, 70), 0.0, 0.0, 0.04, leg=0)["ankle"]
    play = played({"ankle": errors}, seen)
    found = find_worst_window(play)
    assert found.start <= 60 and found.end >= 69 and found.leg == 0
    assert found.size == pytest.approx(0.04)
    # Were a single seen frame enough, the window over it would be the worst.
    lone = dataclasses.replace(play, seen=seen | (np.arange(FRAMES) == 240))
    assert find_worst_window(lone).start <= 60


def test_shares_tell_the_kind_and_the_leg():
    errors = at("ankle", slice(100, 110), 0.0, 0.04, 0.0, leg=1)  # 40 squared sigmas
    errors |= at("knee", slice(100, 110), 0.0, 0.03, 0.0, leg=0)  # 10
    errors |= at("pelvis", slice(100, 110), 0.02, 0.0, 0.0)  # 10
    found = find_worst_window(played(errors))
    assert list(found.fractions) == ["ankle", "knee", "pelvis"] and found.kind == "ankle"
    np.testing.assert_allclose(list(found.fractions.values()), [4 / 6, 1 / 6, 1 / 6])
    np.testing.assert_allclose(found.leg_fractions, [0.2, 0.8])


@pytest.mark.parametrize(
    ("error", "said"),
    [
        ((0.01, 0.09, 0.02), "9.3 cm off, mostly too high (9.0 cm)"),
        ((0.01, -0.09, 0.02), "9.3 cm off, mostly too low (9.0 cm)"),
        ((0.0, 0.01, 0.05), "mostly too far ahead (5.0 cm)"),
        ((0.0, 0.01, -0.05), "mostly too far behind (5.0 cm)"),
        ((0.05, 0.01, 0.0), "mostly too far to the left (5.0 cm)"),
        ((-0.05, 0.01, 0.0), "mostly too far to the right (5.0 cm)"),
    ],
)
def test_words_tell_where_to_and_when_the_largest_error_is(error, said):
    play = played(at("ankle", 123, *error, leg=1))
    text = " ".join(worst_window_report.describe(play, find_worst_window(play), LEGS))
    assert "The ankle position of the right leg is worst at 4.10 s: " in text and said in text
    assert "Ankle position has 100 % of their squares; knee position 0 %" in text
    assert "Of the squares of the legs the right one has 100 %." in text


@pytest.mark.parametrize(("stands", "said"), [(1.0, "stands"), (0.0, "swings")])
def test_words_tell_whether_the_foot_stands_and_whether_its_target_was_in_reach(stands, said):
    stance, reached = np.ones((FRAMES, 2)), np.ones((FRAMES, 2))
    stance[123, 0] = stands
    reached[123:129, 0] = stands
    play = played(at("knee", 123, 0.0, 0.1, 0.0, leg=0), stance=stance, reached=reached)
    found = find_worst_window(play)
    text = " ".join(worst_window_report.describe(play, found, LEGS))
    assert f"The foot {said} there, as captured." in text
    assert found.out_of_reach == pytest.approx((1 - stands) * 6 / 122)
    there = "within reach; out of it in 0 %" if stands else "out of reach; out of it in 5 %"
    assert f"The target of its ankle is {there} of these frames and feet." in text


def test_words_of_the_body_name_the_feet_that_stand_and_how_high_the_pelvis_is():
    contact = np.ones((FRAMES, 2))
    contact[:, 1] = 0.0
    play = played(
        at("pelvis", slice(0, FRAMES), 0.0, 0.03, 0.0),
        stance=np.zeros((FRAMES, 2)), contact=contact, reached=np.zeros((FRAMES, 2)),
    )  # fmt: skip
    text = " ".join(worst_window_report.describe(play, find_worst_window(play), LEGS))
    assert "There stand, by its contact weight: left." in text
    assert "The target of the ankle is out of reach in 100 % of" in text
    assert "The pelvis is 3.0 cm too high on average." in text
    assert "No captured foot is known to stand over ground" in text


@pytest.mark.parametrize(("apart", "said"), [(0.02, "2.1 cm in"), (-0.02, "2.1 cm over")])
def test_ground_that_is_not_at_the_captured_soles_is_told(apart, said):
    stance = np.zeros((FRAMES, 2))
    stance[100:140, 1] = 1.0
    play = played(at("ankle", 120, 0.0, 0.1, 0.0, leg=0), stance=stance)
    ground = play.ball_ground_ws + np.array([0.0, apart, 0.0])
    ground[110, 1, 1] += apart
    ground[200, 1, 1] += 9.0  # not in the window
    play = dataclasses.replace(play, ball_ground_ws=ground)
    found = find_worst_window(play)
    inside = np.arange(found.start, found.end + 1)
    count = int(np.sum((100 <= inside) & (inside < 140)))
    assert found.sole_gap is not None and found.sole_gap.frames == count
    assert found.sole_gap.mean == pytest.approx(-apart * (count + 1) / count)
    assert found.sole_gap.rms == pytest.approx(0.02 * np.sqrt((count + 3) / count))
    text = " ".join(worst_window_report.describe(play, found, LEGS))
    size, way = said.split(" cm ")
    assert (
        f"captured soles are {size} cm {way} the ground on average (2.1 cm rms; the right" in text
    )
    assert f"the right one 4.0 cm {way} it at 3.67 s)" in text
    bare = dataclasses.replace(play, ball_grounded=np.zeros((FRAMES, 2)))
    assert find_worst_window(bare).sole_gap is None


def test_an_acceleration_belongs_to_the_middle_of_its_three_frames():
    error = np.zeros((FRAMES - 2, 2, 3))
    error[149, 1] = [0.0, 30.0, 0.0]
    play = played({"smooth": error}, sigmas={"smooth": np.asarray(10.0)})
    found = find_worst_window(play)
    assert (found.kind, found.frame, found.leg) == ("smooth", 150, 1)
    assert found.offset is None and found.size == 30.0
    assert "30.0 m/s² off." in " ".join(worst_window_report.describe(play, found, LEGS))


def test_a_perfect_fit_has_a_worst_window_too():
    found = find_worst_window(played())
    assert found.rms == 0.0 and found.size == 0.0 and found.leg_fractions.sum() == 0.0
    assert worst_window_report.describe(played(), found, LEGS)


def test_the_picture_shows_the_window_with_its_stances(tmp_path):
    stance, seen = np.zeros((FRAMES, 2)), np.ones(FRAMES, bool)
    stance[100:140, 1] = 1.0
    seen[130:133] = False
    play = played(at("ankle", 120, 0.0, 0.1, 0.0, leg=0), seen, stance=stance)
    found = find_worst_window(play)
    figure = worst_window_plots.worst_window(play, LEGS, found, "hill: the worst two seconds")
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [title.partition(",")[0].partition(" (")[0] for title in titles] == [
        "Left ankle", "Right ankle", "Pelvis", "Left knee", "Right knee"
    ]  # fmt: skip
    low, high = figure.axes[0].get_xlim()
    assert (low, high) == (play.time[found.start], play.time[found.end])
    heights = [line.get_ydata() for line in figure.axes[0].lines[:2]]
    assert np.ptp(np.asarray(heights[1])) == pytest.approx(10.0), "the fitted ankle, cm"
    bands = [len(axes.patches) for axes in figure.axes]
    assert bands == [1, 2, 1, 1, 2], "what was not seen, and the right foot's stance"
    save(tmp_path / "worst.png", figure)
    wide, tall = struct.unpack(">II", (tmp_path / "worst.png").read_bytes()[16:24])
    assert 1000 < wide < 2000 and 1000 < tall < 2500
