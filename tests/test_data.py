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
from fitting.datasets import clip_frames
from fitting.datasets.clips import contacts, load_clip, save_clip
from fitting.datasets.synthetic import terrain_meshes
from fitting.datasets.terrain import mesh_files
from fitting.experiments import experiment_files, systems
from jaxik.maths import parameter_tree
from jaxik.world import terrain

DATA = Path(__file__).resolve().parents[1] / "data"
TOLERANCE = 1e-6  # m, and of quaternions, between machines
MAX_CLIP_SIZE, MAX_MESH_SIZE = 400_000, 100_000  # bytes
WALKS = ("uneven_walk", "stop_and_go", "terraces", "quadruped", "climber")
REFERENCES = (
    "uneven_walk", "stop_and_go_ozz", "stop_and_go_unreal", "stop_and_go_mec", "terraces"
)  # fmt: skip
CLIPS = (*(f"{walk}_base" for walk in WALKS), *REFERENCES)


@pytest.fixture(scope="module")
def make():
    """`data/make.py` as a module."""
    spec = importlib.util.spec_from_file_location("make", DATA / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def generated(make, tmp_path_factory):
    """A folder with all data, generated again."""
    folder = tmp_path_factory.mktemp("data")
    make.make(folder)
    return folder


@pytest.fixture(scope="module", params=REFERENCES)
def reference(make, request):
    """How one of the reference motions was made."""
    return {reference.name: reference for reference in make.REFERENCES}[request.param]


def cast_down(ground, points):
    """Hits of rays that start 2 m above points."""
    return jax.jit(terrain.cast)(ground, points + np.array([0.0, 2.0, 0.0]), 4.0)


def test_terrains_and_true_parameters_are_generated_again_to_the_byte(make, tmp_path):
    for name, mesh in make.TERRAINS.items():
        mesh_files.save_mesh(tmp_path / f"{name}.ply", *mesh())
    assert {path.name for path in tmp_path.iterdir()} == {
        x.name for x in (DATA / "terrains").iterdir()
    }
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (DATA / "terrains" / path.name).read_bytes(), path.name
    for reference in make.REFERENCES:
        shipped = DATA / "clips" / f"{reference.name}_truth.toml"
        assert make.truth_text(reference) == shipped.read_text(encoding="utf-8"), reference.name


def assert_shipped(folder: Path, name: str) -> None:
    new, shipped = (load_clip(path / f"{name}.npz") for path in (folder, DATA / "clips"))
    np.testing.assert_allclose(new.positions_ws, shipped.positions_ws, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(new.rotations_ws, shipped.rotations_ws, rtol=0, atol=TOLERANCE)
    np.testing.assert_array_equal(new.stance, shipped.stance)
    assert (new.slide is None) == (shipped.slide is None)
    if new.slide is not None and shipped.slide is not None:
        np.testing.assert_array_equal(new.slide, shipped.slide)
    assert (new.source, new.fps) == (shipped.source, shipped.fps)


@pytest.mark.parametrize("name", WALKS)
def test_a_flat_animation_is_generated_again(make, tmp_path, name):
    save_clip(tmp_path / f"{name}_base.npz", make.flat_animation(name))
    assert_shipped(tmp_path, f"{name}_base")


@pytest.mark.slow
def test_all_clips_are_generated_again(generated):
    shipped = {path.name for path in (DATA / "clips").iterdir()}
    assert shipped == {path.name for path in (generated / "clips").iterdir()}
    assert {name.removesuffix(".npz") for name in shipped if name.endswith(".npz")} == set(CLIPS)
    for name in CLIPS:
        assert_shipped(generated / "clips", name)


def test_a_clip_saved_later_has_the_same_bytes(make, tmp_path):
    clip = make.flat_animation("uneven_walk")
    save_clip(tmp_path / "now.npz", clip)
    time.sleep(2.1)  # zip archives store times in steps of 2 s
    save_clip(tmp_path / "later.npz", make.flat_animation("uneven_walk"))
    assert (tmp_path / "now.npz").read_bytes() == (tmp_path / "later.npz").read_bytes()


def test_files_are_small():
    for path in (DATA / "clips").glob("*.npz"):
        assert path.stat().st_size < MAX_CLIP_SIZE, path
    for path in (DATA / "terrains").iterdir():
        assert path.stat().st_size < MAX_MESH_SIZE, path


@pytest.mark.slow
def test_a_reference_is_the_true_motion_plus_the_stated_noise(make, reference):
    truth = tomllib.loads((DATA / "clips" / f"{reference.name}_truth.toml").read_text("utf-8"))
    noise = truth.pop("noise")
    values = {
        f"{rule}.{name}": value
        for rule, table in truth.items()
        if isinstance(table, dict)
        for name, value in table.items()
    }
    assert truth["preset"] == reference.preset and values == reference.truth
    assert truth.get("faithful", False) == reference.faithful
    base = load_clip(DATA / "clips" / f"{reference.base}_base.npz")
    noisy = load_clip(DATA / "clips" / f"{reference.name}.npz")
    ground = mesh_files.load_terrain(DATA / "terrains" / f"{reference.base}.ply")
    clean = make.reference_motion(reference, base, ground)
    error = noisy.positions_ws - clean.positions_ws
    assert np.std(error) == pytest.approx(noise["position"], rel=0.02)
    assert np.abs(np.corrcoef(error[1:].reshape(-1), error[:-1].reshape(-1))[0, 1]) < 0.03
    rotation_error = (
        Rotation.from_quat(noisy.rotations_ws.reshape(-1, 4), scalar_first=True)
        * Rotation.from_quat(clean.rotations_ws.reshape(-1, 4), scalar_first=True).inv()
    ).as_rotvec()
    assert np.std(rotation_error) == pytest.approx(noise["rotation"], rel=0.02)


def fixed(reference) -> set[str]:
    """True values that experiments do not free: switches, and a root that jumps as the original."""
    values = reference.truth.items()
    return {name for name, value in values if isinstance(value, bool) or name.startswith("root.")}


def test_true_parameters_are_within_bounds_and_away_from_the_preset(reference):
    ik = systems.preset_system(reference.preset, faithful=reference.faithful)
    declared = parameter_tree.declarations(ik)
    numbers = {
        name: value for name, value in reference.truth.items() if name not in fixed(reference)
    }
    assert len(numbers) >= 5
    for name, value in numbers.items():
        low, high = declared[name].low, declared[name].high
        assert low < value < high, name
        difference = abs(value - float(parameter_tree.get(ik, name)))
        assert difference >= 0.05 * (high - low) * (1 - 1e-6), name


def test_the_true_parameters_of_the_uneven_walk_have_thresholds_in_order(make):
    declared = parameter_tree.declarations(jaxik.presets.record())
    thresholds = [name for name in make.RECORD_TRUTH if declared[name].kind == "threshold"]
    assert len(make.RECORD_TRUTH) >= 14 and len(thresholds) >= 3
    assert make.RECORD_TRUTH["contact.planted_height"] < make.RECORD_TRUTH["contact.raised_height"]


@pytest.mark.parametrize("preset", ["ozz", "unreal", "mec", "stride"])
def test_an_experiment_frees_the_true_parameters_and_fixes_the_switches(make, preset):
    (reference,) = (each for each in make.REFERENCES if each.preset == preset)
    entries = experiment_files.load_experiment(DATA / "experiments" / f"{preset}.toml")
    assert (entries.preset, entries.faithful) == (preset, reference.faithful)
    assert set(entries.free) >= set(reference.truth) - fixed(reference)
    assert {name: reference.truth[name] for name in fixed(reference)} == entries.parameters
    assert entries.sigmas["pelvis"] == make.POSITION_NOISE


def test_the_uneven_walk_is_longer_than_ten_seconds_on_a_flat_floor_and_slides():
    base = load_clip(DATA / "clips" / "uneven_walk_base.npz")
    assert base.stance is not None and base.slide is not None
    assert base.seconds > 10.0 and base.fps == 30.0
    for leg, joints in enumerate(base.rig.joints):
        ball = base.positions_ws[base.stance[:, leg], joints[3], 1]
        np.testing.assert_allclose(ball, 0.045, rtol=0, atol=TOLERANCE)
    assert 1.5 <= base.slide.sum() / base.fps <= 2.0


def test_the_terrain_of_the_uneven_walk_is_within_reach_of_the_rays_of_both_feet():
    base = load_clip(DATA / "clips" / "uneven_walk_base.npz")
    ground = mesh_files.load_terrain(DATA / "terrains" / "uneven_walk.ply")
    for role in (2, 3):
        hit = cast_down(ground, base.joints_ws(role).reshape(-1, 3))
        assert hit.found.min() == 1.0
        assert np.abs(hit.point[:, 1]).max() < 0.36
    slope = np.degrees(np.arccos(hit.normal[:, 1]))
    assert slope.max() > 12.0 and np.mean(slope < 0.1) > 0.2


def test_stop_and_go_stands_still_at_three_uneven_places():
    base = load_clip(DATA / "clips" / "stop_and_go_base.npz")
    ground = mesh_files.load_terrain(DATA / "terrains" / "stop_and_go.ply")
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


@pytest.mark.parametrize(
    ("walk", "mesh"),
    [
        ("stop_and_go", "stop_and_go"),
        ("terraces", "terraces"),
        ("quadruped", "meadow"),
        ("climber", "wall"),
    ],
)
def test_terrain_lies_below_every_foot(walk, mesh):
    base = load_clip(DATA / "clips" / f"{walk}_base.npz")
    up = terrain_meshes.WALL_UP if mesh == "wall" else (0.0, 1.0, 0.0)
    ground = mesh_files.load_terrain(DATA / "terrains" / f"{mesh}.ply", up=up)
    for role in (2, 3):
        points = base.joints_ws(role).reshape(-1, 3) + 0.5 * np.array(up)
        hit = jax.jit(terrain.cast)(ground, points, 4.0)
        assert hit.found.min() == 1.0
        assert np.abs(np.asarray(hit.point) @ np.array(up)).max() < 0.36


def test_holds_stand_out_of_the_wall_by_two_to_six_centimetres():
    mesh = terrain_meshes.wall()
    protrusion = -mesh.vertices[:, 2]
    holds = protrusion[protrusion > 0]
    assert 0.02 <= holds.min() and holds.max() <= 0.06
    assert 0.2 < len(holds) / len(protrusion) < 0.4


@pytest.mark.parametrize(
    "name", ["slope", "steps", "rubble", "uneven_walk", "stop_and_go", "terraces", "meadow"]
)
def test_a_terrain_has_no_hole_and_faces_up(tmp_path, name):
    mesh = getattr(terrain_meshes, name)()
    mesh_files.save_mesh(tmp_path / "ground.ply", *mesh)
    ground = mesh_files.load_terrain(tmp_path / "ground.ply")
    rng = np.random.default_rng(0)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    points = rng.uniform(low, high, (2000, 3)) * [0.99, 0.0, 1.0]
    assert cast_down(ground, points).found.min() == 1.0
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    assert np.cross(b - a, c - a)[:, 1].min() > -1e-12


def test_steps_and_slope_have_their_documented_height_and_steepness(tmp_path):
    mesh_files.save_mesh(tmp_path / "steps.ply", *terrain_meshes.steps())
    ground = mesh_files.load_terrain(tmp_path / "steps.ply")
    middles = 1.0 + terrain_meshes.TREAD * (np.arange(-1, len(terrain_meshes.STEP_HEIGHTS)) + 0.5)
    points = np.stack([0 * middles, 0 * middles, middles], axis=-1)
    rises = np.diff(np.array(cast_down(ground, points).point[:, 1], np.float64))
    np.testing.assert_allclose(rises, terrain_meshes.STEP_HEIGHTS, rtol=0, atol=1e-4)
    mesh_files.save_mesh(tmp_path / "slope.ply", *terrain_meshes.slope())
    ground = mesh_files.load_terrain(tmp_path / "slope.ply")
    normal = np.asarray(cast_down(ground, np.array([[0.0, 0.0, 2.3]])).normal[0])
    assert np.degrees(np.arctan2(-normal[2], normal[1])) == pytest.approx(12.0, abs=0.1)
    assert -normal[0] / normal[1] == pytest.approx(0.1, abs=1e-3)
