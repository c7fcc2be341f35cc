"""Trees as JSON: equal trees have equal texts, and reading a text runs no code."""

import dataclasses
import functools
import json
import math
from typing import Any, NamedTuple

import equinox as eqx
import pytest

from fitting.runtime import files, plain_tree
from fitting.runtime.plain_tree import NotPlainError, describe, rebuild
from fitting.runtime.program_file import Slot


class Pair(NamedTuple):
    first: object
    second: object


@dataclasses.dataclass(frozen=True)
class Checked:
    """A stand-in for a dataclass of the project; its constructor must not run."""

    value: object
    constructed: list = dataclasses.field(default_factory=list)

    def __post_init__(self):
        self.constructed.append(self.value)


class Layer(eqx.Module):
    size: int = eqx.field(static=True)
    weights: Any


@pytest.fixture(autouse=True)
def of_the_project(monkeypatch):
    """The classes above, found as those of a module of the project."""
    for cls in (Pair, Checked, Layer):
        monkeypatch.setattr(cls, "__module__", plain_tree.__name__)
        monkeypatch.setattr(plain_tree, cls.__qualname__, cls, raising=False)


def read_back(tree):
    return rebuild(json.loads(json.dumps(describe(tree))))


@pytest.mark.parametrize(
    "tree",
    [
        None, True, 3, 0.1, -0.0, math.inf, "text", [], (), {},
        [1, (2.0, "a"), {"b": [None], "a": ("list", "x")}],
        {1: "number", "1": "text"},
        Pair(1, [Slot(0), Slot(1)]),
    ],
    ids=str,
)  # fmt: skip
def test_a_tree_is_read_back_as_it_was(tree):
    again = read_back(tree)
    assert again == tree and type(again) is type(tree)
    assert json.dumps(describe(again)) == json.dumps(describe(tree))


def test_objects_are_read_back_without_their_constructor():
    again = read_back(Layer(3, Checked(4)))
    assert isinstance(again, Layer) and again.size == 3 and again.weights.value == 4
    assert again.weights.constructed == [4], "as it was stored, not appended to again"


@pytest.mark.parametrize(
    ("a", "b"),
    [(1, 1.0), (1, True), ((), []), ("None", None), ((1, 2), Pair(1, 2)), ("list", ["list"])],
)
def test_trees_that_differ_have_different_texts(a, b):
    assert json.dumps(describe(a)) != json.dumps(describe(b))


def test_the_order_of_a_dictionary_makes_no_difference():
    assert describe({"a": 1, "b": 2}) == describe({"b": 2, "a": 1})


def test_functions_and_classes_are_described_by_name_and_not_read_back():
    assert describe(files.write) == ["name", "fitting.runtime.files:write"]
    assert describe(float) == ["name", "builtins:float"]
    with pytest.raises(ValueError, match="describes no tree"):
        read_back(files.write)


def local():
    return lambda: None


@pytest.mark.parametrize(
    "tree",
    [
        local, local(), functools.partial(files.write), {1, 2}, b"bytes", 1j, object(),
        Slot(0).__eq__, [{"deep": local}],
    ],
)  # fmt: skip
def test_what_no_name_or_value_identifies_is_refused(tree):
    with pytest.raises(NotPlainError):
        describe(tree)


HOSTILE = [
    ["object", "subprocess:Popen", {"args": "true"}],
    ["object", "builtins:object", {}],
    ["object", "pathlib:Path", {}],
    ["object", "fitting.runtime.files:os.system", {}],
    ["object", "fitting.runtime.files:write_text", {}],
    ["object", "fitting.runtime.program_file:Path", {}],
    ["object", "fitting.runtime.program_file:Slot", {"index": 1, "__class__": 2}],
    ["object", "fitting.runtime.program_file:Slot", {}],
    ["object", "fitting.never.imported:Class", {}],
    ["object", "equinox:filter_jit", {}],
    ["object", "jax.numpy:ndarray", {}],
    ["namedtuple", "fitting.runtime.program_file:Slot", 1],
    ["namedtuple", "fitting.runtime.program_key:ArrayType", 1],
    ["name", "os:system"],
    ["call", "os:system", "true"],
    ["object", 3, {}],
    ["object"],
    [],
    {"object": 1},
]


@pytest.mark.parametrize("description", HOSTILE, ids=str)
def test_a_description_reaches_nothing_but_fields_of_known_classes(description):
    with pytest.raises(ValueError):
        rebuild(["list", description])
