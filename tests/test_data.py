"""The shipped data: it can be generated again, and it meets what the experiments rely on."""

import importlib.util
import time
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import Clip, clip_frames, contacts, load_clip, save_clip
from fitting.experiment import experiment_files, systems
from fitting.ground import meshes
from fitting.synthetic import terrain_meshes
from jaxik.maths import parameter_tree
from jaxik.world import terrain

DATA = Path(__file__).resolve().parents[1] / "data"
RAYS = 2000
TOLERANCE = 1e-6  # m, and of quaternions, between machines
MAX_SIZES = {"*.npz": 400_000, "*.ply": 100_000}  # bytes
WALKS = ("uneven_walk", "stop_and_go", "terraces", "quadruped", "climber")


@pytest.fixture(scope="module")
def make():
    """`data/make.py` as a module."""
    spec = importlib.util.spec_from_file_location("make", DATA / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def base_of(walk: str) -> Clip:
    """A flat animation as it is shipped."""
    return load_clip(DATA / "clips" / f"{walk}_base.npz")


def ground_of(name: str, up=(0.0, 1.0, 0.0)) -> terrain.Terrain:
    """A terrain as it is shipped."""
    return meshes.load_terrain(DATA / "terrains" / f"{name}.ply", up=up)


cast = jax.jit(terrain.cast)


def cast_down(ground, points, up=(0.0, 1.0, 0.0)):
    """Hits of rays that start 2 m above points; always as many, so that a terrain compiles once."""
    hits = cast(ground, np.resize(points, (RAYS, 3)) + 2.0 * np.array(up), 4.0)
    return jax.tree.map(lambda x: np.asarray(x)[: len(points)], hits)


# The files


def test_terrains_and_true_parameters_are_generated_again_to_the_byte(make, tmp_path):
    for name, mesh in make.TERRAINS.items():
        meshes.save_mesh(tmp_path / f"{name}.ply", *mesh())
    shipped = {path.name: path.read_bytes() for path in (DATA / "terrains").iterdir()}
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == shipped
    for reference in make.REFERENCES:
        text = (DATA / "clips" / f"{reference.name}_truth.toml").read_text(encoding="utf-8")
        assert make.truth_text(reference) == text, reference.name
        truth = tomllib.loads(text)
        noise = {"position": make.POSITION_NOISE, "rotation": make.ROTATION_NOISE}
        assert truth.pop("noise") == noise | {"seed": reference.seed}
        assert truth.pop("preset") == reference.preset
        assert truth.pop("faithful", False) == reference.faithful
        values = {f"{x}.{name}": value for x in truth for name, value in truth[x].items()}
        assert values == reference.truth


def assert_shipped(folder: Path, name: str) -> None:
    new, shipped = (load_clip(path / f"{name}.npz") for path in (folder, DATA / "clips"))
    np.testing.assert_allclose(new.positions_ws, shipped.positions_ws, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(new.rotations_ws, shipped.rotations_ws, rtol=0, atol=TOLERANCE)
    np.testing.assert_array_equal(new.stance, shipped.stance)
    assert (new.slide is None) == (shipped.slide is None)
    if new.slide is not None and shipped.slide is not None:
        np.testing.assert_array_equal(new.slide, shipped.slide)
    assert (new.source, new.fps) == (shipped.source, shipped.fps)


def test_flat_animations_are_generated_again(make, tmp_path):
    assert set(make.FLAT_ANIMATIONS) == set(WALKS)
    for name in WALKS:
        save_clip(tmp_path / f"{name}_base.npz", make.flat_animation(name))
        assert_shipped(tmp_path, f"{name}_base")


@pytest.mark.slow
def test_all_clips_are_generated_again(make, tmp_path):
    make.make(tmp_path)
    shipped = {path.name for path in (DATA / "clips").iterdir()}
    assert shipped == {path.name for path in (tmp_path / "clips").iterdir()}
    for name in shipped:
        if name.endswith(".npz"):
            assert_shipped(tmp_path / "clips", name.removesuffix(".npz"))


def test_references_have_independent_noise_of_the_stated_size(make):
    clean = base_of("uneven_walk")
    noisy = make.with_noise(clean, 11)
    error = noisy.positions_ws - clean.positions_ws
    assert np.std(error) == pytest.approx(make.POSITION_NOISE, rel=0.02)
    assert np.abs(np.corrcoef(error[1:].reshape(-1), error[:-1].reshape(-1))[0, 1]) < 0.03
    after, before = (
        Rotation.from_quat(clip.rotations_ws.reshape(-1, 4), scalar_first=True)
        for clip in (noisy, clean)
    )
    turns = (after * before.inv()).as_rotvec()
    assert np.std(turns) == pytest.approx(make.ROTATION_NOISE, rel=0.02)


def test_a_clip_saved_later_has_the_same_bytes(make, tmp_path):
    clip = make.flat_animation("uneven_walk")
    save_clip(tmp_path / "now.npz", clip)
    time.sleep(2.1)  # zip archives store times in steps of 2 s
    save_clip(tmp_path / "later.npz", clip)
    assert (tmp_path / "now.npz").read_bytes() == (tmp_path / "later.npz").read_bytes()


def test_files_are_small():
    for pattern, most in MAX_SIZES.items():
        sizes = {path.name: path.stat().st_size for path in DATA.rglob(pattern)}
        assert sizes and not {name: size for name, size in sizes.items() if size >= most}


# The true parameters


def fixed(reference) -> set[str]:
    """True values that experiments do not free: switches, and a root that jumps as the original."""
    values = reference.truth.items()
    return {name for name, value in values if isinstance(value, bool) or name.startswith("root.")}


def test_true_parameters_are_within_bounds_and_away_from_where_a_fit_starts(make):
    for reference in make.REFERENCES:
        ik = systems.preset_system(reference.preset, faithful=reference.faithful)
        declared = parameter_tree.declarations(ik)
        freed = reference.truth.keys() - fixed(reference)
        assert len(freed) >= 5
        file = DATA / "experiments" / f"{reference.preset}.toml"
        start = experiment_files.load_experiment(file).start if file.exists() else {}
        for name in freed:
            value = reference.truth[name]
            low, high = declared[name].low, declared[name].high
            assert low < value < high, (reference.name, name)
            difference = abs(value - start.get(name, float(parameter_tree.get(ik, name))))
            assert difference >= 0.05 * (high - low) * (1 - 1e-6), (reference.name, name)


def test_the_true_parameters_of_the_uneven_walk_have_thresholds_in_order(make):
    declared = parameter_tree.declarations(jaxik.presets.record())
    thresholds = [name for name in make.RECORD_TRUTH if declared[name].kind == "threshold"]
    assert len(make.RECORD_TRUTH) >= 14 and len(thresholds) >= 3
    assert make.RECORD_TRUTH["contact.planted_height"] < make.RECORD_TRUTH["contact.raised_height"]


def test_experiments_free_the_true_parameters_and_fix_the_switches(make):
    for reference in make.REFERENCES[1:]:  # not that of the uneven walk, which frees fewer
        entries = experiment_files.load_experiment(
            DATA / "experiments" / f"{reference.preset}.toml"
        )
        assert (entries.preset, entries.faithful) == (reference.preset, reference.faithful)
        assert set(entries.free) >= set(reference.truth) - fixed(reference)
        assert {name: reference.truth[name] for name in fixed(reference)} == entries.parameters
        assert entries.sigmas["pelvis"] == make.POSITION_NOISE


# Walks and terrains


def test_the_uneven_walk_is_longer_than_ten_seconds_on_a_flat_floor_and_slides():
    base = base_of("uneven_walk")
    assert base.stance is not None and base.slide is not None
    assert base.seconds > 10.0 and base.fps == 30.0
    for leg, joints in enumerate(base.rig.joints):
        ball = base.positions_ws[base.stance[:, leg], joints[3], 1]
        np.testing.assert_allclose(ball, 0.045, rtol=0, atol=TOLERANCE)
    assert 1.5 <= base.slide.sum() / base.fps <= 2.0


def test_stop_and_go_stands_still_at_three_uneven_places():
    base, ground = base_of("stop_and_go"), ground_of("stop_and_go")
    still = np.asarray(clip_frames.frames_from_clip(base).speed) == 0.0
    stops = contacts.runs(still)
    assert base.fps == 30.0 and len(stops) == 3
    differences, slopes = [], []
    for first, last in stops:
        assert 1.0 <= (last - first) / base.fps <= 1.5
        hit = cast_down(ground, base.joints_ws(2)[(first + last) // 2])
        assert hit.found.min() == 1.0
        differences.append(float(np.ptp(hit.point[:, 1])))
        slopes.append(float(np.degrees(np.arccos(hit.normal[:, 1].min()))))
    assert slopes[0] > 8.0 and slopes[1] < 0.1 and slopes[2] > 5.0
    assert differences[0] > 0.08 and differences[1] == pytest.approx(0.2, abs=1e-3)


def test_terrain_lies_below_every_foot_within_reach_of_its_rays():
    for walk in WALKS:
        up = terrain_meshes.WALL_UP if walk == "climber" else (0.0, 1.0, 0.0)
        ground = ground_of({"quadruped": "meadow", "climber": "wall"}.get(walk, walk), up)
        for role in (2, 3):
            hit = cast_down(ground, base_of(walk).joints_ws(role).reshape(-1, 3), up)
            assert hit.found.min() == 1.0, walk
            assert np.abs(hit.point @ np.array(up)).max() < 0.36, walk
        if walk == "uneven_walk":
            slope = np.degrees(np.arccos(hit.normal[:, 1]))
            assert slope.max() > 12.0 and np.mean(slope < 0.1) > 0.2


def test_holds_stand_out_of_the_wall_by_two_to_six_centimetres():
    mesh = terrain_meshes.wall()
    protrusion = -mesh.vertices[:, 2]
    holds = protrusion[protrusion > 0]
    assert 0.02 <= holds.min() and holds.max() <= 0.06
    assert 0.2 < len(holds) / len(protrusion) < 0.4


def test_a_terrain_has_no_hole_and_faces_up(make):
    for name in make.TERRAINS.keys() - {"wall"}:
        mesh = make.TERRAINS[name]()
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        points = np.random.default_rng(0).uniform(low, high, (RAYS, 3)) * [0.99, 0.0, 1.0]
        assert cast_down(ground_of(name), points).found.min() == 1.0, name
        a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
        assert np.cross(b - a, c - a)[:, 1].min() > -1e-12, name


def test_steps_and_slope_have_their_documented_height_and_steepness():
    middles = 1.0 + terrain_meshes.TREAD * (np.arange(-1, len(terrain_meshes.STEP_HEIGHTS)) + 0.5)
    points = np.stack([0 * middles, 0 * middles, middles], axis=-1)
    rises = np.diff(cast_down(ground_of("steps"), points).point[:, 1])
    np.testing.assert_allclose(rises, terrain_meshes.STEP_HEIGHTS, rtol=0, atol=1e-4)
    (normal,) = cast_down(ground_of("slope"), np.array([[0.0, 0.0, 2.3]])).normal
    assert np.degrees(np.arctan2(-normal[2], normal[1])) == pytest.approx(12.0, abs=0.1)
    assert -normal[0] / normal[1] == pytest.approx(0.1, abs=1e-3)
