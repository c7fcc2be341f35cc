"""A campaign: rows in the order of their tasks, stored at once, and gone on with."""

import pytest

from fitting.studies.campaign import Campaign


def campaign(stored: dict[str, str], make, **options) -> Campaign:
    return Campaign("Making", list("abc"), make, stored.get, stored.__setitem__, **options)


def failing(task: str) -> str:
    if task == "b":
        raise ValueError("no luck")
    return task.upper()


def test_rows_are_stored_as_they_end_and_only_missing_ones_are_made():
    stored, calls = {"b": "B"}, []

    def make(task: str) -> str:
        calls.append((task, sorted(stored)))
        return task.upper()

    assert campaign(stored, make).run() == ["A", "B", "C"]
    assert calls == [("a", ["b"]), ("c", ["a", "b"])]
    assert campaign(stored, make).run() == ["A", "B", "C"] and len(calls) == 2


def test_an_error_names_its_task_and_ends_the_campaign_unless_it_makes_a_row():
    stored: dict[str, str] = {}
    with pytest.raises(ValueError, match="b: no luck"):
        campaign(stored, failing).run()
    assert list(stored) == ["a"]
    rows = campaign(stored, failing, failed=lambda task, error: f"{task} failed: {error}").run()
    assert rows == ["A", "b failed: b: no luck", "C"]
    assert list(stored) == ["a", "c"], "what failed is tried again"


def test_an_interrupt_loses_the_row_that_is_being_made_and_no_other():
    stored: dict[str, str] = {}

    def interrupted(task: str) -> str:
        if task == "c":
            raise KeyboardInterrupt
        return task.upper()

    begun = campaign(stored, interrupted)
    with pytest.raises(KeyboardInterrupt):
        begun.run()
    assert begun.finished() == ["A", "B"] and begun.missing == [2]
    stored["c"] = "written by a worker"
    begun.read_stored()
    assert begun.finished() == ["A", "B", "written by a worker"]
