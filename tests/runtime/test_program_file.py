"""Files of traced programs: complete, this user's own, and the expected ones, or refused."""

import hashlib
import json
import os
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from fitting.runtime import program_file
from fitting.runtime.program_file import MAGIC, Program, Slot

KEY, VERSIONS = "a key", {"jax": "1.2.3"}


def program(function=jnp.sin):
    exported = export.export(jax.jit(lambda x: [function(x)]))(jax.ShapeDtypeStruct((3,), float))
    return Program(exported, {"sine": Slot(0), "name": "wave"})


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "program"
    program_file.write(path, program(), KEY, VERSIONS)
    return path


def read(file):
    return program_file.read(file, KEY, VERSIONS)


def test_a_program_is_read_back_and_no_file_is_no_program(file):
    assert read(file.with_name("none")) is None
    x = jnp.arange(3.0)
    output = read(file).call([x])
    np.testing.assert_array_equal(output.pop("sine"), jnp.sin(x))
    assert output == {"name": "wave"}


def test_the_header_is_plain(file):
    magic, header, body = file.read_bytes().split(b"\n", 2)
    assert magic == b"jaxik program 1"
    assert json.loads(header) == {
        "key": KEY,
        "versions": VERSIONS,
        "output": [
            "dict",
            ["name", "wave"],
            ["sine", ["object", "fitting.runtime.program_file:Slot", {"index": 0}]],
        ],
        "sha256": hashlib.sha256(body).hexdigest(),
    }
    assert export.deserialize(bytearray(body)).fun_name


@pytest.mark.parametrize(
    ("key", "versions", "message"),
    [("other", VERSIONS, "key is 'a key'"), (KEY, {"jax": "1.2.4"}, "versions is .*1.2.3")],
)
def test_a_file_of_another_program_is_refused(file, key, versions, message):
    with pytest.raises(ValueError, match=f"{file} is damaged: its {message}"):
        program_file.read(file, key, versions)


def test_a_file_that_is_cut_off_anywhere_is_refused(file):
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
    for forged, message in (
        (evil, "begins with b'.x80"),
        (MAGIC + evil, "is damaged"),
        (changed(whole, evil), "is damaged"),
        (whole.replace(MAGIC, b"jaxik program 2\n", 1), "program 2"),
        (changed(whole, output=["object", "os:_wrap_close", {}]), "os:_wrap_close is no class"),
        (changed(whole, output=["name", "os:system"]), "describes no tree"),
    ):
        file.write_bytes(forged)
        with pytest.raises(ValueError, match=message):
            read(file)
        assert not (tmp_path / "mark").exists()


def test_a_program_that_calls_python_is_refused(file):
    target = "xla_ffi_python_cpu_callback"
    call = jax.ffi.ffi_call(target, jax.ShapeDtypeStruct((3,), float))
    exported = export.export(
        jax.jit(lambda x: call(x, index=np.uint64(0))),
        disabled_checks=[export.DisabledSafetyCheck.custom_call(target)],
    )(jax.ShapeDtypeStruct((3,), float))
    file.write_bytes(changed(file.read_bytes(), bytes(exported.serialize())))
    with pytest.raises(ValueError, match="the program calls Python"):
        read(file)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
def test_a_file_that_everybody_may_write_and_one_of_another_user_are_not_read(file, monkeypatch):
    file.chmod(0o666)
    with pytest.raises(PermissionError, match=f"everybody may write to {file}"):
        read(file)
    monkeypatch.setattr(os, "getuid", lambda: 1_000_001)
    with pytest.raises(PermissionError, match=f"{file} belongs to another user"):
        read(file)
