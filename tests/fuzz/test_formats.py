"""Damaged files of every format load as sound things or are refused in one sentence.

A short run; `PYTHONPATH=tests python -m fuzz` is the long one.
"""

import logging
import warnings
from pathlib import Path

import numpy as np
import pytest

from fuzz import trial
from fuzz.damage import damage_arrays, damage_text, damage_toml
from fuzz.formats import FORMATS
from fuzz.trial import OUTCOMES, run_trials, try_to_load

COUNT = 60  # files of each format
MORE = (damage_toml, damage_arrays)  # of what has many places to be wrong: twice as many


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_loads_or_is_refused_in_one_sentence(name, tmp_path):
    form = FORMATS[name]
    count = 2 * COUNT if form.damage in MORE else COUNT
    outcomes = dict(run_trials(form, tmp_path, seed=0, count=count))
    assert not {number: outcome for number, outcome in outcomes.items() if outcome not in OUTCOMES}
    assert set(outcomes.values()) == set(OUTCOMES), "the damage is too weak, or too strong"


def test_the_same_seed_makes_the_same_files():
    content = FORMATS["experiment"].whole()
    first, again, other = (damage_text(np.random.default_rng(seed), content) for seed in (1, 1, 2))
    assert first == again != other


def forget_the_name(path: Path) -> None:
    raise ValueError("wrong")


def never_return(path: Path) -> None:
    while True:
        pass


LOADERS = {
    "without the name of the file: wrong": forget_the_name,
    "UserWarning: odd": lambda path: warnings.warn("odd", UserWarning, stacklevel=1),
    "printed: 'odd'": lambda path: logging.getLogger("library").warning("odd"),
    "TooSlowError": never_return,
    "KeyError": lambda path: {}["key"],
    "MemoryError": lambda path: np.ones(2**33, np.uint8),
    "refused": Path.read_text,
    "loaded": lambda path: None,
}


def test_a_trial_sees_what_a_loader_does(tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "SECONDS", 0.2)
    for outcome, load in LOADERS.items():
        assert outcome in try_to_load(load, tmp_path / "file", ("file",))
