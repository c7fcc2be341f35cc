"""Terrain reconstructed from a clip: stances, grids, surfaces, their choice, and the command."""

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from fitting.cli import main
from fitting.datasets import clips
from fitting.datasets.clips import contacts, edit
from fitting.datasets.ground_path import heights_under
from fitting.datasets.synthetic import gait
from fitting.datasets.terrain import block_grids, mesh_files, reconstruction, surfaces
from fitting.datasets.terrain.block_grids import Footprints, Grid
from fitting.datasets.terrain.reconstruction import Prediction
from fitting.report import terrain_report
from fitting.report.plots import style
from jaxik.world.surfaces import Mesh
from support.experiments import ROOT
from support.footprints import TILTED, WIDE, block_footprints, block_heights, hill_footprints
from support.sample_clips import flat_floor, stair_walk

UNEVEN = ROOT / "data" / "clips" / "uneven_walk.npz"


def slope(points: np.ndarray) -> np.ndarray:
    """Ground height, m, that falls by 10 cm per metre of z."""
    return 0.3 - 0.1 * points[:, 2]


# Stances


def test_stances_are_at_the_balls_with_the_ground_a_sole_below_even_if_a_marker_pops():
    clip = stair_walk(slope)
    stances = reconstruction.find_stances(clip, sole=0.02)
    assert len(stances.leg) == 6 or len(stances.leg) == 7
    assert (np.diff(stances.first) >= 0).all() and stances.used.all()
    points_ws = np.insert(stances.points, 1, 0.0, axis=1)
    np.testing.assert_allclose(stances.heights, slope(points_ws) - 0.02, atol=0.002)
    ((first, last), *_) = contacts.runs(clip.stance_labels()[:, 0])
    positions = clip.positions_ws.copy()  # in which a marker pops
    positions[first + 2 : last - 2 : 3, clip.rig.joints[0][3]] += [0.0, 0.2, 0.0]
    popped = clip.with_motion(positions, clip.rotations_ws)
    heights = reconstruction.find_stances(popped, sole=0.02).heights
    np.testing.assert_allclose(heights, stances.heights, atol=0.002)


def test_surfaces_are_fitted_to_a_bounded_number_of_stances_evenly_chosen(
    monkeypatch, coarse_search
):
    monkeypatch.setattr(reconstruction, "MOST_STANCES", 5)
    terrain = reconstruction.reconstruct(stair_walk(slope, strides=6))
    count = len(terrain.stances.used)
    (used,) = np.nonzero(terrain.stances.used)
    assert count > 8 and len(used) == 5 and used[0] == 0 and used[-1] == count - 1
    assert np.ptp(np.diff(used)) <= 1
    assert len(terrain.predictions["plane"].errors) == 5
    text = terrain_report.count_stances(terrain)
    assert text == f"{count} stances; surfaces are fitted to 5 of all, evenly chosen"


def test_the_memory_for_stances_grows_with_their_number_and_not_its_square():
    clip = edit.resample(stair_walk(slope, strides=6), 15.0)
    repeats = 250
    motion = (np.concatenate([part] * repeats) for part in (clip.positions_ws, clip.rotations_ws))
    long = replace(clip.with_motion(*motion), stance=np.tile(clip.stance_labels(), (repeats, 1)))
    tracemalloc.start()
    stances = reconstruction.find_stances(long)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(stances.leg) > 3000 and peak < 10 * long.positions_ws.nbytes


def with_toe_stance(heel: float, leg: int = 0) -> clips.Clip:
    """A walk on a floor whose third stance of a foot is on its toes, 5 cm above the floor."""
    clip = stair_walk(flat_floor, strides=6)
    first, last = contacts.runs(clip.stance_labels()[:, leg])[2]
    positions = clip.positions_ws.copy()
    _, _, ankle, toe = clip.rig.joints[leg]
    positions[first : last + 1, ankle, 1] += heel
    positions[first : last + 1, toe, 1] += 0.05
    return clip.with_motion(positions, clip.rotations_ws)


def test_a_stance_on_toes_is_used_only_if_no_flat_one_is_near(monkeypatch):
    clip = with_toe_stance(0.12)
    stances = reconstruction.find_stances(clip)
    (on_toes,) = np.flatnonzero(stances.toes)
    assert stances.leg[on_toes] == 0 and stances.used[on_toes]  # others are 30 cm away or more
    monkeypatch.setattr(reconstruction, "NEAR", 0.5)
    np.testing.assert_array_equal(
        reconstruction.find_stances(clip).used, np.arange(len(stances.leg)) != on_toes
    )
    assert not reconstruction.find_stances(with_toe_stance(0.05)).toes.any()


def test_stances_a_thousand_kilometres_apart_are_refused():
    clip = stair_walk()
    far = clip.positions_ws.copy()
    far[100:] += [1e6 / 2, 0.0, 0.0]
    with pytest.raises(ValueError, match="stances are up to 5e.05 m apart; wanted at most 1000"):
        reconstruction.reconstruct(replace(clip, positions_ws=far))


# Grids


def test_cells_lie_between_their_corners():
    inside = np.array([[2.0, -3.0], [0.0, 0.0], [-1.0, 4.0]])
    np.testing.assert_array_equal(TILTED.cells(TILTED.points(inside + [0.01, 0.99])), inside)
    corners = TILTED.points(np.array([[0.0, 0.0], [1.0, 0.0]]))
    ahead = np.array([np.cos(TILTED.heading), np.sin(TILTED.heading)])
    np.testing.assert_allclose(corners[1] - corners[0], 0.45 * ahead)


def test_a_grid_rotated_by_quarter_turns_has_one_canonical_form():
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    for quarters in (-2, -1, 0, 1, 2, 3):
        heading = TILTED.heading + quarters * np.pi / 2
        (corner,) = TILTED.points(np.zeros((1, 2))) @ block_grids._uv_from_xz(heading).T
        grid = block_grids._canonical(TILTED.pitch, heading, corner)
        assert grid.heading == pytest.approx(TILTED.heading)
        np.testing.assert_allclose(grid.origin, TILTED.origin, atol=1e-9)
        np.testing.assert_array_equal(grid.cells(points), TILTED.cells(points))


@pytest.mark.parametrize(
    ("known", "angle", "shift"),
    [
        pytest.param(WIDE, 0.0, [0.0, 0.0], marks=pytest.mark.slow),
        (TILTED, np.radians(-13.0), [4.0, -7.0]),
    ],
    ids=["80 cm", "45 cm, turned and shifted"],
)
def test_an_unknown_grid_is_found(known, angle, shift, narrow_search):
    feet, rot = block_footprints(known), block_grids._uv_from_xz(angle).T
    heights, heading = block_heights(known, feet.balls) + 1.0, known.heading - angle
    balls, ankles = (points @ rot + shift for points in (feet.balls, feet.ankles))
    feet = Footprints(balls, feet.heights + 1.0, ankles)
    ranked = block_grids.search(feet)
    surface = surfaces.fit_blocks(ranked, feet)
    assert surface.grid.pitch == pytest.approx(known.pitch, rel=0.02)
    assert surface.grid.heading == pytest.approx(heading, abs=np.radians(2.0))
    assert ranked.pitches[0] <= known.pitch <= ranked.pitches[1]
    step = np.radians(1.0)  # about that of the lattice from which the range is taken
    assert ranked.headings[0] - step <= heading <= ranked.headings[1] + step
    error = np.abs(surface.heights(feet.balls) - heights)[3:]
    assert np.median(error) < 0.003 and np.mean(error < 0.01) > 0.9


# Surfaces


def test_a_block_without_footprints_has_the_mean_height_of_its_neighbours():
    square = Grid(1.0, 0.0, (0.0, 0.0))
    cells, tops = np.array([[0, 0], [1, 0], [4, 0]]), np.array([0.1, 0.3, 0.5])
    surface = surfaces.LevelBlocks(square, cells, tops, np.array([1, 2, 1]))
    points = np.array([[0.5, 0.5], [0.5, 1.5], [2.5, 0.5], [3.5, 0.5], [9.5, 0.5]])
    np.testing.assert_allclose(surface.heights(points), [0.1, 0.2, 0.3, 0.5, 0.5])
    np.testing.assert_array_equal(surface.supported(points), [True, False, False, False, False])


def test_a_plane_is_robust_to_an_outlier_and_level_across_a_line_of_feet():
    feet = hill_footprints()
    heights = 0.2 + feet.balls @ [0.1, -0.05]
    heights[3] += 0.4
    surface = surfaces.fit_plane(replace(feet, heights=heights))
    assert surface.slope == pytest.approx((0.1, -0.05), abs=1e-3)
    assert surface.level == pytest.approx(0.2, abs=2e-3)
    balls = np.stack([np.zeros(8), np.linspace(0.0, 5.0, 8)], axis=-1)
    surface = surfaces.fit_plane(Footprints(balls, 0.1 * balls[:, 1], balls))
    assert surface.slope == pytest.approx((0.0, 0.1), abs=1e-4)


def test_leave_one_out_errors_agree_with_plates_fitted_to_the_others():
    feet = hill_footprints(12)
    errors = surfaces._leave_one_out_error(feet.balls, feet.heights)
    for smoothing in (1e-6, 0.01, 1.0):
        predicted = [
            RBFInterpolator(others.balls, others.heights, smoothing=smoothing)(feet.balls[[i]])[0]
            for i, others in enumerate(map(feet.without, range(12)))
        ]
        expected = np.sum((predicted - feet.heights) ** 2)
        assert errors(smoothing) == pytest.approx(expected, rel=1e-6)


def test_noisier_heights_give_a_smoother_plate():
    feet = hill_footprints(60)
    noisy = replace(feet, heights=np.random.default_rng(2).normal(0.0, 0.01, 60))
    assert surfaces.fit_thin_plate(feet).smoothing < 0.01 < surfaces.fit_thin_plate(noisy).smoothing
    with pytest.raises(ValueError, match="all stances are in a line"):
        surfaces.fit_thin_plate(Footprints(feet.balls * [1.0, 0.0], feet.heights, feet.balls))


def tilted_blocks() -> surfaces.LevelBlocks:
    ranked = block_grids.RankedGrids((TILTED,), np.zeros(1), (0.4, 0.5), (0.3, 0.4))
    return surfaces.fit_blocks(ranked, block_footprints(TILTED))


def test_a_mesh_has_the_heights_of_its_surface(tmp_path):
    plane, plate = surfaces.fit_plane(hill_footprints()), surfaces.fit_thin_plate(hill_footprints())
    low, high = np.array([-2.0, -1.5]), np.array([2.0, 2.5])
    for surface, suffix in ((plane, "ply"), (plate, "obj"), (tilted_blocks(), "stl")):
        path, mesh = tmp_path / f"ground.{suffix}", surface.mesh(low, high)
        mesh_files.save_mesh(path, mesh.vertices, mesh.faces)
        points = np.random.default_rng(3).uniform(low, high, (500, 2))
        if isinstance(surface, surfaces.LevelBlocks):
            inner = np.abs(np.mod(surface.grid.coordinates(points), 1.0) - 0.5).max(axis=1) < 0.49
            points = points[inner]
        found = heights_under(mesh_files.load_terrain(path), np.insert(points, 1, 0.0, axis=1), 9.0)
        tolerance = 0.005 if surface is plate else 1e-4
        np.testing.assert_allclose(found, surface.heights(points), atol=tolerance)


def test_the_mesh_of_blocks_has_vertical_risers_between_blocks():
    surface = tilted_blocks()
    mesh = surface.mesh(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    corners = np.round(mesh.vertices, 6)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.abs(normals[:, 1]) > 1e-9
    assert (normals[flat, 1] > 0).all() and np.ptp(corners[flat, :, 1], axis=1).max() < 1e-9
    assert (np.linalg.norm(normals, axis=-1) > 1e-6).all() and 0.2 < flat.mean() < 0.6
    # A riser faces the lower block: just in front of it the ground is at the riser's foot.
    middle = corners[~flat].mean(axis=1)
    away = normals[~flat] / np.linalg.norm(normals[~flat], axis=-1, keepdims=True)
    lower = surface.heights((middle + 0.01 * away)[:, [0, 2]])
    upper = surface.heights((middle - 0.01 * away)[:, [0, 2]])
    np.testing.assert_allclose(lower, corners[~flat, :, 1].min(axis=1), atol=1e-5)
    np.testing.assert_allclose(upper, corners[~flat, :, 1].max(axis=1), atol=1e-5)


def test_a_mesh_of_too_many_cells_is_refused_with_their_number():
    blocks = surfaces.LevelBlocks(TILTED, np.zeros((1, 2), np.int64), np.zeros(1), np.ones(1, int))
    for surface in (blocks, surfaces.fit_thin_plate(hill_footprints())):
        surface.mesh(np.zeros(2), np.full(2, 9.0))
        for size in (1e3, 1e6):
            with pytest.raises(ValueError, match="[0-9]{7,} cells; wanted at most 2000000"):
                surface.mesh(np.zeros(2), np.full(2, size))


# Choice of a surface


def test_the_simplest_kind_that_is_not_clearly_worse_is_chosen():
    rng = np.random.default_rng(5)

    def with_errors(sizes: list[float]) -> dict[str, Prediction]:
        kinds = zip(reconstruction.SURFACE_KINDS, sizes, strict=True)
        none = np.zeros(40, bool)
        return {kind: Prediction(rng.normal(0.0, size, 40), none) for kind, size in kinds}

    almost, smooth, blocks = [0.01, 0.0098, 0.0099], [0.1, 0.01, 0.0099], [0.1, 0.05, 0.01]
    for kind, sizes in (("plane", almost), ("smooth", smooth), ("blocks", blocks)):
        assert reconstruction.choose(with_errors(sizes)) == kind


def test_a_stance_is_predicted_from_the_others_only():
    feet = hill_footprints()
    with_outlier = replace(feet, heights=np.where(np.arange(30) == 7, 1.0, 0.0))
    prediction = reconstruction.leave_one_out(surfaces.fit_plane, with_outlier)
    assert prediction.errors[7] == pytest.approx(-1.0, abs=1e-6) and not prediction.alone.any()
    grid = block_grids.RankedGrids(
        (Grid(1e-3, 0.0, (0.0, 0.0)),), np.zeros(1), (0.0, 1.0), (0.0, 1.0)
    )
    unsupported = reconstruction.leave_one_out(lambda feet: surfaces.fit_blocks(grid, feet), feet)
    assert unsupported.alone.all() and np.isnan(unsupported.rms_shared) and unsupported.rms > 0.0


def test_a_synthetic_slope_is_reconstructed_as_a_plane(coarse_search):
    ground = reconstruction.reconstruct(stair_walk(slope, strides=6), sole=0.0)
    assert ground.chosen == "plane" and ground.predictions["plane"].rms < 0.003
    assert isinstance(ground.surface, surfaces.Plane)
    assert ground.surface.slope == pytest.approx((0.0, -0.1), abs=0.003)
    assert reconstruction.reconstruct(stair_walk(slope), kind="smooth").chosen == "smooth"


def test_the_terrain_of_the_uneven_walk_is_reconstructed_as_smooth(coarse_search):
    ground = reconstruction.reconstruct(clips.load_clip(UNEVEN), sole=gait.BALL_HEIGHT)
    assert ground.chosen == "smooth"
    points = ground.stances.points
    true = mesh_files.load_terrain(ROOT / "data" / "terrains" / "uneven_walk.ply")
    expected = mesh_files.height_function(true)(np.insert(points, 1, 0.0, axis=1))
    error = ground.surface.heights(points) - expected
    assert np.sqrt(np.mean(error**2)) < 0.04


# Captured clips


def test_the_blocks_of_subject_03_are_reconstructed_within_a_centimetre(mocap):
    """Compares heights in the middle of each cell of `terrain_subject03.json`.

    Both assume the ball joint 5.5 cm above the ground. Three of the file's 23 cells are known from
    stances on toes only.
    """
    reference = json.loads((mocap / "blocks" / "terrain_subject03.json").read_text())
    assert reference["ball_joint_height_above_surface"] == reconstruction.SOLE
    known = Grid(reference["cell_size"], reference["yaw_rad"], tuple(reference["origin"]))
    cells = np.array([[cell["i"], cell["j"]] for cell in reference["cells"]])
    heights = np.array([cell["height"] for cell in reference["cells"]])
    clean = np.array([cell["n_clean"] > 0 for cell in reference["cells"]])
    clip = clips.load_clip(mocap / "clips" / "cmu_asfamc" / "03_03.amc")
    ground = reconstruction.reconstruct(clip)
    assert ground.chosen == "blocks" and isinstance(ground.surface, surfaces.LevelBlocks)
    error = ground.surface.heights(known.points(cells + 0.5)) - heights
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert np.sqrt(np.mean(error[clean] ** 2)) < 0.006
    grid = ground.surface.grid
    assert grid.pitch == pytest.approx(0.60, abs=0.02)
    assert grid.heading == pytest.approx(known.heading, abs=np.radians(2.0))
    assert ground.grids.pitches[0] < 0.60 < ground.grids.pitches[1]
    assert len(ground.surface.tops) == 23
    prediction = ground.predictions["blocks"]
    assert prediction.rms_shared < 0.012 and prediction.alone.sum() <= 10
    assert prediction.rms < min(ground.predictions[kind].rms for kind in ("plane", "smooth"))


@pytest.mark.parametrize("name", ["01_01", "02_01", "02_03"])
def test_a_captured_floor_is_reconstructed_as_a_plane(mocap, name, coarse_search):
    clip = clips.load_clip(mocap / "clips" / "cmu_asfamc" / f"{name}.amc")
    ground = reconstruction.reconstruct(clip)
    assert ground.chosen == "plane" and ground.predictions["plane"].rms < 0.008


# The command `jaxik terrain`


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("input") / "walk.npz"
    clips.save_clip(path, stair_walk(slope, strides=4))
    return path


def test_the_command_writes_a_mesh_its_numbers_and_a_picture(clip, tmp_path, capsys, coarse_search):
    out = tmp_path / "hill.obj"
    words = ["terrain", clip, "-o", out, "--sole", "0.01", "--model", "blocks", "--margin", "0.5"]
    assert main.main([str(word) for word in words]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"hill.obj", "hill.json", "hill.png"}
    numbers, text = json.loads((tmp_path / "hill.json").read_text()), capsys.readouterr().out
    assert (numbers["chosen"], numbers["ball_over_sole"]) == ("blocks", 0.01)
    assert set(numbers["tested"]) == set(numbers["grounds"]) == set(reconstruction.SURFACE_KINDS)
    for row in numbers["stances"]:
        assert row["height"] == pytest.approx(0.29 - 0.1 * row["z"], abs=0.003)
        assert set(row["errors"]) == set(reconstruction.SURFACE_KINDS)
    for kind, prediction in numbers["tested"].items():
        rms = np.sqrt(np.mean([row["errors"][kind] ** 2 for row in numbers["stances"]]))
        assert prediction["rms"] == pytest.approx(rms, abs=2e-4)
    assert f"{len(numbers['stances'])} stances\n" in text and "blocks (chosen)" in text
    assert text.endswith(f"written to {out}\n")
    (surface,) = mesh_files.load_terrain(out).surfaces
    assert isinstance(surface, Mesh)
    z = np.asarray(surface.vertices_ws)[:, 2]
    stances_z = [row["z"] for row in numbers["stances"]]
    assert z.min() <= min(stances_z) - 0.5 and max(stances_z) + 0.5 <= z.max()


def test_impossible_requests_give_a_one_line_error_and_write_nothing(
    clip, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("taken.json").mkdir()
    short = clips.load_clip(clip).select(slice(0, 40))
    clips.save_clip("short.npz", short)
    before = set(tmp_path.iterdir())
    for walk, out, message in (
        (clip, "a.glb", "a.glb: wanted a name that ends in .ply, .obj, .stl"),
        (clip, "taken.ply", "taken.json: cannot be written: it is a folder"),
        ("short.npz", "a.ply", "stances; reconstruction needs 4 or more"),
    ):
        assert main.main(["terrain", str(walk), "-o", out]) == main.MISTAKE
        output = capsys.readouterr()
        assert output.out == "" and output.err.count("\n") == 1 and message in output.err
        assert set(tmp_path.iterdir()) == before
    with pytest.raises(ValueError, match="no foot ever stands; wanted 4"):
        reconstruction.reconstruct(replace(short, stance=np.zeros((40, 2), bool)))


def test_an_interrupt_leaves_no_files(clip, tmp_path, monkeypatch, coarse_search):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(style, "save", interrupt)
    words = ["terrain", str(clip), "-o", str(tmp_path / "a.ply")]
    assert main.main(words) == main.INTERRUPTED
    assert not list(tmp_path.iterdir())
