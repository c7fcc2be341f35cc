"""Long work announces itself, to whoever watches."""

import pytest

from fitting.runtime import activity
from support.watching import Recorder


def test_work_within_work_is_announced_in_order_and_ends_before_it():
    recorder = Recorder()
    with activity.watched_by(recorder), activity.announced("outer", 2) as outer:
        with outer.part("first"):
            activity.note("in the first")
        with outer.part("second"):
            pass
        activity.note("in the outer")
    assert recorder.events == [
        "began outer", "began first", "noted in the first", "ended first", "outer 1 of 2",
        "began second", "ended second", "outer 2 of 2", "noted in the outer", "ended outer",
    ]  # fmt: skip


def test_work_that_fails_has_ended():
    recorder = Recorder()
    with pytest.raises(KeyError), activity.watched_by(recorder), activity.announced("work") as work:
        raise KeyError
    assert recorder.events == ["began work", "ended work"] and work.failed


def test_without_a_watcher_work_only_counts():
    with activity.announced("work", 3) as work:
        work.advance()
        activity.note("a note")
    activity.note("after everything")
    assert (work.done, work.note) == (1, "a note")


def test_time_left_is_that_of_parts_that_were_done_since_it_began(monkeypatch):
    now = 100.0
    monkeypatch.setattr(activity.time, "monotonic", lambda: now)
    with activity.announced("work", 50, done=30) as work:
        assert work.seconds_left is None
        now = 120.0
        work.reach(40)
        assert work.seconds_each == 2.0 and work.seconds_left == 20.0
        work.reach(50)
        assert work.seconds_left is None
