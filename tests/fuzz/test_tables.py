"""Any value anywhere in a TOML file: what is read is sound, or refused in one sentence."""

import copy
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzz.formats import FORMATS
from fuzz.trial import OUTCOMES, try_to_load

NAMES = ("experiment", "parameters", "settings", "free parameters", "tracks")
TEXTS = st.one_of(
    st.text(max_size=20),
    st.sampled_from(["lean.gain", "foot", "record", "left", "clip", "normal", "linear", "given"]),
)
NUMBERS = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.integers(-2, 100),
    st.floats(0, 1),
    st.sampled_from([1e-300, 1e300, 10.0**9, 0.999999999]),
)
VALUES = st.recursive(
    st.one_of(NUMBERS, TEXTS, st.booleans(), st.dates(), st.times()),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=4)),
    max_leaves=8,
)


def places(content: Any, path: tuple = ()) -> list[tuple]:
    """The way to each entry of nested tables and lists."""
    keys: Iterable = content if isinstance(content, dict) else ()
    if isinstance(content, list):
        keys = range(len(content))
    return [way for key in keys for way in [(*path, key), *places(content[key], (*path, key))]]


def changed(content: Any, way: tuple, value: object, key: str | None) -> Any:
    """The content with another value at a place, or with one more key in the table there."""
    content = copy.deepcopy(content)
    table = content
    for step in way[:-1]:
        table = table[step]
    table[way[-1] if key is None or not isinstance(table, dict) else key] = value
    return content


def check_any_value(name: str, folder: Path) -> Callable[[], None]:
    """The property of one format, for Hypothesis to run."""
    form = FORMATS[name]
    content = tomllib.loads(form.whole().decode())
    path = folder / form.file

    @settings(
        max_examples=60, deadline=None, derandomize=True, database=None,
        suppress_health_check=[HealthCheck.too_slow],
    )  # fmt: skip
    @given(way=st.sampled_from(places(content)), value=VALUES, key=st.one_of(st.none(), TEXTS))
    def run(way: tuple, value: object, key: str | None) -> None:
        path.write_text(tomli_w.dumps(changed(content, way, value, key)), encoding="utf-8")
        assert try_to_load(form.load, path, form.names) in OUTCOMES

    return run


@pytest.mark.parametrize("name", NAMES)
def test_any_value_anywhere_is_read_or_refused(name, tmp_path):
    check_any_value(name, tmp_path)()
