"""What tells programs apart and what their files hold: trees as JSON, keys, and whole files only.

Equal keys in another process are checked with the programs that are kept.
"""

import dataclasses
import functools
import hashlib
import json
import math
import os
import pickle
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from fitting.runtime import files, plain_tree, program_cache
from fitting.runtime.plain_tree import NotPlainError, describe, rebuild
from fitting.runtime.program_cache import MAGIC, Program, Slot

# Trees


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


def text_of(tree):
    return json.dumps(describe(tree))


def read_back(tree):
    return rebuild(json.loads(text_of(tree)))


def test_a_tree_is_read_back_as_it_was_and_objects_without_their_constructor():
    for tree in (
        None, True, 3, 0.1, -0.0, math.inf, "text", [], (), {},
        [1, (2.0, "a"), {"b": [None], "a": ("list", "x")}],
        {1: "number", "1": "text"},
        Pair(1, [Slot(0), Slot(1)]),
    ):  # fmt: skip
        again = read_back(tree)
        assert again == tree and type(again) is type(tree)
        assert text_of(again) == text_of(tree)
    again = read_back(Layer(3, Checked(4)))
    assert isinstance(again, Layer) and again.size == 3 and again.weights.value == 4
    assert again.weights.constructed == [4], "as it was stored, not appended to again"


def test_trees_that_differ_have_different_texts_and_the_order_of_a_dictionary_is_no_difference():
    pairs = [(1, 1.0), (1, True), ((), []), ("None", None), ((1, 2), Pair(1, 2)), ("a", ["a"])]
    assert [pair for pair in pairs if text_of(pair[0]) == text_of(pair[1])] == []
    assert describe({"a": 1, "b": 2}) == describe({"b": 2, "a": 1})


def local():
    return lambda: None


@pytest.mark.parametrize(
    "tree",
    [
        local, local(), functools.partial(files.write), {1, 2}, b"bytes", 1j, object(),
        Slot(0).__eq__, [{"deep": local}],
    ],
)  # fmt: skip
def test_only_what_a_name_or_value_identifies_is_described(tree):
    with pytest.raises(NotPlainError):
        describe(tree)
    assert describe(files.write) == ["name", "fitting.runtime.files:write"]
    assert describe(float) == ["name", "builtins:float"]
    with pytest.raises(ValueError, match="describes no tree"):
        read_back(files.write)


HOSTILE = [
    ["object", "subprocess:Popen", {"args": "true"}],
    ["object", "builtins:object", {}],
    ["object", "pathlib:Path", {}],
    ["object", "fitting.runtime.files:os.system", {}],
    ["object", "fitting.runtime.files:write_text", {}],
    ["object", "fitting.runtime.program_cache:Path", {}],
    ["object", "fitting.runtime.program_cache:Slot", {"index": 1, "__class__": 2}],
    ["object", "fitting.runtime.program_cache:Slot", {}],
    ["object", "fitting.never.imported:Class", {}],
    ["object", "equinox:filter_jit", {}],
    ["object", "jax.numpy:ndarray", {}],
    ["namedtuple", "fitting.runtime.program_cache:Slot", 1],
    ["namedtuple", "fitting.runtime.program_cache:ArrayType", 1],
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


# Keys


def key(*args, **named):
    return program_cache.program_key(files.write, (args, named))


def test_whatever_changes_a_program_changes_its_key_sources_and_versions_too(monkeypatch):
    x = jnp.ones((2, 3))
    keys = [key(x), key(x[None]), key(x.astype("float32")), key(jnp.asarray(1.0)), key(1.0)]
    keys += [key(x, None), key(None, x), key(x, by=1), key(x, by=True)]
    keys += [program_cache.program_key(files.write_text, ((x,), {}))]
    with jax.default_matmul_precision("float32"):
        keys.append(key(x))
    with jax.enable_x64(False):
        keys.append(key(x))
    assert len(set(keys)) == len(keys)
    assert key(jnp.zeros((2, 3))) == key(x)

    def closure():
        return monkeypatch

    monkeypatch.setattr(closure, "__module__", "fitting.somewhere")
    for function in (key, local(), closure):  # of a user, and what its source does not tell
        with pytest.raises(NotPlainError, match="not a named function of this project"):
            program_cache.program_key(function, ((), {}))
    before, both = key(1), program_cache.sources()
    for part, changed in {"versions": {"jax": "1.2.3"}, "sources": "changed"}.items():
        with monkeypatch.context() as patch:
            patch.setattr(program_cache, part, lambda changed=changed: changed)
            assert key(1) != before, part
    monkeypatch.setattr(plain_tree, "PROJECT", ("jaxik",))
    assert program_cache.sources.__wrapped__() != both


# Files

KEY, VERSIONS = "a key", {"jax": "1.2.3"}


@pytest.fixture
def file(tmp_path):
    vector = jax.ShapeDtypeStruct((3,), float)
    exported = export.export(jax.jit(lambda x: [jnp.sin(x)]))(vector)
    path = tmp_path / "program"
    program_cache.write(path, Program(exported, {"sine": Slot(0), "name": "wave"}), KEY, VERSIONS)
    return path


def read(file):
    return program_cache.read(file, KEY, VERSIONS)


def test_a_program_is_read_back_its_header_is_plain_and_no_file_is_no_program(file):
    assert read(file.with_name("none")) is None
    x = jnp.arange(3.0)
    output = read(file).call([x])
    np.testing.assert_array_equal(output.pop("sine"), jnp.sin(x))
    assert output == {"name": "wave"}
    magic, header, body = file.read_bytes().split(b"\n", 2)
    assert magic == b"jaxik program 1"
    sine = ["object", "fitting.runtime.program_cache:Slot", {"index": 0}]
    assert json.loads(header) == {
        "key": KEY,
        "versions": VERSIONS,
        "output": ["dict", ["name", "wave"], ["sine", sine]],
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    assert export.deserialize(bytearray(body)).fun_name


def test_a_file_that_is_cut_off_anywhere_or_of_another_program_is_refused(file):
    for key, versions, message in (
        ("other", VERSIONS, "key is 'a key'"),
        (KEY, {"jax": "1.2.4"}, "versions is .*1.2.3"),
    ):
        with pytest.raises(ValueError, match=f"{file} is damaged: its {message}"):
            program_cache.read(file, key, versions)
    whole = file.read_bytes()
    header_end = whole.index(b"\n", len(MAGIC)) + 1
    for length in (0, 1, len(MAGIC), header_end - 1, header_end, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="is damaged"):
            read(file)


def changed(content, body=None, **header):
    """A file's content with some entries of its header changed, or with another whole body."""
    magic, before, body_before = content.split(b"\n", 2)
    if body is not None:
        header["sha256"] = hashlib.sha256(body).hexdigest()
    after = json.dumps(json.loads(before) | header).encode()
    return b"\n".join([magic, after, body or body_before])


class Hostile:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def test_a_hostile_file_is_refused_and_runs_no_code(file, tmp_path):
    whole, evil = file.read_bytes(), pickle.dumps(Hostile(tmp_path / "mark"))
    target = "xla_ffi_python_cpu_callback"
    vector = jax.ShapeDtypeStruct((3,), float)
    call = jax.ffi.ffi_call(target, vector)
    check = export.DisabledSafetyCheck.custom_call(target)
    python = jax.jit(lambda x: call(x, index=np.uint64(0)))
    calls_python = export.export(python, disabled_checks=[check])(vector).serialize()
    for forged, message in (
        (evil, "begins with b'.x80"),
        (MAGIC + evil, "is damaged"),
        (changed(whole, evil), "is damaged"),
        (whole.replace(MAGIC, b"jaxik program 2\n", 1), "program 2"),
        (changed(whole, output=["object", "os:_wrap_close", {}]), "os:_wrap_close is not a class"),
        (changed(whole, output=["name", "os:system"]), "describes no tree"),
        (changed(whole, bytes(calls_python)), "the program calls Python"),
    ):
        file.write_bytes(forged)
        with pytest.raises(ValueError, match=message):
            read(file)
        assert not (tmp_path / "mark").exists()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_file_that_everybody_may_write_and_one_of_another_user_are_not_read(file, monkeypatch):
    file.chmod(0o666)
    with pytest.raises(PermissionError, match=f"everybody may write to {file}"):
        read(file)
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    with pytest.raises(PermissionError, match=f"{file} belongs to another user"):
        read(file)
