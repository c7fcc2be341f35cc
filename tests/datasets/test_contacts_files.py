"""Contacts files: when each foot stands, beside a clip, and what becomes of mistakes in them."""

import dataclasses
import re

import numpy as np
import pytest

from fitting.cli import main
from fitting.clips import Clip, contacts, edit, load_clip, save_clip, summary
from fitting.clips.stances import (
    Stance,
    contacts_path,
    left_out_frames,
    load_stances,
    save_stances,
    stances_of,
    with_stances,
)
from fitting.ground.reconstruction import find_stances
from support.sample_clips import FPS, flat_floor, stair_walk

GOOD = "frames = 162\nfps = 60.0\n[legs]\nleft = [{ start = 0.1, end = 0.5 }]\nright = []\n"
BESIDE = "contacts from walk.contacts.toml: 4 stances, 2 by hand, 1 left out of the fit"


def random_stances(random: np.random.Generator, clip: Clip) -> dict[str, tuple[Stance, ...]]:
    """Stances of at least a frame, with at least one between them."""
    stances = {}
    for name in clip.rig.names:
        edges = np.sort(random.choice(clip.frame_count // 2, 2 * random.integers(0, 6), False)) * 2
        stances[name] = tuple(
            Stance(
                round(first / clip.fps, 6),
                round((last - random.integers(0, 2)) / clip.fps, 6),
                None if random.random() < 0.5 else round(random.uniform(0.01, 1.0), 2),
                bool(random.random() < 0.3),
            )
            for first, last in edges.reshape(-1, 2).tolist()
        )
    return stances


@pytest.fixture(scope="module")
def walk() -> Clip:
    return stair_walk()


@pytest.fixture
def file(walk, tmp_path):
    """The walk with a contacts file beside it: a stance split, and a part of it left out."""
    stances = stances_of(walk)
    first, *others = stances["left"]
    parts = Stance(0.0, 0.2, left_out=True), Stance(0.3, first.end)
    changed = with_stances(walk, {"left": (*parts, others[0]), "right": stances["right"][:1]})
    path = tmp_path / "walk.npz"
    save_clip(path, walk)
    save_stances(contacts_path(path), changed)
    return path


@pytest.mark.parametrize("fps", [23.976023976023978, 30.0, 120.0, 1000.0])
@pytest.mark.parametrize("seed", range(5))
def test_what_is_read_is_what_was_written(walk, tmp_path, fps, seed):
    clip = dataclasses.replace(walk, fps=fps, left_out=None, probability=None)
    stances = random_stances(np.random.default_rng(seed), clip)
    own = with_stances(clip, stances)
    assert stances_of(own) == stances
    path = tmp_path / "walk.contacts.toml"
    save_stances(path, own)
    read = load_stances(path, clip)
    assert stances_of(read) == stances
    for name in ("stance", "probability", "left_out"):
        np.testing.assert_array_equal(getattr(read, name), getattr(own, name))
    save_stances(tmp_path / "again.toml", read)
    assert (tmp_path / "again.toml").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("other", [{"fps": 59.0}, {"frames": slice(1, None)}])
def test_a_file_of_another_clip_is_refused(walk, file, other):
    clip = walk.select(other.pop("frames", slice(None)))
    with pytest.raises(ValueError, match=r"contacts of a clip of 162 frames at 60 Hz; stair walk"):
        load_stances(contacts_path(file), dataclasses.replace(clip, **other))


def test_the_file_beside_a_clip_is_read_and_said_and_others_on_demand(walk, file, tmp_path):
    clip = load_clip(file)
    assert clip.remarks[-1] == BESIDE
    assert [s.text for s in stances_of(clip)["left"]][:2] == ["0 to 0.2 s", "0.3 to 0.5 s"]
    np.testing.assert_array_equal(load_clip(file, contacts=False).stance, walk.stance)
    other = contacts_path(file).rename(tmp_path / "other.toml")
    np.testing.assert_array_equal(load_clip(file).stance, walk.stance)
    np.testing.assert_array_equal(load_clip(file, contacts=other).stance, clip.stance)
    with pytest.raises(ValueError, match="no such file, wanted a contacts file"):
        load_clip(file, contacts=tmp_path / "none.toml")


def test_times_are_those_of_the_file_whatever_part_of_it_counts_at_which_rate(file):
    part = edit.resample(edit.trim(load_clip(file), 0.1, 2.0), 30.0)
    first, second, third = stances_of(part)["left"]
    for stance, (start, end) in ((first, (0.1, 0.2)), (second, (0.3, 0.5))):
        assert (stance.start, stance.end) == pytest.approx((start, end), abs=0.5 / 30.0)
    assert first.left_out and first.by_hand and third.probability == 1.0
    assert stances_of(with_stances(part, stances_of(part))) == stances_of(part)


def test_saved_clips_keep_what_is_left_out(file, tmp_path):
    clip = load_clip(file)
    save_clip(tmp_path / "saved.npz", clip)
    assert stances_of(load_clip(tmp_path / "saved.npz")) == stances_of(clip)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frames = ", "not TOML"),
        (GOOD.replace("[legs]", "[leg]"), "unknown key 'leg'; nearest is 'legs'"),
        (GOOD.replace("frames = 162\n", ""), "frames is missing; it needs frames and fps and legs"),
        (GOOD.replace("162", "1.5"), "frames is 1.5; wanted a whole number"),
        (GOOD.replace("right", "rihgt"), "unknown key 'rihgt'; nearest is 'right'"),
        (GOOD.replace("right = []\n", ""), "right is missing; wanted the stances of left and"),
        (GOOD.replace("[{", "5 #"), "left is 5; wanted a list"),
        (GOOD.replace("end", "stop"), "unknown key 'stop'"),
        (GOOD.replace(", end = 0.5", ""), "end is missing; it needs start and end"),
        (GOOD.replace("0.5", "nan"), "end is nan; wanted a number of seconds"),
        (GOOD.replace("0.5", "inf"), "end is inf; wanted a number of seconds"),
        (GOOD.replace("0.1", "-0.1"), "start is -0.1; wanted a number of seconds"),
        (GOOD.replace("0.5", "'late'"), "end is 'late'; wanted a number of seconds"),
        (GOOD.replace("0.5", "0.05"), "a stance from 0.1 to 0.05 s ends before it starts"),
        (GOOD.replace("0.5", "2.7"), "from 0.1 to 2.7 s is not within the clip, .* to 2.68333 s"),
        (GOOD.replace("0.5 }", "0.5, probability = 1.2 }"), "probability is 1.2; wanted a number"),
        (GOOD.replace("0.5 }", "0.5, left_out = 1 }"), "left_out is 1; wanted true or false"),
        (
            GOOD.replace("}]", "}, { start = 0.4, end = 1.0 }]"),
            "0.1 to 0.5 s .* 0.4 to 1 s ov",
        ),
        (GOOD.replace("}]", "}, { start = 0.5, end = 1.0 }]"), "overlap or touch"),
        (GOOD.replace("[{", "[{ start = 0.0, end = 1.0 }, {"), "0 to 1 s .* 0.1 to 0.5 s overlap"),
    ],
)
def test_every_mistake_is_an_error_in_one_line(walk, tmp_path, text, message):
    path = tmp_path / "walk.contacts.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        load_stances(path, walk)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_a_leg_is_left_out_with_the_halves_of_the_swings_beside_its_stance(walk):
    assert left_out_frames(walk) is None
    first, second, third = stances_of(walk)["left"]
    left = (first, dataclasses.replace(second, left_out=True), third)
    frames = left_out_frames(with_stances(walk, {**stances_of(walk), "left": left}))
    assert frames is not None and not frames[:, 1].any()
    ((begin, end),) = contacts.runs(frames[:, 0])
    middles = (first.end + second.start) / 2, (second.end + third.start) / 2
    assert (begin / FPS, end / FPS) == pytest.approx(middles, abs=1.5 / FPS)
    ends = with_stances(walk, {"left": (dataclasses.replace(first, left_out=True),), "right": ()})
    frames = left_out_frames(ends)
    assert frames is not None and frames[:, 0].all() and not frames[:, 1].any()


def test_stances_that_are_left_out_do_not_make_ground(walk):
    used = find_stances(walk, 0.0).used
    left = tuple(dataclasses.replace(each, left_out=True) for each in stances_of(walk)["left"])
    without = find_stances(with_stances(walk, {**stances_of(walk), "left": left}), 0.0)
    assert len(without.used) == len(used) and used.all()
    np.testing.assert_array_equal(without.used, without.leg == 1)


def test_stances_are_the_less_probable_the_faster_and_the_shorter_they_are():
    walk = stair_walk(flat_floor, 4)
    found = dataclasses.replace(walk, stance=None)
    listed = [stance for of_leg in stances_of(found).values() for stance in of_leg]
    assert min(stance.probability or 0.0 for stance in listed) > 0.95

    balls, labels = walk.joints_ws(3), found.stance_labels()

    def probabilities(drift: float, stance: np.ndarray) -> np.ndarray:
        seconds = np.arange(len(balls))[:, None, None] / FPS
        slid = balls + seconds * [0.0, 0.0, drift]
        return contacts.stance_probability(slid, stance, FPS)[stance]

    still, slow, fast, faster = (probabilities(v, labels).mean() for v in (0, 0.1, 0.2, 0.3))
    assert still > slow > fast > 0.5 > faster
    slid = walk.positions_ws.copy()
    for joints, speed in zip(walk.rig.joints, (0.23, -0.23), strict=True):
        slid[:, joints, 0] += speed * np.arange(walk.frame_count)[:, None] / FPS
    sliding = found.with_motion(slid, walk.rotations_ws)
    assert not any("may be none" in text for text in summary.describe(found)["warnings"])
    warning = summary.describe(sliding)["warnings"][-1]
    assert re.search(r"may be none: (left|right) from .* \([3-6]\d%\), .* and \d more;", warning)
    short = labels & ~np.roll(labels, 6, axis=0)
    assert probabilities(0.0, short).mean() < still - 0.1


def test_the_file_is_printed_to_be_edited_and_inspection_says_that_it_counts(file, capsys):
    assert main.main(["inspect", str(file)]) == 0
    told = capsys.readouterr().out
    assert "(from the contacts file)" in told and BESIDE in told
    contacts_path(file).write_text("")  # as the shell leaves it before the program runs
    assert main.main(["inspect", str(file), "--contacts"]) == 0
    contacts_path(file).write_text(capsys.readouterr().out)
    clip = load_clip(file)
    assert clip.remarks[-1].endswith("7 stances, 0 by hand, 0 left out of the fit")
