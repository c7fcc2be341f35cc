"""Files that the fuzzers have found: each once cost more than a sentence."""

import io
from collections.abc import Callable

import jax
import numpy as np
import pytest

from fitting.cli import main
from fuzz.damage import archive_of
from fuzz.formats import FORMATS
from fuzz.trial import try_to_load
from support.sample_clips import BVH


def text(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    """Replaces text that has to be there."""

    def change(content: bytes) -> bytes:
        assert old in content
        return content.replace(old, new, 1)

    return change


def arrays(**changes: Callable[[np.ndarray], np.ndarray]) -> Callable[[bytes], bytes]:
    """Changes arrays of an archive."""

    def change(content: bytes) -> bytes:
        with np.load(io.BytesIO(content)) as archive:
            present = dict(archive)
        return archive_of(present | {name: f(present[name]) for name, f in changes.items()})

    return change


TRUTH = b"planted_height = 0.125"
LENGTHS = b"direction 0 -1 0\n    length 7"
FOUND: dict[str, tuple[str, Callable[[bytes], bytes], str]] = {  # format, change, outcome
    "overflow of a bone": (
        "clip, ASF",
        text(LENGTHS, b"direction 0 -1e300 0\nlength 1e300"),
        "refused",
    ),
    "thousands of digits": ("clip, BVH", text(b"Frames: 3", b"Frames: " + b"9" * 5000), "refused"),
    "a bone of no length": (
        "clip, NPZ",
        arrays(rig_thigh=lambda bone: np.full_like(bone, 5e-172)),
        "refused",
    ),
    "lengths of two precisions": (
        "clip, NPZ",
        arrays(rig_thigh=lambda bone: bone.astype(np.float32)),
        "loaded",
    ),
    "a vertex of one number": ("mesh, OBJ", lambda _: b"v 0\nv 1\nv 2\nf 1 2 3\n", "refused"),
    "a facet without normals": (
        "mesh, STL text",
        lambda content: content.replace(b"facet normal", b"facet x").replace(b"endfacet x", b""),
        "loaded",
    ),
    "a height beyond 32 bits": (
        "heightfield",
        arrays(heights=lambda heights: np.where(np.isnan(heights), heights, 1e300)),
        "refused",
    ),
    "a truth beyond 32 bits": ("truth", text(TRUTH, b"planted_height = 1e300"), "refused"),
    "an infinite mask": ("parameters", text(b"layers = 4294967295", b"layers = inf"), "refused"),
    "a bound beyond 64 bits": (
        "free parameters",
        text(b"low = 0.0", b"low = 1" + 400 * b"0"),
        "refused",
    ),
    "a free parameter in no file": ("free parameters", text(b"lean.gain", b"lean.gian"), "refused"),
    "no values for a time": ("tracks", text(b"[[0.5, 0.4]]", b"[[]]"), "refused"),
    "a value beyond 64 bits": ("tracks", text(b"0.5]", b"1" + 400 * b"0" + b"]"), "refused"),
    "a list as a name": (
        "experiment",
        text(b"[hierarchy]", b"[hierarchy]\nper_clip = [[]]"),
        "refused",
    ),
    "a number beyond 64 bits": (
        "experiment",
        text(b"agreement = 3.0", b"agreement = 1" + 400 * b"0"),
        "refused",
    ),
    "a name too long": (
        "experiment",
        text(b'terrain = "', b'terrain = "' + 300 * b"x"),
        "refused",
    ),
    "a random state of a hundred digits": (
        "state of a fit",
        text(b'"has_uint32": 0', b'"has_uint32": ' + 100 * b"9"),
        "refused",
    ),
}


@pytest.mark.parametrize("x64", [False, True], ids=["32 bits", "64 bits"])
@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_is_mended(name, x64, tmp_path):
    key, change, outcome = FOUND[name]
    form = FORMATS[key]
    for other, whole in form.beside.items():
        (tmp_path / other).write_bytes(whole())
    path = tmp_path / form.file
    with jax.enable_x64(x64):
        path.write_bytes(form.whole())
        assert try_to_load(form.load, path, form.names) == "loaded"
        path.write_bytes(change(form.whole()))
        assert try_to_load(form.load, path, form.names) == outcome


def test_a_message_shows_no_control_characters(tmp_path, capsys):
    path = tmp_path / "walk.bvh"
    path.write_text(BVH.replace("JOINT LeftUpLeg\n", "JOINT \x1b[2J\u202e\n x\n"))
    assert main.main(["inspect", str(path)]) == main.MISTAKE
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error[:-1].isprintable() and r"\x1b[2J\u202e" in error
