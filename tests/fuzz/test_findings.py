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

Change = Callable[[bytes], bytes]
DIGITS = 400 * b"0"


def text(old: bytes, new: bytes) -> Change:
    """Replaces text that has to be there."""

    def change(content: bytes) -> bytes:
        assert old in content
        return content.replace(old, new, 1)

    return change


def array(name: str, change_array: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Changes an array of an archive."""

    def change(content: bytes) -> bytes:
        with np.load(io.BytesIO(content)) as archive:
            present = dict(archive)
        return archive_of(present | {name: change_array(present[name])})

    return change


def without_normals(content: bytes) -> bytes:
    return content.replace(b"facet normal", b"facet x").replace(b"endfacet x", b"")


FEMUR = b"direction 0 -1 0\n    length 7"
LONG_FEMUR = b"direction 0 -1e300 0\nlength 1e300"
STATE = b'"has_uint32": '
FOUND: dict[str, list[Change]] = {  # what is refused, by format
    "clip, ASF": [text(FEMUR, LONG_FEMUR)],
    "clip, BVH": [text(b"Frames: 3", b"Frames: " + b"9" * 5000)],
    "clip, NPZ": [array("rig_thigh", lambda bone: np.full_like(bone, 5e-172))],
    "mesh, OBJ": [lambda _: b"v 0\nv 1\nv 2\nf 1 2 3\n"],
    "heightfield": [array("heights", lambda heights: 0.0 * heights + 1e300)],
    "truth": [text(b"planted_height = 0.125", b"planted_height = 1e300")],
    "parameters": [text(b"layers = 4294967295", b"layers = inf")],
    "free parameters": [
        text(b"low = 0.0", b"low = 1" + DIGITS),
        text(b"lean.gain", b"lean.gian"),  # a free parameter in no file
    ],
    "tracks": [text(b"[[0.5, 0.4]]", b"[[]]"), text(b"0.5]", b"1" + DIGITS + b"]")],
    "experiment": [
        text(b"[hierarchy]", b"[hierarchy]\nper_clip = [[]]"),
        text(b"agreement = 3.0", b"agreement = 1" + DIGITS),
        text(b'terrain = "', b'terrain = "' + 300 * b"x"),
    ],
    "state of a fit": [text(STATE + b"0", STATE + 100 * b"9")],
}
LOADED: dict[str, list[Change]] = {
    "clip, NPZ": [array("rig_thigh", lambda bone: bone.astype(np.float32))],
    "mesh, STL text": [without_normals],
}


@pytest.mark.parametrize("x64", [False, True], ids=["32 bits", "64 bits"])
def test_what_was_found_is_mended(x64, tmp_path):
    for key in FOUND | LOADED:
        form = FORMATS[key]
        path = tmp_path / form.file
        for other, whole in form.beside.items():
            (tmp_path / other).write_bytes(whole())
        cases = [("loaded", bytes), *(("refused", change) for change in FOUND.get(key, ()))]
        cases += [("loaded", change) for change in LOADED.get(key, ())]
        for number, (outcome, change) in enumerate(cases):
            with jax.enable_x64(x64):
                path.write_bytes(change(form.whole()))
                assert try_to_load(form.load, path, form.names) == outcome, (key, number)


def test_a_message_shows_no_control_characters(tmp_path, capsys):
    path = tmp_path / "walk.bvh"
    path.write_text(BVH.replace("JOINT LeftUpLeg\n", "JOINT \x1b[2J\u202e\n x\n"))
    assert main.main(["inspect", str(path)]) == main.MISTAKE
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error[:-1].isprintable() and r"\x1b[2J\u202e" in error
