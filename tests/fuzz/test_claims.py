"""Headers that claim more than their file has, and terrain that would be larger than its file."""

import io
import json
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.exchange.gltf import export_gltf

from fitting.datasets.terrain.mesh_files import load_terrain
from fuzz.damage import archive_of
from fuzz.formats import FORMATS, Format, mesh_bytes
from fuzz.trial import OUTCOMES, try_to_load
from jaxik.world import cells
from support.sample_clips import BVH

HUGE, LARGE = 10**10, 10**8
MEMORY = 2**25  # bytes, for a file of some kilobytes
Header = dict[str, list[dict]]


def peak_memory(work: Callable[[], object]) -> int:
    """Bytes that NumPy and Python take at most while something is done."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
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
    whole = mesh_bytes("glb")
    length = int.from_bytes(whole[12:16], "little")
    header = json.loads(whole[20 : 20 + length])
    change(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I", len(text)) + b"JSON" + text + whole[20 + length :]
    return whole[:8] + struct.pack("<I", 12 + len(chunks)) + chunks


def counts_without_bytes(header: Header) -> None:
    for accessor in header["accessors"]:
        accessor.update(count=LARGE)
        del accessor["bufferView"]


def claims() -> dict[str, tuple[str, bytes]]:
    """The format and the content of each file."""
    text, binary = mesh_bytes("ply_ascii"), mesh_bytes("ply")
    stl, glb = mesh_bytes("stl"), mesh_bytes("glb")
    off = b"OFF\n%d %d 0\n0 0 0\n1 0 0\n0 0 1\n3 0 1 2\n"
    obj = b"v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 %d\n"
    files: dict[str, tuple[str, bytes]] = {
        "GLB, length": ("mesh, GLB", glb[:8] + b"\xff" * 4 + glb[12:]),
        "GLB, chunk": ("mesh, GLB", glb[:12] + b"\xff\xff\xff\x7f" + glb[16:]),
        "GLB, no bytes": ("mesh, GLB", glb_with(counts_without_bytes)),
        "BVH, channels": ("clip, BVH", BVH.replace("LS 6", f"LS {HUGE}").encode()),
        "BVH, digits": ("clip, BVH", BVH.replace("Frames: 3", "Frames: " + "9" * 5000).encode()),
    }
    for size in (HUGE, LARGE):
        vertices, faces = b"element vertex %d" % size, b"element face %d" % size
        frames = BVH.replace("Frames: 3", f"Frames: {size}").encode()
        of_buffers = glb_with(lambda h, n=size: [b.update(byteLength=n) for b in h["buffers"]])
        of_views = glb_with(lambda h, n=size: [v.update(byteLength=n) for v in h["bufferViews"]])
        of_accessors = glb_with(lambda h, n=size: [a.update(count=n) for a in h["accessors"]])
        half = round(size**0.5)
        files |= {
            f"PLY, {size} vertices": ("mesh, PLY", binary.replace(b"element vertex 16", vertices)),
            f"PLY, {size} faces": ("mesh, PLY", binary.replace(b"element face 18", faces)),
            f"PLY text, {size} vertices": (
                "mesh, PLY text",
                text.replace(b"element vertex 16", vertices),
            ),
            f"PLY text, {size} faces": ("mesh, PLY text", text.replace(b"element face 18", faces)),
            f"STL, {size}": ("mesh, STL", stl[:80] + struct.pack("<I", size % 2**32) + stl[84:]),
            f"OFF, {size}": ("mesh, OFF", off % (size, size)),
            f"OBJ, {size}": ("mesh, OBJ", obj % size),
            f"OBJ, -{size}": ("mesh, OBJ", obj % -size),
            f"GLB, {size} in buffers": ("mesh, GLB", of_buffers),
            f"GLB, {size} in views": ("mesh, GLB", of_views),
            f"GLB, {size} in accessors": ("mesh, GLB", of_accessors),
            f"heightfield, {size}": ("heightfield", archive_with_claim("heights", (half, half))),
            f"clip, {size}": ("clip, NPZ", archive_with_claim("positions_ws", (size, 10, 3))),
            f"BVH, {size} frames": ("clip, BVH", frames),
        }
    return files


CLAIMS = claims()


@pytest.mark.parametrize("name", CLAIMS)
def test_a_claim_is_not_believed(name, tmp_path):
    key, content = CLAIMS[name]
    form: Format = FORMATS[key]
    path, outcomes = tmp_path / form.file, []
    path.write_bytes(form.whole())
    form.load(path)  # compiles, which takes memory, too
    path.write_bytes(content)
    taken = peak_memory(lambda: outcomes.append(try_to_load(form.load, path, form.names)))
    assert taken < MEMORY and outcomes[0] in OUTCOMES


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
    "a fan": np.stack(
        [
            np.zeros((2000, 2)),
            *(
                np.stack([np.cos(turn), np.sin(turn)], axis=-1)
                for turn in (np.arange(2000) / 300, (np.arange(2000) + 1) / 300)
            ),
        ],
        axis=1,
    ),
}


@pytest.mark.parametrize("name", PLANS)
def test_the_grid_of_a_mesh_is_as_large_as_the_mesh(name):
    plan, lists, begin = PLANS[name], [], time.process_time()
    listed = np.ones(len(plan), bool)
    taken = peak_memory(lambda: lists.append(cells.build(plan, listed, 1e-6)))
    assert time.process_time() - begin < 10.0
    assert taken < 200 * plan.nbytes
    assert len(lists[0].members) < 100 * len(plan) and len(lists[0].children) < 100 * len(plan)


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


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"spacing": 1e-9}, "wanted 1e-06 m or more"),
        ({"spacing": 1e300}, "at most 1e.07 m from end to end"),
        ({"spacing": np.array([1.0, 1e9])}, "at most 1e.07 m from end to end"),
        ({"origin": np.array([0.0, 1e300, 0.0])}, "origin is three numbers of at most 1e.07 m"),
        ({"origin": np.array([0.0, np.nan, 0.0])}, "origin is three numbers of at most 1e.07 m"),
        ({"heights": np.full((3, 2), 1e300)}, r"heights\[0, 0\]: 1e.300; wanted at most 1e.07 m"),
    ],
)
def test_a_heightfield_of_impossible_size_is_refused(arrays, message, tmp_path):
    path = tmp_path / "hill.npz"
    np.savez(path, **({"heights": np.zeros((3, 2)), "spacing": 1.0} | arrays))
    with pytest.raises(ValueError, match=f"hill.npz: .*{message}"):
        load_terrain(path)
