"""All formats of files that users hand over: a small whole file of each, its loader, its damage."""

import io
import json
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from fitting.clips import load_clip, save_clip
from fitting.clips.clip import Clip
from fitting.clips.edit import mask_marker_jumps
from fitting.clips.joint_maps import template
from fitting.clips.stances import Stance, stances_of, to_toml, with_stances
from fitting.experiment import originals, parameter_files, record_files, track_files
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import load_known_values
from fitting.ground.meshes import load_terrain
from fitting.runtime.validation import error_context
from fitting.studies import translation
from fitting.studies.fit import run_folder
from jaxik import presets, record
from support import experiments
from support.c3d_files import MEASURES, plug_in_gait, write_c3d
from support.gltf_files import walker
from support.records import packed
from support.sample_clips import AMC, ASF, BVH, stair_walk

from . import soundness, stored_files
from .damage import (
    Random,
    archive_of,
    damage_arrays,
    damage_bytes,
    damage_glb,
    damage_json,
    damage_text,
    damage_toml,
)

DATA = experiments.ROOT / "data"
TRUTH = DATA / "clips" / "uneven_walk_truth.toml"
TRACKS = """
[grounded]
times = [0.0, 0.2, 0.4]
values = [1, 1, 0]
[weight.left]
times = [0.0, 0.3]
values = [1, 0.5]
stepped = true
[foot.max_pitch]
times = [0.0]
values = [[0.5, 0.4]]
"""
FREE = """
[free]
lean.half_life = {}
target.foot_height = { low = 0.0, high = 0.2 }
"foot.max_pitch" = { low = 0.1, kind = "smooth", scale = "log" }
"""
TABLES = """
[prior]
spread = 1.6
[prior.foot]
max_pitch = { centre = 0.3, spread = 1.0 }
[start]
foot.max_pitch = 0.5
[sigmas]
ankle = 0.02
correlation = { pelvis = 0.9, ankle = 0.8 }
[noise]
sigmas = "estimated"
[hierarchy]
scale_with_body = true
[fit]
starts = 6
max_steps = 1000
[fit.search]
population = 64
agreement = 3.0
[sample]
walkers = 64
thin_by = 1
stop_at = 50.0
[[without]]
name = "locks"
parameters = { lock.enabled = false }
free = { pelvis.limit = {} }
"""
FITTED = {"name": "lean.half_life", "unit": "1", "u": 0.5, "start_sd": 0.1, "value": 0.2}
RUN = {"parameters": [FITTED | {"determined": True}]}


def system_as(kind: str) -> bytes:
    write = {"toml": parameter_files.system_to_toml, "json": parameter_files.system_to_json}
    return write[kind](presets.record()).encode()


def load_system(path: Path) -> None:
    soundness.check_system(parameter_files.load_system(path)[0])


def load_settings(path: Path) -> None:
    soundness.check_system(originals.load_settings(path)[0])


def load_truth(path: Path) -> None:
    experiment = experiments.write(path.parent, clip=f'truth = "{path}"\n')
    load_known_values(load_experiment(experiment))


def settings_of_mec(suffix: str = ".toml") -> bytes:
    values = originals.to_settings(presets.mec(faithful=True), "mec")
    return originals.settings_text(values, "mec", suffix).encode()


@dataclass(frozen=True)
class Format:
    """A kind of file."""

    file: str
    """The name of the damaged file."""
    whole: Callable[[], bytes]
    load: Callable[[Path], object]
    """Reads the file and checks what it read."""
    damage: Callable[[Random, bytes], bytes] = damage_text
    beside: Mapping[str, Callable[[], bytes]] = field(default_factory=dict)
    """The other files that it needs, whole."""

    @property
    def names(self) -> tuple[str, ...]:
        """Those of which a message must contain one."""
        return (self.file, *self.beside)


def short_walk() -> Clip:
    """A third of a second with all tracks, in which a stance is by hand and left out."""
    clip = mask_marker_jumps(stair_walk()).select(slice(0, 20))
    stances = stances_of(clip)
    return with_stances(clip, {**stances, "left": (Stance(0.1, 0.2, left_out=True),)})


@cache
def clip_bytes(suffix: str) -> bytes:
    """A clip as we write it, with all tracks that the format has."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"clip{suffix}"
        save_clip(path, short_walk())
        return path.read_bytes()


@cache
def capture_bytes() -> bytes:
    """A file of markers, of which one is not seen in a frame."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.c3d"
        places = plug_in_gait(stair_walk().select(slice(0, 12)))
        places["LTHI"][4] = np.nan
        return write_c3d(path, places, measures=MEASURES, channels=2).read_bytes()


def points_as(kind: str) -> bytes:
    """The places of joints, as an array of as many as SMPL has, or as an archive with names."""
    clip, file = stair_walk().select(slice(0, 12)), io.BytesIO()
    if kind == "npz":
        arrays = {"positions": clip.positions_ws, "names": np.array(clip.joint_names)}
        return archive_of(arrays | {"fps": np.array(30.0)})
    np.save(file, np.resize(clip.positions_ws, (12, 22, 3)))
    return file.getvalue()


def trc_bytes() -> bytes:
    """The places of joints as markers, of which one is not seen in a frame."""
    clip = stair_walk().select(slice(0, 12))
    names = clip.joint_names
    lines = ["PathFileType\t4\t(X/Y/Z)\twalk.trc", "DataRate\tUnits", "30\tm"]
    lines += ["Frame#\tTime\t" + "\t\t\t".join(names), ""]
    for number, row in enumerate(clip.positions_ws.reshape(12, -1)):
        cells = [f"{value:.4f}" for value in row]
        cells[:3] = [""] * 3 if number == 4 else cells[:3]
        lines.append("\t".join([str(number), f"{number / 30:.3f}", *cells]))
    return "\n".join([*lines, ""]).encode()


def blocks_archive() -> bytes:
    """Joint positions of a character that stands."""
    frames, upright = 12, [1.0, 0.0, 0.0, 0.0]
    arrays: dict[str, np.ndarray] = {"fps": np.array(30.0), "stance": np.ones((frames, 2), int)}
    arrays |= {"pelvis_rot": np.tile(upright, (frames, 1))}
    arrays |= {"foot_rot": np.tile(upright, (frames, 2, 1))}
    places = {"hip": (0.9, 0.0), "knee": (0.5, 0.03), "ankle": (0.1, 0.0), "ball": (0.05, 0.12)}
    for prefix in ("", "base_"):
        arrays[f"{prefix}pelvis"] = np.tile([0.0, 1.0, 0.0], (frames, 1))
        for joint, place in places.items():
            arrays[prefix + joint] = np.tile([[0.1, *place], [-0.1, *place]], (frames, 1, 1))
    return archive_of(arrays)


def heightfield_archive() -> bytes:
    """A heightfield of four rows and five columns with a hole."""
    heights = np.arange(20.0).reshape(4, 5) / 50
    heights[0, 0] = np.nan
    arrays = {"heights": heights, "spacing": np.array([0.5, 0.4]), "origin": np.zeros(3)}
    return archive_of(arrays | {"interpolation": np.array("triangulated")})


def heights_as(kind: str) -> bytes:
    """Heights as an array of four rows and five columns, or as a picture of 16 bits."""
    file = io.BytesIO()
    if kind == "npy":
        np.save(file, np.arange(20.0).reshape(4, 5) / 50)
    else:
        levels = np.arange(192, dtype=np.uint16).reshape(16, 12) * 300
        Image.fromarray(levels).save(file, format="PNG")
    return file.getvalue()


def load_ground(path: Path, **options: Any) -> None:
    soundness.check_terrain(load_terrain(path, **options))


load_heights = partial(load_ground, cell=0.5, scale=0.001)  # which the file does not say


def joint_map() -> bytes:
    """The map that the template of a clip is."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.bvh"
        path.write_text(BVH)
        clip = load_clip(path)
    return template(clip.joint_names, clip.parents, clip.source).encode()


def mesh_bytes(kind: str, **options: str) -> bytes:
    """A hill of 18 triangles as trimesh writes it."""
    x, z = (part.ravel() for part in np.meshgrid(np.arange(4.0), np.arange(4.0)))
    corner = (np.arange(3)[:, None] * 4 + np.arange(3)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 4, 5], corner[:, None] + [0, 5, 1]])
    hill = trimesh.Trimesh(np.stack([x, 0.1 * x * z, z], -1), faces, process=False)
    content: Any = hill.export(file_type=kind, **options)
    return content.encode() if isinstance(content, str) else content


def load_record(path: Path) -> None:
    """Reads and shows a record, as `jaxik record show`, with its remarks on doubtful units."""
    reading = record.Reading()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for entry in record_files.read(path, reading, None, drop=True):
            with error_context(path):
                record_files.describe(entry, reading)
                soundness.check_system(record.to_ik(entry, reading))


@cache
def flat_clip() -> Clip:
    """A second over flat ground."""
    return load_clip(DATA / "clips" / "uneven_walk_base.npz").select(slice(0, 30))


def clip_format(name: str, whole: Callable[[], bytes], **options) -> Format:
    return Format(name, whole, lambda path: soundness.check_clip(load_clip(path)), **options)


def mesh_format(kind: str, damage: Callable[[Random, bytes], bytes], **options: str) -> Format:
    whole = partial(mesh_bytes, kind, **options)
    return Format(f"hill.{kind.removesuffix('_ascii')}", whole, load_ground, damage)


FORMATS: dict[str, Format] = {
    "clip, BVH": clip_format("walk.bvh", BVH.encode),
    "clip, AMC": clip_format("walk.amc", AMC.encode, beside={"walk.asf": ASF.encode}),
    "clip, ASF": Format(
        "walk.asf",
        ASF.encode,
        lambda path: soundness.check_clip(load_clip(path.with_suffix(".amc"))),
        beside={"walk.amc": AMC.encode},
    ),
    "clip, GLB": clip_format("walk.glb", lambda: clip_bytes(".glb"), damage=damage_glb),
    "clip, glTF": clip_format("walk.gltf", lambda: walker().text().encode(), damage=damage_json),
    "clip, C3D": clip_format("walk.c3d", capture_bytes, damage=damage_bytes),
    "clip, CSV": clip_format("walk.csv", lambda: clip_bytes(".csv")),
    "clip, TRC": clip_format("walk.trc", trc_bytes),
    "clip, NPY": clip_format("walk.npy", partial(points_as, "npy"), damage=damage_bytes),
    "clip, points": clip_format("points.npz", partial(points_as, "npz"), damage=damage_arrays),
    "clip, NPZ": clip_format("walk.npz", lambda: clip_bytes(".npz"), damage=damage_arrays),
    "clip, blocks": clip_format("blocks.npz", blocks_archive, damage=damage_arrays),
    "heightfield": Format("hill.npz", heightfield_archive, load_ground, damage_arrays),
    "heights, NPY": Format("hill.npy", partial(heights_as, "npy"), load_heights, damage_bytes),
    "heights, PNG": Format("hill.png", partial(heights_as, "png"), load_heights, damage_bytes),
    "joint map": Format(
        "map.toml",
        joint_map,
        lambda path: soundness.check_clip(load_clip(path.with_name("walk.bvh"), joints=path)),
        damage_toml,
        beside={"walk.bvh": BVH.encode},
    ),
    "contacts": Format(
        "walk.contacts.toml",
        lambda: to_toml(short_walk()).encode(),
        lambda path: soundness.check_clip(load_clip(path.with_name("walk.npz"))),
        damage_toml,
        beside={"walk.npz": partial(clip_bytes, ".npz")},
    ),
    "mesh, PLY text": mesh_format("ply", damage_text, encoding="ascii"),
    "mesh, PLY": mesh_format("ply", damage_bytes),
    "mesh, OBJ": mesh_format("obj", damage_text),
    "mesh, STL text": mesh_format("stl_ascii", damage_text),
    "mesh, STL": mesh_format("stl", damage_bytes),
    "mesh, OFF": mesh_format("off", damage_text),
    "mesh, GLB": mesh_format("glb", damage_glb),
    "experiment": Format(
        "walk.toml",
        lambda: experiments.text('loss = "squares"', rest=TABLES).encode(),
        lambda path: soundness.check_experiment(load_experiment(path)),
        damage_toml,
    ),
    "parameters": Format("footik.toml", partial(system_as, "toml"), load_system, damage_toml),
    "parameters, JSON": Format("footik.json", partial(system_as, "json"), load_system, damage_json),
    "settings": Format("mec.toml", settings_of_mec, load_settings, damage_toml),
    "settings, CSV": Format("mec.csv", partial(settings_of_mec, ".csv"), load_settings),
    "truth": Format("truth.toml", TRUTH.read_bytes, load_truth, damage_toml),
    "free parameters": Format(
        "free.toml",
        FREE.encode,
        lambda path: translation.read_free(str(path), presets.record()),
        damage_toml,
    ),
    "tracks": Format(
        "tracks.toml",
        TRACKS.encode,
        lambda path: soundness.check_tracks(*track_files.along(flat_clip(), path)),
        damage_toml,
    ),
    "record": Format("footik.bin", lambda: record.to_bytes(packed()), load_record, damage_bytes),
    "record, CSV": Format("footik.csv", lambda: record.to_csv([packed()]).encode(), load_record),
    "numbers of a fit": Format(
        "run/fit.json",
        lambda: json.dumps(RUN, indent=2).encode(),
        lambda path: run_folder.load_fit(path.parent),
        damage_json,
        beside={
            "run/experiment.toml": lambda: experiments.text().encode(),
            "run/parameters.toml": lambda: b"",
        },
    ),
    "state of a fit": Format(
        "search.json", lambda: stored_files.solved()[2], stored_files.load_search, damage_json
    ),
    "search of a population": Format(
        "searches/0123abcd.json", stored_files.found_text, stored_files.load_found, damage_json
    ),
    "rows of an ablation": Format(
        "contribution.json", stored_files.rows_text, stored_files.load_rows, damage_json
    ),
    **{
        f"{name} of a calibration": Format(
            f"{name}/0000.json",
            lambda content=content: stored_files.text_of(content),
            stored_files.load_replicate,
            damage_json,
        )
        for name, content in stored_files.REPLICATES.items()
    },
}
