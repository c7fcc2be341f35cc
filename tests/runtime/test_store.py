"""What a store remembers, and what it refuses."""

from pathlib import Path
from typing import TypedDict

import pytest

from fitting.runtime.json_files import Finite, JsonFile, Store


class Sum(TypedDict):
    identity: str
    total: Finite


KIND = JsonFile(Sum, "a sum", "add again")
ONE: Sum = {"identity": "a", "total": 1.0}
KEY = {"identity": "a"}


def check(result: Sum) -> None:
    if result["total"] < 0.0:
        raise ValueError("its total is below 0")


def store(folder: Path | None) -> Store[Sum]:
    return Store(KIND, folder, "the sum of {identity!r}, with another {changed}", check)


def fail() -> Sum:
    raise KeyboardInterrupt


def test_a_result_is_computed_once_and_an_interrupt_stores_nothing(tmp_path):
    sums = store(tmp_path / "new" / "sums")
    with pytest.raises(KeyboardInterrupt):
        sums.remember("one.json", fail, KEY)
    assert not list(tmp_path.iterdir()) and sums.read("one.json") is None
    assert sums.remember("one.json", lambda: ONE, KEY) == ONE
    assert sums.remember("one.json", fail, KEY) == ONE


def test_without_a_folder_nothing_is_remembered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert store(None).remember("one.json", lambda: ONE) == ONE
    with pytest.raises(KeyboardInterrupt):
        store(None).remember("one.json", fail)
    assert not list(tmp_path.iterdir())


def test_a_result_of_another_key_and_one_that_cannot_be_are_refused_and_stay(tmp_path):
    sums, path = store(tmp_path), tmp_path / "one.json"
    sums.write(path.name, ONE)
    whole = path.read_text()
    with pytest.raises(ValueError, match=r"one\.json: the sum of 'a', with another identity; add"):
        sums.remember(path.name, fail, {"identity": "b"})
    assert path.read_text() == whole
    for change, message in (
        ({"total": -1.0}, "not a sum: its total is below 0; add again"),
        ({"total": "1"}, "not a sum: total is '1'; wanted a number; add again"),
    ):
        KIND.write(path, ONE | change)
        damaged = path.read_text()
        with pytest.raises(ValueError, match=message):
            sums.remember(path.name, fail, KEY)
        assert path.read_text() == damaged
