"""Files that claim more than they have, or would be larger in memory than they are."""

import io
import json
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.exchange.gltf import export_gltf

from fitting.datasets import archives
from fitting.datasets.clips import load_clip
from fitting.datasets.terrain.mesh_files import load_terrain
from fuzz.damage import archive_of, glb_of, parts_of_glb
from fuzz.formats import FORMATS, mesh_bytes
from fuzz.trial import OUTCOMES, try_to_load
from jaxik.world import cells
from support.sample_clips import BVH

HUGE, LARGE = 10**10, 10**8
MEMORY = 2**25  # bytes, for a file of some kilobytes
Header = dict[str, list[dict]]


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


def glb_with(change: Callable[[Header], object]) -> bytes:
    """A binary glTF whose JSON is changed, with all lengths right."""
    head, numbers = parts_of_glb(mesh_bytes("glb"))
    header = json.loads(head)
    change(header)
    return glb_of(json.dumps(header).encode(), numbers)


PARTS_OF_GLB = {"buffers": "byteLength", "bufferViews": "byteLength", "accessors": "count"}


def claim(part: str, key: str, size: int, header: Header) -> None:
    for item in header[part]:
        item[key] = size


def counts_without_bytes(header: Header) -> None:
    for accessor in header["accessors"]:
        accessor.update(count=LARGE)
        del accessor["bufferView"]


def claims() -> Iterator[tuple[str, str, bytes]]:
    """The format of each file, what it claims, and its content."""
    text, binary = mesh_bytes("ply_ascii"), mesh_bytes("ply")
    stl, glb = mesh_bytes("stl"), mesh_bytes("glb")
    off = b"OFF\n%d %d 0\n0 0 0\n1 0 0\n0 0 1\n3 0 1 2\n"
    obj = b"v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 %d\n"
    frames = "Frames: 3"
    yield "mesh, GLB", "length", glb[:8] + b"\xff" * 4 + glb[12:]
    yield "mesh, GLB", "chunk", glb[:12] + b"\xff\xff\xff\x7f" + glb[16:]
    yield "mesh, GLB", "no bytes", glb_with(counts_without_bytes)
    yield "clip, BVH", "channels", BVH.replace("LS 6", f"LS {HUGE}").encode()
    yield "clip, BVH", "digits", BVH.replace(frames, "Frames: " + "9" * 5000).encode()
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
        for part, key in PARTS_OF_GLB.items():
            yield "mesh, GLB", f"{size} in {part}", glb_with(partial(claim, part, key, size))
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


NUMBERS = np.arange(2000)


def circle(number: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(number / 300), np.sin(number / 300)], axis=-1)


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
    "a fan": np.stack([np.zeros((2000, 2)), circle(NUMBERS), circle(NUMBERS + 1)], axis=1),
}


def test_the_grid_of_a_mesh_is_as_large_as_the_mesh():
    for name, plan in PLANS.items():
        begin = time.process_time()
        lists, taken = with_peak_memory(cells.build, plan, np.ones(len(plan), bool), 1e-6)
        assert time.process_time() - begin < 10.0, name
        assert taken < 200 * plan.nbytes, name
        assert max(len(lists.members), len(lists.children)) < 100 * len(plan), name


@pytest.mark.parametrize("suffix", ["zip", "tar.gz", "bz2"])
def test_an_archive_is_no_mesh(suffix, tmp_path):
    path = tmp_path / f"hill.{suffix}"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("hill.obj", "v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n" + " " * 10**6)
    with pytest.raises(ValueError, match="wanted a heightfield .* or a mesh that trimesh reads"):
        load_terrain(path)


def test_a_gltf_reads_its_own_buffers_and_no_file_outside_its_folder(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 2, 1]], process=False)
    files = export_gltf(trimesh.Scene(mesh))
    inside = tmp_path / "inside"
    inside.mkdir()
    for name, content in files.items():
        (inside / name).write_bytes(content)
    load_terrain(inside / "model.gltf")
    buffer = min(name for name in files if name.endswith(".bin"))
    Path(inside / buffer).rename(tmp_path / buffer)
    text = (inside / "model.gltf").read_text()
    (inside / "model.gltf").write_text(text.replace(buffer, f"../{buffer}"))
    with pytest.raises(ValueError, match="model.gltf: trimesh cannot read it"):
        load_terrain(inside / "model.gltf")


def test_an_archive_without_an_array_or_with_names_that_repeat(tmp_path):
    form = FORMATS["clip, NPZ"]
    with np.load(io.BytesIO(form.whole())) as archive:
        content = dict(archive)

    def outcome(arrays: dict[str, np.ndarray]) -> str:
        (tmp_path / form.file).write_bytes(archive_of(arrays))
        return try_to_load(form.load, tmp_path / form.file, form.names)

    for name in content:
        arrays = {other: array for other, array in content.items() if other != name}
        assert outcome(arrays) in OUTCOMES, name
    for name in ("joint_names", "rig_names"):
        repeated = np.repeat(content[name][:1], len(content[name]))
        assert outcome(content | {name: repeated}) == "refused", name


def test_a_small_archive_of_large_arrays_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "clip.npz"
    path.write_bytes(FORMATS["clip, NPZ"].whole())
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.npy", bytes(2**24))
    monkeypatch.setattr(archives, "MAX_BYTES", 2**24)
    assert path.stat().st_size < 2**17
    with pytest.raises(ValueError, match="its arrays take 16[0-9]{6} bytes; wanted 16777216 at"):
        load_clip(path)
