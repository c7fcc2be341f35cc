"""Damaged files of every format load as sound things or are refused in one sentence.

A short run; `PYTHONPATH=tests python -m fuzz` is the long one.
"""

import logging
import warnings
from pathlib import Path

import numpy as np
import pytest

from fuzz import trial
from fuzz.damage import damage_text
from fuzz.formats import FORMATS
from fuzz.trial import OUTCOMES, run_trials, try_to_load

COUNT = 60  # files of each format


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_loads_or_is_refused_in_one_sentence(name, tmp_path):
    outcomes = dict(run_trials(FORMATS[name], tmp_path, seed=0, count=COUNT))
    assert not {number: outcome for number, outcome in outcomes.items() if outcome not in OUTCOMES}
    assert set(outcomes.values()) == set(OUTCOMES), "the damage is too weak, or too strong"


def test_the_same_seed_makes_the_same_files():
    content = FORMATS["experiment"].whole()
    first, again, other = (damage_text(np.random.default_rng(seed), content) for seed in (1, 1, 2))
    assert first == again != other


def _forget_the_name(path: Path) -> None:
    raise ValueError("wrong")


def _warn(path: Path) -> None:
    warnings.warn("odd", UserWarning, stacklevel=1)


def _print(path: Path) -> None:
    logging.getLogger("library").warning("odd")


def _never_return(path: Path) -> None:
    while True:
        pass


@pytest.mark.parametrize(
    "load, outcome",
    [
        (_forget_the_name, "without the name of the file: wrong"),
        (_warn, "UserWarning: odd"),
        (_print, "printed: 'odd'"),
        (_never_return, "TooSlowError"),
        (lambda path: {}["key"], "KeyError"),
        (lambda path: np.ones(2**33, np.uint8), "MemoryError"),
        (lambda path: path.read_text(), "refused"),
        (lambda path: None, "loaded"),
    ],
    ids=["name", "warning", "print", "time", "error", "memory", "refused", "loaded"],
)
def test_a_trial_sees_what_a_loader_does(load, outcome, tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "SECONDS", 0.2)
    path = tmp_path / "file"
    assert outcome in try_to_load(load, path, (path.name,))
