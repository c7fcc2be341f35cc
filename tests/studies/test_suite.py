"""The suite: its situations, bounds, table, numbers and page, and what the command rejects."""

import functools
import json
import re

import jax
import numpy as np
import pytest

from fitting import jobs
from fitting.cli import main
from fitting.experiment.systems import preset_names, preset_system
from fitting.motion import measures
from fitting.motion.measures import BOUNDED
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies import comparison, suite
from fitting.studies.suite import Suite, run_situations
from fitting.synthetic import footsteps
from jaxik.maths import parameter_tree

BRIEF = 2.5  # s; the bound of pops is that of the fastest whole swing, and few are whole in less
FEW = ("flat walk", "stairs up")


def plan(*names: str) -> suite.Plan:
    return suite.choose(",".join(names))._replace(seconds=BRIEF)


@pytest.fixture(scope="module")
def still():
    """`stride`, whose program the defaults need, too, without any effect on feet."""
    return parameter_tree.replace(preset_system("stride"), {"leg.weight": 0.0})


@pytest.fixture(scope="module")
def written(still, tmp_path_factory):
    """A suite of a system without effect and one that fails, and the folder of its report."""
    folder = tmp_path_factory.mktemp("suite") / "new"
    failing = parameter_tree.replace(still, {"leg.weight": np.ones(3)})
    finished = jobs.run_suite(lambda rig: {"still": still, "failing": failing}, plan(*FEW), folder)
    return finished, folder


# Situations


def test_all_situations_have_as_many_frames_and_grounds_of_one_structure():
    structures = set()
    for situation in suite.SITUATIONS:
        animation = situation.animation(BRIEF)
        assert animation.clip.frame_count == round(BRIEF * suite.FPS)
        leaves, structure = jax.tree.flatten(animation.terrain)
        structures.add((structure, tuple(leaf.shape for leaf in leaves)))
    assert len(structures) == 1


def test_situations_keep_their_order_and_the_short_form_is_shorter():
    every, quick = suite.choose(), suite.choose(quick=True)
    assert every.situations == suite.SITUATIONS
    assert set(quick.situations) < set(every.situations) and quick.seconds < every.seconds
    chosen = suite.choose("rubble, hill", quick=True)
    assert [entry.name for entry in chosen.situations] == ["hill", "rubble"]


def test_bodies_have_their_size_and_still_feet():
    for tall in (suite.CHILD, suite.GIANT):
        clip = suite.walk_of(tall)(3.0)
        thighs = np.full(2, tall / suite.ADULT * footsteps.THIGH)
        np.testing.assert_allclose(np.asarray(clip.rig.thigh), thighs, rtol=1e-5)
        standing = clip.stance_labels()[1:] & clip.stance_labels()[:-1]
        steps = np.linalg.norm(np.diff(clip.joints_ws(3), axis=0), axis=-1)
        assert steps[standing].max() < 1e-9


def test_stairs_have_their_rises_and_rubble_its_height():
    x, z = np.zeros(1), np.linspace(0.5, 5.0, 4501)
    heights = suite.stairs_up(x, z)
    assert np.unique(np.round(np.diff(np.unique(heights)), 9)) == pytest.approx([suite.RISE])
    assert heights.max() == pytest.approx(suite.RISE * suite.STEPS)
    patch = suite.rubble(np.linspace(-2, 2, 81), np.linspace(-3, 17, 2001)[:, None])
    assert suite.RUBBLE / 2 < np.abs(patch).max() <= suite.RUBBLE
    assert np.abs(np.diff(patch, axis=0)).max() < 0.01


# Bounds


@in_float64
def test_a_flat_floor_allows_the_bare_bounds():
    animation = suite.SITUATIONS[0].animation(3.0)
    size = animation.place(animation.placed_clip).measures.size
    assert animation.bounds["slide"] == pytest.approx(size * measures.FLAT_SLIDE)
    # The ball rises as the foot rolls.
    assert animation.bounds["pop"] == pytest.approx(size * measures.VISIBLE, abs=2e-4)


@in_float64
def test_a_curb_allows_as_much_as_a_smooth_swing_onto_it_needs():
    animation = suite.choose("curb").situations[0].animation(3.0)
    clip = animation.clip
    rises = []  # m per frame, of all swings; the highest ends on the island and began below it
    for leg, ball in enumerate(np.moveaxis(clip.joints_ws(3), 1, 0)):
        heights = suite.curb(ball[:, 0], ball[:, 2])
        stands = np.flatnonzero(clip.stance_labels()[:, leg])
        rises += list(np.abs(np.diff(heights[stands])) / np.diff(stands))
    fastest = 1.875 * max(rises) * 60.0
    assert fastest > 0.3
    assert measures.swing_speed(animation.place(clip).soles, clip.fps) == pytest.approx(
        fastest, rel=0.1
    )


# What is run and written


def test_a_system_without_effect_is_within_bounds_on_the_flat_and_not_on_stairs(written):
    finished, _ = written
    flat, stairs = finished.scenes
    assert flat.beyond("still") == []
    assert "penetration" in [bounded.name for bounded in stairs.beyond("still")]
    slide = stairs.comparison.motions["still"].measures.slide
    assert slide == pytest.approx(0.0, abs=1e-9)


def test_the_numbers_are_those_of_the_measures_and_a_failure_is_beyond_all_bounds(written):
    finished, folder = written
    within, count = finished.counts
    assert count == 2 * 2 * len(BOUNDED) and within < count / 2
    content = json.loads((folder / suite.NUMBERS).read_text())
    assert (content["within"], content["measures"]) == finished.counts
    for name, scene, numbers in zip(FEW, finished.scenes, content["situations"], strict=True):
        assert numbers["title"] == name and "leg.weight" in numbers["failures"]["failing"]
        assert numbers["bounds"] == pytest.approx(scene.comparison.bounds)
        _, still = numbers["systems"]
        measured = scene.comparison.motions["still"].measures
        assert still["name"] == "still" and still["pop"] == measured.pop
        assert still["beyond"] == [bounded.name for bounded in scene.beyond("still")]
        assert still["reached"] == (None if np.isnan(measured.reached) else measured.reached)


def test_what_is_beyond_its_bound_has_a_mark_and_is_red_in_the_page_and_the_table(written):
    finished, folder = written
    table = suite.table(finished)
    stairs = next(row for row in table if row[1] == "still" and row is not table[2])
    assert stairs[2].endswith(comparison.MISS)
    text = (folder / suite.TABLE).read_text()
    assert f'<span style="color:red">**{stairs[2]}**</span>' in text
    assert all(measure.reason in text for measure in BOUNDED.values())
    assert "stairs up, still: penetration" in text and "no motion: " in text
    assert (folder / suite.PAGE).read_bytes().startswith(b"\x89PNG")
    low, high = suite.page(finished).axes[0].get_ylim()
    assert -0.3 < low < -0.2 and 1.0 < high < 1.2  # from below the soles to above the pelvis


@in_float64
def test_an_interrupted_suite_keeps_what_is_finished(still, tmp_path):
    class Interrupt(activity.Watcher):
        def began(self, work: activity.Work) -> None:
            if work.title == FEW[1]:
                raise KeyboardInterrupt

    with activity.watched_by(Interrupt()):
        finished = jobs.run_suite(lambda rig: {"still": still}, plan(*FEW), tmp_path)
    assert finished.interrupted and [scene.situation.name for scene in finished.scenes] == [FEW[0]]
    assert json.loads((tmp_path / suite.NUMBERS).read_text())["interrupted"]
    assert (
        "1 situations are missing, as the suite was interrupted"
        in (tmp_path / suite.TABLE).read_text()
    )


# The command


def test_the_command_prints_the_table_whatever_is_in_it(monkeypatch, still, tmp_path, capsys):
    monkeypatch.setattr(suite, "SHORT", BRIEF)
    run = functools.partial(jobs.run_suite, lambda rig: {"still": still})
    monkeypatch.setattr(jobs, "run_suite", lambda _, *rest, **named: run(*rest, **named))
    words = ["compare", "--suite", "--quick", "--only", "stairs up", "-o", str(tmp_path)]
    assert main.main(words) == 0
    printed = capsys.readouterr()
    assert re.search(rf"^\d+ of {len(BOUNDED)} within bounds\.$", printed.out, re.MULTILINE)
    assert comparison.MISS in printed.out and "\x1b" not in printed.out


def test_all_presets_are_in_the_suite_unless_others_are_named(monkeypatch):
    names = []

    def run(systems_of, plan, *_, **__):
        names.extend(systems_of(suite.walk(BRIEF).rig))
        return Suite(plan, (), ())

    monkeypatch.setattr(jobs, "run_suite", run)
    assert main.main(["compare", "--suite"]) == 0
    assert names == preset_names()


# How good the defaults are


@pytest.mark.parametrize(
    ("chosen", "names"),
    [
        (suite.choose(",".join(FEW), quick=True), ["stride"]),
        pytest.param(suite.choose(), preset_names(), marks=pytest.mark.slow),
    ],
    ids=["for a while", "at length"],
)
def test_what_is_within_its_bounds_stays_so(chosen, names):
    def systems_of(rig) -> dict:
        return {name: preset_system(name, rig) for name in names}

    misses = {
        (name, scene.situation.name, bounded.name): bounded.words
        for scene in run_situations(systems_of, chosen).scenes
        for name in names
        for bounded in scene.beyond(name)
    }
    assert not {key: words for key, words in misses.items() if not suite.reason_of(*key)}
    if chosen.situations == suite.SITUATIONS:
        unused = [x for x in suite.LIMITATIONS if not any(x.covers(*key) for key in misses)]
        assert not unused


def test_reasons_are_of_presets_situations_and_measures_that_exist_and_stand_beside_misses(still):
    situations = {entry.name for entry in suite.SITUATIONS}
    for limitation in suite.LIMITATIONS:
        assert limitation.preset in preset_names() and limitation.reason
        assert set(limitation.situations.split(", ")) <= situations
        assert set(limitation.measures.split()) <= set(BOUNDED)
    assert suite.reason_of("record", "curb", "pop") and not suite.reason_of("record", "room", "pop")
    finished = run_situations(lambda rig: {"unreal": still, "mine": still}, plan("stairs up"))
    reason = suite.reason_of("unreal", "stairs up", "penetration")
    (scene,) = finished.scenes
    assert reason and any(words.endswith(reason) for words in suite.misses(scene, "unreal"))
    assert not any(reason in words for words in suite.misses(scene, "mine"))
