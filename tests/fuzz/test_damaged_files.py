"""Damaged files of every format load as sound things or are refused in one sentence.

A short run of the fuzzer, whose long one is `PYTHONPATH=tests python -m fuzz`; what it has found;
and files that claim more than they have, or would be larger in memory than they are.
"""

import io
import json
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
import pytest
import trimesh
from trimesh.exchange.gltf import export_gltf

from fitting.cli import main
from fitting.clips import load_clip
from fitting.clips.formats import npz
from fitting.ground.meshes import load_terrain
from fuzz.damage import archive_of, glb_of, parts_of_glb
from fuzz.formats import FORMATS, mesh_bytes
from fuzz.trial import OUTCOMES, run_trials, try_to_load
from jaxik.world import cells
from support.sample_clips import BVH

COUNT = 20  # files of each format, or more until some are loaded and some refused


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_loads_or_is_refused_in_one_sentence(name, tmp_path):
    form = FORMATS[name]
    outcomes: dict[int, str] = {}
    for number, outcome in run_trials(form, tmp_path, seed=0, count=4 * COUNT):
        outcomes[number] = outcome
        if number >= COUNT - 1 and set(outcomes.values()) >= set(OUTCOMES):
            break
    assert not {number: outcome for number, outcome in outcomes.items() if outcome not in OUTCOMES}
    assert set(outcomes.values()) == set(OUTCOMES), "the damage is too weak, or too strong"


# What the fuzzers have found: each once cost more than a sentence

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


FEMUR = b"direction 0 -1 0\n    length 7"
LONG_FEMUR = b"direction 0 -1e300 0\nlength 1e300"
STATE = b'"has_uint32": '
REFUSED: dict[str, list[Change]] = {
    "clip, ASF": [text(FEMUR, LONG_FEMUR)],
    "clip, BVH": [text(b"Frames: 3", b"Frames: " + b"9" * 5000)],
    "clip, NPZ": [
        array("rig_thigh", lambda bone: np.full_like(bone, 5e-172)),
        array("joint_names", lambda names: np.repeat(names[:1], len(names))),
        array("rig_names", lambda names: np.repeat(names[:1], len(names))),
    ],
    "mesh, OBJ": [lambda _: b"v 0\nv 1\nv 2\nf 1 2 3\n"],
    "heightfield": [array("heights", lambda heights: 0.0 * heights + 1e300)],
    "truth": [text(b"planted_height = 0.125", b"planted_height = 1e300")],
    "parameters": [text(b"layers = 4294967295", b"layers = inf")],
    "free parameters": [
        text(b"low = 0.0", b"low = 1" + DIGITS),
        text(b"lean.half_life", b"lean.gian"),  # a free parameter in no file
    ],
    "tracks": [text(b"[[0.5, 0.4]]", b"[[]]"), text(b"0.5]", b"1" + DIGITS + b"]")],
    "experiment": [
        text(b"[hierarchy]", b"[hierarchy]\nper_clip = [[]]"),
        text(b"agreement = 3.0", b"agreement = 1" + DIGITS),
        text(b'terrain = "', b'terrain = "' + 300 * b"x"),
    ],
    "state of a fit": [text(STATE + b"0", STATE + 100 * b"9")],
    "search of a population": [text(b'"cost": 10.5', b'"cost": NaN')],
}
LOADED: dict[str, Change] = {
    "clip, NPZ": array("rig_thigh", lambda bone: bone.astype(np.float32)),
    "mesh, STL text": lambda content: content.replace(b"facet normal", b"facet x").replace(
        b"endfacet x", b""
    ),
}


@pytest.mark.parametrize("x64", [False, True], ids=["32 bits", "64 bits"])
def test_what_was_found_is_mended(x64, tmp_path):
    for key in REFUSED | LOADED:
        form = FORMATS[key]
        path = tmp_path / form.file
        path.parent.mkdir(exist_ok=True)
        for other, whole in form.beside.items():
            (tmp_path / other).write_bytes(whole())
        cases = [("loaded", bytes), *(("refused", change) for change in REFUSED.get(key, ()))]
        cases.append(("loaded", LOADED.get(key, bytes)))
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


# Files that claim more than they have

HUGE, LARGE = 10**10, 10**8
MEMORY = 2**25  # bytes, for a file of some kilobytes


def with_peak_memory(work: Callable[..., Any], *arguments: object) -> tuple[Any, int]:
    """What a function gives, and the bytes that NumPy and Python take for it at most."""
    tracemalloc.start()
    try:
        return work(*arguments), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def archive_with_claim(name: str, shape: tuple[int, ...]) -> bytes:
    """An archive with an array of 64 bytes that says it has another shape."""
    array = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(array, header)
    file = io.BytesIO(archive_of({"spacing": np.ones(2), "format": np.array("jaxik clip 1")}))
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr(f"{name}.npy", array.getvalue() + bytes(64))
    return file.getvalue()


def glb_with(part: str, **changes: Any) -> bytes:
    """A binary glTF with other entries in a part of its JSON, or without; all lengths right."""
    head, numbers = parts_of_glb(mesh_bytes("glb"))
    header = json.loads(head)
    for item in header[part]:
        item |= changes
        if changes.get("bufferView", 0) is None:
            del item["bufferView"]
    return glb_of(json.dumps(header).encode(), numbers)


def claims() -> Iterator[tuple[str, str, bytes]]:
    """The format of each file, what it claims, and its content."""
    text, binary = mesh_bytes("ply", encoding="ascii"), mesh_bytes("ply")
    stl, glb = mesh_bytes("stl"), mesh_bytes("glb")
    off = b"OFF\n%d %d 0\n0 0 0\n1 0 0\n0 0 1\n3 0 1 2\n"
    obj = b"v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 %d\n"
    frames = "Frames: 3"
    yield "mesh, GLB", "length", glb[:8] + b"\xff" * 4 + glb[12:]
    yield "mesh, GLB", "chunk", glb[:12] + b"\xff\xff\xff\x7f" + glb[16:]
    yield "mesh, GLB", "no bytes", glb_with("accessors", count=LARGE, bufferView=None)
    yield "clip, BVH", "channels", BVH.replace("LS 6", f"LS {HUGE}").encode()
    for size in (HUGE, LARGE):
        half = round(size**0.5)
        for old, new in (("vertex 16", f"vertex {size}"), ("face 18", f"face {size}")):
            old, new = f"element {old}".encode(), f"element {new}".encode()
            yield "mesh, PLY", f"{new}", binary.replace(old, new)
            yield "mesh, PLY text", f"{new}", text.replace(old, new)
        yield "mesh, STL", f"{size}", stl[:80] + struct.pack("<I", size % 2**32) + stl[84:]
        yield "mesh, OFF", f"{size}", off % (size, size)
        yield "mesh, OBJ", f"{size}", obj % size
        yield "mesh, OBJ", f"-{size}", obj % -size
        for part, key in (("buffers", "byteLength"), ("bufferViews", "byteLength")):
            yield "mesh, GLB", f"{size} in {part}", glb_with(part, **{key: size})
        yield "mesh, GLB", f"{size} values", glb_with("accessors", count=size)
        yield "heightfield", f"{size}", archive_with_claim("heights", (half, half))
        yield "clip, NPZ", f"{size}", archive_with_claim("positions_ws", (size, 10, 3))
        yield "clip, BVH", f"{size} frames", BVH.replace(frames, f"Frames: {size}").encode()


def test_a_claim_is_not_believed(tmp_path):
    whole = set()
    for key, what, content in claims():
        form = FORMATS[key]
        path = tmp_path / form.file
        if key not in whole:  # compiles, which takes memory, too
            path.write_bytes(form.whole())
            form.load(path)
            whole.add(key)
        path.write_bytes(content)
        outcome, taken = with_peak_memory(try_to_load, form.load, path, form.names)
        assert taken < MEMORY and outcome in OUTCOMES, (key, what, outcome)


def thin(count: int, width: float) -> np.ndarray:
    """Triangles in the plane, each a metre long or more and almost without width."""
    side = np.linspace(0.0, 1e-3, count)[:, None] * [1.0, -1.0]
    begin, end = side, side + 1.0
    return np.stack([begin, end, end + [0.0, width]], axis=1)


def spread(count: int, size: float, extent: float) -> np.ndarray:
    """Small triangles, far apart."""
    random = np.random.default_rng(0)
    centres = random.uniform(0.0, extent, (count, 1, 2))
    return centres + random.uniform(-size, size, (count, 3, 2))


ANGLES = np.linspace(0.0, 2 * np.pi, 2000, endpoint=False)
RIM = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
PLANS = {
    "side by side": thin(1000, 1e-7),
    "on each other": np.repeat(spread(1, 1.0, 1.0), 4000, axis=0),
    "across each other": np.concatenate([thin(1000, 1e-4), thin(1000, 1e-4)[..., ::-1] * [1, -1]]),
    "in 10 km": spread(4000, 1e-3, 1e4),
    "in a heap, and one 10 km away": np.concatenate(
        [spread(4000, 1e-3, 0.1), 1e4 + spread(1, 1e-3, 1.0)]
    ),
    "small ones, and one of 10 km": np.concatenate(
        [spread(4000, 1e-3, 10.0), 1e4 * np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])]
    ),
    "a fan": np.stack([0.0 * RIM, RIM, np.roll(RIM, -1, axis=0)], axis=1),
}


def test_the_grid_of_a_mesh_is_as_large_as_the_mesh():
    for name, plan in PLANS.items():
        begin = time.process_time()
        lists, taken = with_peak_memory(cells.build, plan, np.ones(len(plan), bool), 1e-6)
        assert time.process_time() - begin < 10.0, name
        assert taken < 200 * plan.nbytes, name
        assert max(len(lists.members), len(lists.children)) < 100 * len(plan), name


def test_an_archive_is_no_mesh_and_is_not_read_where_its_arrays_are_large(tmp_path, monkeypatch):
    for suffix in ("zip", "tar.gz", "bz2"):
        path = tmp_path / f"hill.{suffix}"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("hill.obj", "v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n" + " " * 10**6)
        with pytest.raises(ValueError, match="wanted a heightfield .* or a mesh that trimesh"):
            load_terrain(path)
    path = tmp_path / "clip.npz"
    path.write_bytes(FORMATS["clip, NPZ"].whole())
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.npy", bytes(2**24))
    monkeypatch.setattr(npz, "MAX_BYTES", 2**24)
    assert path.stat().st_size < 2**17
    with pytest.raises(ValueError, match="its arrays take 16[0-9]{6} bytes; wanted 16777216 at"):
        load_clip(path)


def test_a_gltf_reads_its_own_buffers_and_no_file_outside_its_folder(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 2, 1]], process=False)
    inside = tmp_path / "inside"
    inside.mkdir()
    for name, content in export_gltf(trimesh.Scene(mesh)).items():
        (inside / name).write_bytes(content)
    file, buffer = inside / "model.gltf", min(inside.glob("*.bin"))
    load_terrain(file)
    buffer.rename(tmp_path / buffer.name)
    file.write_text(file.read_text().replace(buffer.name, f"../{buffer.name}"))
    with pytest.raises(ValueError, match="model.gltf: .*wanted a file beside this one"):
        load_terrain(file)
