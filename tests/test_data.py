"""The project's own data: it comes out of its seeds again, and holds what the experiments need."""

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
SAME = 1e-6  # m, and of quaternions, on another machine
LARGEST_CLIP, LARGEST_MESH = 400_000, 100_000  # bytes
WALKS = ("uneven_walk", "stop_and_go", "quadruped", "climber")
REFERENCES = ("uneven_walk", "stop_and_go_ozz", "stop_and_go_unreal", "stop_and_go_mec")
CLIPS = (*(f"{walk}_base" for walk in WALKS), *REFERENCES)


@pytest.fixture(scope="module")
def make():
    """The script that makes the data."""
    spec = importlib.util.spec_from_file_location("make", DATA / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def made(make, tmp_path_factory):
    """Everything, made again."""
    folder = tmp_path_factory.mktemp("data")
    make.make(folder)
    return folder


@pytest.fixture(scope="module", params=REFERENCES)
def one(make, request):
    """What made one of the references."""
    return {each.name: each for each in make.MADE}[request.param]


def under(ground, points):
    """Hits of rays that start 2 m over points."""
    return jax.jit(terrain.cast)(ground, points + np.array([0.0, 2.0, 0.0]), 4.0)


@pytest.mark.slow
def test_terrains_and_truth_come_out_again_to_the_byte(made):
    names = {f"terrains/{path.name}" for path in (DATA / "terrains").iterdir()}
    assert names == {f"terrains/{path.name}" for path in (made / "terrains").iterdir()}
    for name in (*names, *(f"clips/{reference}_truth.toml" for reference in REFERENCES)):
        assert (made / name).read_bytes() == (DATA / name).read_bytes(), name


@pytest.mark.slow
def test_every_clip_is_one_that_is_made(made):
    kept = {path.name for path in (DATA / "clips").iterdir()}
    assert kept == {path.name for path in (made / "clips").iterdir()}
    assert {name.removesuffix(".npz") for name in kept if name.endswith(".npz")} == set(CLIPS)


@pytest.mark.slow
@pytest.mark.parametrize("name", CLIPS)
def test_clips_come_out_again(made, name):
    ours, theirs = (load_clip(folder / "clips" / f"{name}.npz") for folder in (made, DATA))
    np.testing.assert_allclose(ours.positions_ws, theirs.positions_ws, rtol=0, atol=SAME)
    np.testing.assert_allclose(ours.rotations_ws, theirs.rotations_ws, rtol=0, atol=SAME)
    np.testing.assert_array_equal(ours.stance, theirs.stance)
    assert (ours.slide is None) == (theirs.slide is None)
    if ours.slide is not None and theirs.slide is not None:
        np.testing.assert_array_equal(ours.slide, theirs.slide)
    assert (ours.source, ours.fps) == (theirs.source, theirs.fps)


def test_a_clip_saved_later_has_the_same_bytes(make, tmp_path):
    clip = make.base("uneven_walk")
    save_clip(tmp_path / "now.npz", clip)
    time.sleep(2.1)  # zip archives keep time in steps of 2 s
    save_clip(tmp_path / "later.npz", make.base("uneven_walk"))
    assert (tmp_path / "now.npz").read_bytes() == (tmp_path / "later.npz").read_bytes()


def test_files_are_small():
    for path in (DATA / "clips").glob("*.npz"):
        assert path.stat().st_size < LARGEST_CLIP, path
    for path in (DATA / "terrains").iterdir():
        assert path.stat().st_size < LARGEST_MESH, path


def test_a_reference_differs_from_the_truth_by_the_noise_that_the_file_tells(make, one):
    truth = tomllib.loads((DATA / "clips" / f"{one.name}_truth.toml").read_text("utf-8"))
    noise = truth.pop("noise")
    values = {
        f"{room}.{name}": value
        for room, own in truth.items()
        if isinstance(own, dict)
        for name, value in own.items()
    }
    assert truth["preset"] == one.preset and values == one.truth
    base = load_clip(DATA / "clips" / f"{one.base}_base.npz")
    seen = load_clip(DATA / "clips" / f"{one.name}.npz")
    clean = make.reference(
        one, base, mesh_files.load_terrain(DATA / "terrains" / f"{one.base}.ply")
    )
    error = seen.positions_ws - clean.positions_ws
    assert np.std(error) == pytest.approx(noise["position"], rel=0.02)
    assert np.abs(np.corrcoef(error[1:].reshape(-1), error[:-1].reshape(-1))[0, 1]) < 0.03
    turns = (
        Rotation.from_quat(seen.rotations_ws.reshape(-1, 4), scalar_first=True)
        * Rotation.from_quat(clean.rotations_ws.reshape(-1, 4), scalar_first=True).inv()
    ).as_rotvec()
    assert np.std(turns) == pytest.approx(noise["rotation"], rel=0.02)


def test_a_truth_is_within_bounds_and_far_from_its_preset(one):
    ik = systems.preset_system(one.preset)
    declared = parameter_tree.declarations(ik)
    numbers = {name: value for name, value in one.truth.items() if not isinstance(value, bool)}
    assert len(numbers) >= 5
    for name, value in numbers.items():
        low, high = declared[name].low, declared[name].high
        assert low < value < high, name
        assert abs(value - float(parameter_tree.get(ik, name))) >= 0.05 * (high - low) * (
            1 - 1e-6
        ), name


def test_the_truth_of_the_uneven_walk_has_thresholds_in_order(make):
    declared = parameter_tree.declarations(jaxik.presets.record())
    thresholds = [name for name in make.RECORD if declared[name].kind == "threshold"]
    assert len(make.RECORD) >= 14 and len(thresholds) >= 3
    assert make.RECORD["contact.planted_height"] < make.RECORD["contact.raised_height"]


@pytest.mark.parametrize("preset", ["ozz", "unreal", "mec"])
def test_an_experiment_frees_what_the_truth_holds_and_fixes_its_switches(make, preset):
    (one,) = (each for each in make.MADE if each.preset == preset)
    asked = experiment_files.load_experiment(DATA / "experiments" / f"{preset}.toml")
    assert asked.preset == preset
    switches = {name for name, value in one.truth.items() if isinstance(value, bool)}
    assert set(asked.free) >= set(one.truth) - switches
    assert {name: one.truth[name] for name in switches} == asked.parameters
    assert asked.sigmas["pelvis"] == make.POSITION_NOISE


def test_the_base_is_ten_seconds_or_more_on_a_flat_floor_and_slides():
    base = load_clip(DATA / "clips" / "uneven_walk_base.npz")
    assert base.stance is not None and base.slide is not None
    assert base.seconds > 10.0 and base.fps == 30.0
    for leg, joints in enumerate(base.rig.joints):
        ball = base.positions_ws[base.stance[:, leg], joints[3], 1]
        np.testing.assert_allclose(ball, 0.045, rtol=0, atol=SAME)
    assert 1.5 <= base.slide.sum() / base.fps <= 2.0


def test_the_course_is_under_every_foot_within_reach_of_the_rays():
    base = load_clip(DATA / "clips" / "uneven_walk_base.npz")
    ground = mesh_files.load_terrain(DATA / "terrains" / "uneven_walk.ply")
    for role in (2, 3):
        hit = under(ground, base.joints_ws(role).reshape(-1, 3))
        assert hit.found.min() == 1.0
        assert np.abs(hit.point[:, 1]).max() < 0.36
    slope = np.degrees(np.arccos(hit.normal[:, 1]))
    assert slope.max() > 12.0 and np.mean(slope < 0.1) > 0.2


def test_the_walk_that_stops_stands_still_on_three_uneven_places():
    base = load_clip(DATA / "clips" / "stop_and_go_base.npz")
    ground = mesh_files.load_terrain(DATA / "terrains" / "stop_and_go.ply")
    still = np.asarray(clip_frames.frames_from_clip(base).speed) == 0.0
    stands = contacts.runs(still)
    assert base.fps == 30.0 and len(stands) == 3
    apart, slopes = [], []
    for first, last in stands:
        assert 1.0 <= (last - first) / base.fps <= 1.5
        hit = under(ground, base.joints_ws(2)[(first + last) // 2])
        assert hit.found.min() == 1.0
        apart.append(float(np.ptp(hit.point[:, 1])))
        slopes.append(float(np.degrees(np.arccos(hit.normal[:, 1].min()))))
    assert slopes[0] > 8.0 and slopes[1] < 0.1 and slopes[2] > 5.0
    assert apart[0] > 0.08 and apart[1] == pytest.approx(0.2, abs=1e-3)


@pytest.mark.parametrize(
    ("walk", "mesh"),
    [("stop_and_go", "stop_and_go"), ("quadruped", "meadow"), ("climber", "wall")],
)
def test_terrain_is_under_every_foot(walk, mesh):
    base = load_clip(DATA / "clips" / f"{walk}_base.npz")
    up = terrain_meshes.WALL_UP if mesh == "wall" else (0.0, 1.0, 0.0)
    ground = mesh_files.load_terrain(DATA / "terrains" / f"{mesh}.ply", up=up)
    for role in (2, 3):
        points = base.joints_ws(role).reshape(-1, 3) + 0.5 * np.array(up)
        hit = jax.jit(terrain.cast)(ground, points, 4.0)
        assert hit.found.min() == 1.0
        assert np.abs(np.asarray(hit.point) @ np.array(up)).max() < 0.36


def test_the_wall_has_holds_of_two_to_six_centimetres():
    mesh = terrain_meshes.wall()
    proud = -mesh.vertices[:, 2]
    holds = proud[proud > 0]
    assert 0.02 <= holds.min() and holds.max() <= 0.06
    assert 0.2 < len(holds) / len(proud) < 0.4


@pytest.mark.parametrize(
    "name", ["slope", "steps", "rubble", "uneven_walk", "stop_and_go", "meadow"]
)
def test_a_course_has_no_hole_and_faces_up(tmp_path, name):
    mesh = getattr(terrain_meshes, name)()
    mesh_files.save_mesh(tmp_path / "ground.ply", *mesh)
    ground = mesh_files.load_terrain(tmp_path / "ground.ply")
    rng = np.random.default_rng(0)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    points = rng.uniform(low, high, (2000, 3)) * [0.99, 0.0, 1.0]
    assert under(ground, points).found.min() == 1.0
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    assert np.cross(b - a, c - a)[:, 1].min() > -1e-12


def test_steps_are_as_high_as_they_say_and_the_slope_as_steep(tmp_path):
    mesh_files.save_mesh(tmp_path / "steps.ply", *terrain_meshes.steps())
    ground = mesh_files.load_terrain(tmp_path / "steps.ply")
    middles = 1.0 + terrain_meshes.TREAD * (np.arange(-1, len(terrain_meshes.STEP_HEIGHTS)) + 0.5)
    points = np.stack([0 * middles, 0 * middles, middles], axis=-1)
    rises = np.diff(np.array(under(ground, points).point[:, 1], np.float64))
    np.testing.assert_allclose(rises, terrain_meshes.STEP_HEIGHTS, rtol=0, atol=1e-4)
    mesh_files.save_mesh(tmp_path / "slope.ply", *terrain_meshes.slope())
    ground = mesh_files.load_terrain(tmp_path / "slope.ply")
    normal = np.asarray(under(ground, np.array([[0.0, 0.0, 2.3]])).normal[0])
    assert np.degrees(np.arctan2(-normal[2], normal[1])) == pytest.approx(12.0, abs=0.1)
    assert -normal[0] / normal[1] == pytest.approx(0.1, abs=1e-3)
