"""Ground from motion: stances, the three kinds of ground, their choice, and what is written."""

import json
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from fitting.cli import main
from fitting.datasets import clips
from fitting.datasets.clips import contacts
from fitting.datasets.synthetic import gait
from fitting.datasets.terrain import block_grids, mesh_files, reconstruction, surfaces
from fitting.datasets.terrain.block_grids import Footprints, Grid
from fitting.datasets.terrain.reconstruction import Prediction
from fitting.report.plots import style
from jaxik.world import terrain
from support.experiments import ROOT
from support.sample_clips import walker

UNEVEN = ROOT / "data" / "clips" / "uneven_walk.npz"
TILTED = Grid(0.45, np.radians(20.0), (0.1, 0.3))
WIDE = Grid(0.8, np.radians(-35.0), (0.2, 0.5))


def slope(points: np.ndarray) -> np.ndarray:
    """Ground that falls by 10 cm a metre along z."""
    return 0.3 - 0.1 * points[:, 2]


def tops_of(grid: Grid, points: np.ndarray) -> np.ndarray:
    """Heights of made blocks, m: any of 0 to 35 cm, in steps of 5."""
    i, j = grid.cells(points).T
    return 0.05 * ((3 * i + 5 * j + i * j) % 8)


def footprints(grid: Grid, count: int = 60, odd: int = 3) -> Footprints:
    """Feet that stand about on 3 m by 3 m of blocks, none with its heel in a higher one."""
    rng = np.random.default_rng(4)
    balls = rng.uniform(-1.5, 1.5, (20 * count, 2))
    turn = rng.uniform(0.0, 2.0 * np.pi, len(balls))
    ankles = balls - 0.1 * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    stand = np.flatnonzero(tops_of(grid, ankles) <= tops_of(grid, balls))[:count]
    heights = tops_of(grid, balls[stand]) + rng.normal(0.0, 0.003, count)
    heights[:odd] += 0.06
    return Footprints(balls[stand], heights, ankles[stand])


def plate(count: int = 30) -> Footprints:
    """Feet on a hill."""
    balls = np.random.default_rng(1).uniform(-2.0, 2.0, (count, 2))
    heights = 0.3 * np.exp(-np.sum(balls**2, axis=-1))
    return Footprints(balls, heights, balls)


@pytest.fixture
def hurried(monkeypatch):
    """A search for grids in large steps, where no grid is wanted."""
    monkeypatch.setattr(block_grids, "PITCH_STEP", 0.15)
    monkeypatch.setattr(block_grids, "HEADING_STEP", np.radians(15.0))
    monkeypatch.setattr(block_grids, "LATTICE", (-1, 0, 1))


@pytest.fixture
def nearby(monkeypatch):
    """A search among fewer grids."""
    monkeypatch.setattr(block_grids, "PITCHES", (0.35, 1.0))
    monkeypatch.setattr(block_grids, "COARSE_KEPT", 8)


# Grids


def test_cells_are_where_their_corners_say():
    inside = np.array([[2.0, -3.0], [0.0, 0.0], [-1.0, 4.0]])
    np.testing.assert_array_equal(TILTED.cells(TILTED.points(inside + [0.01, 0.99])), inside)
    apart = TILTED.points(np.array([[0.0, 0.0], [1.0, 0.0]]))
    np.testing.assert_allclose(
        apart[1] - apart[0], 0.45 * np.array([np.cos(TILTED.heading), np.sin(TILTED.heading)])
    )


@pytest.mark.parametrize("quarters", [-2, -1, 0, 1, 2, 3])
def test_a_grid_turned_by_quarters_is_written_in_one_way(quarters):
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    heading = TILTED.heading + quarters * np.pi / 2
    corner = TILTED.points(np.zeros((1, 2))) @ block_grids._uv_from_xz(heading).T
    grid = block_grids._canonical(TILTED.pitch, heading, corner[0])
    assert grid.heading == pytest.approx(TILTED.heading)
    np.testing.assert_allclose(grid.origin, TILTED.origin, atol=1e-9)
    np.testing.assert_array_equal(grid.cells(points), TILTED.cells(points))


@pytest.mark.parametrize("grid", [TILTED, WIDE], ids=["45 cm", "80 cm"])
def test_a_grid_that_nobody_told_of_is_found(grid, nearby):
    feet = footprints(grid)
    ranked = block_grids.search(feet)
    found = surfaces.fit_blocks(ranked, feet)
    assert found.grid.pitch == pytest.approx(grid.pitch, rel=0.02)
    assert found.grid.heading == pytest.approx(grid.heading, abs=np.radians(2.0))
    assert ranked.pitches[0] <= grid.pitch <= ranked.pitches[1]
    step = np.radians(1.0)  # of the lattice that the range is told from, about
    assert ranked.headings[0] - step <= grid.heading <= ranked.headings[1] + step
    error = found.heights(feet.balls[3:]) - tops_of(grid, feet.balls[3:])
    assert np.median(np.abs(error)) < 0.003 and np.mean(np.abs(error) < 0.01) > 0.9


def test_a_grid_found_in_turned_and_shifted_feet_is_the_grid_turned_and_shifted(nearby):
    feet, angle, shift = footprints(TILTED), np.radians(-13.0), np.array([4.0, -7.0])
    turn = block_grids._uv_from_xz(angle)  # by -angle
    moved = Footprints(
        feet.balls @ turn.T + shift, feet.heights + 1.0, feet.ankles @ turn.T + shift
    )
    found = surfaces.fit_blocks(block_grids.search(moved), moved)
    assert found.grid.pitch == pytest.approx(TILTED.pitch, rel=0.02)
    assert found.grid.heading == pytest.approx(TILTED.heading - angle, abs=np.radians(2.0))


def test_the_same_feet_always_make_the_same_grid(hurried):
    feet = footprints(TILTED, count=20)
    assert block_grids.search(feet).grids == block_grids.search(feet).grids


# Surfaces


def test_a_block_nobody_stepped_on_has_the_mean_of_those_next_to_it():
    square = Grid(1.0, 0.0, (0.0, 0.0))
    cells, tops = np.array([[0, 0], [1, 0], [4, 0]]), np.array([0.1, 0.3, 0.5])
    found = surfaces.LevelBlocks(square, cells, tops, np.array([1, 2, 1]))
    points = np.array([[0.5, 0.5], [0.5, 1.5], [2.5, 0.5], [3.5, 0.5], [9.5, 0.5]])
    np.testing.assert_allclose(found.heights(points), [0.1, 0.2, 0.3, 0.5, 0.5])
    np.testing.assert_array_equal(found.supported(points), [True, False, False, False, False])


def test_a_plane_is_not_pulled_by_a_foot_on_a_stool():
    feet = plate()
    heights = 0.2 + feet.balls @ [0.1, -0.05]
    heights[3] += 0.4
    found = surfaces.fit_plane(replace(feet, heights=heights))
    assert found.slope == pytest.approx((0.1, -0.05), abs=1e-3)
    assert found.level == pytest.approx(0.2, abs=2e-3)


def test_a_plane_below_feet_in_a_line_is_level_across():
    balls = np.stack([np.zeros(8), np.linspace(0.0, 5.0, 8)], axis=-1)
    found = surfaces.fit_plane(Footprints(balls, 0.1 * balls[:, 1], balls))
    assert found.slope == pytest.approx((0.0, 0.1), abs=1e-4)


def test_errors_of_a_plate_are_those_of_plates_through_all_the_others():
    feet = plate(12)
    errors = surfaces._leave_one_out_error(feet.balls, feet.heights)
    for smoothing in (1e-6, 0.01, 1.0):
        each = [
            RBFInterpolator(others.balls, others.heights, smoothing=smoothing)(feet.balls[[i]])[0]
            - feet.heights[i]
            for i, others in enumerate(map(feet.without, range(12)))
        ]
        assert errors(smoothing) == pytest.approx(np.sum(np.square(each)), rel=1e-6)


def test_a_plate_is_smoothed_as_much_as_its_heights_are_noisy():
    feet = plate(60)
    noisy = replace(feet, heights=np.random.default_rng(2).normal(0.0, 0.01, 60))
    assert surfaces.fit_thin_plate(feet).smoothing < 0.01 < surfaces.fit_thin_plate(noisy).smoothing
    with pytest.raises(ValueError, match="all stances are in a line"):
        surfaces.fit_thin_plate(Footprints(feet.balls * [1.0, 0.0], feet.heights, feet.balls))


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl"])
@pytest.mark.parametrize("kind", reconstruction.SURFACE_KINDS)
def test_a_mesh_has_the_heights_of_its_surface(kind, suffix, tmp_path):
    feet = footprints(TILTED)
    found: surfaces.Surface = {
        "plane": surfaces.fit_plane(feet),
        "smooth": surfaces.fit_thin_plate(plate()),
        "blocks": surfaces.fit_blocks(
            block_grids.RankedGrids((TILTED,), np.zeros(1), (0.4, 0.5), (0.3, 0.4)), feet
        ),
    }[kind]
    low, high = np.array([-2.0, -1.5]), np.array([2.0, 2.5])
    mesh = found.mesh(low, high)
    mesh_files.save_mesh(tmp_path / f"ground.{suffix}", mesh.vertices, mesh.faces)
    points = np.random.default_rng(3).uniform(low, high, (500, 2))
    if kind == "blocks":
        inner = np.abs(np.mod(found.grid.coordinates(points), 1.0) - 0.5).max(axis=1) < 0.49  # pyright: ignore
        points = points[inner]
    origins = np.stack([points[:, 0], np.full(len(points), 9.0), points[:, 1]], axis=-1)
    hit = terrain.cast(
        mesh_files.load_terrain(tmp_path / f"ground.{suffix}"), jnp.asarray(origins), jnp.inf
    )
    assert (np.asarray(hit.found) > 0).all()
    np.testing.assert_allclose(
        np.asarray(hit.point)[:, 1], found.heights(points), atol=0.005 if kind == "smooth" else 1e-4
    )


def test_blocks_have_upright_risers_that_close_the_steps_between_them():
    feet = footprints(TILTED)
    ranked = block_grids.RankedGrids((TILTED,), np.zeros(1), (0.4, 0.5), (0.3, 0.4))
    mesh = surfaces.fit_blocks(ranked, feet).mesh(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    corners = np.round(mesh.vertices, 6)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.abs(normals[:, 1]) > 1e-9
    assert (normals[flat, 1] > 0).all() and np.ptp(corners[flat, :, 1], axis=1).max() < 1e-9
    assert (np.linalg.norm(normals, axis=-1) > 1e-6).all() and 0.2 < flat.mean() < 0.6
    # A riser looks to its lower side: a little that way the ground is at its foot.
    middle = corners[~flat].mean(axis=1)
    away = normals[~flat] / np.linalg.norm(normals[~flat], axis=-1, keepdims=True)
    found = surfaces.fit_blocks(ranked, feet)
    lower = found.heights((middle + 0.01 * away)[:, [0, 2]])
    upper = found.heights((middle - 0.01 * away)[:, [0, 2]])
    np.testing.assert_allclose(lower, corners[~flat, :, 1].min(axis=1), atol=1e-5)
    np.testing.assert_allclose(upper, corners[~flat, :, 1].max(axis=1), atol=1e-5)


# Stances


def test_stances_are_where_balls_stood_with_the_ground_a_sole_below():
    clip = walker(slope)
    stances = reconstruction.find_stances(clip, sole=0.02)
    assert len(stances.leg) == 6 or len(stances.leg) == 7
    assert (np.diff(stances.first) >= 0).all() and stances.used.all()
    at = np.insert(stances.points, 1, 0.0, axis=1)
    np.testing.assert_allclose(stances.heights, slope(at) - 0.02, atol=0.002)


def lifted(heel: float, leg: int = 0) -> clips.Clip:
    """A walk on a floor; in its third stance a foot has its heel and its ball in the air."""
    clip = walker(lambda points: 0.0 * points[:, 0], strides=6)
    ((first, last),) = [contacts.runs(clip.stance_labels()[:, leg])[2]]
    positions = clip.positions_ws.copy()
    _, _, ankle, toe = clip.rig.joints[leg]
    positions[first : last + 1, ankle, 1] += heel
    positions[first : last + 1, toe, 1] += 0.05
    return clip.with_motion(positions, clip.rotations_ws)


def test_a_foot_on_its_toes_is_used_only_where_no_flat_one_is_near(monkeypatch):
    clip = lifted(0.12)
    stances = reconstruction.find_stances(clip)
    (one,) = np.flatnonzero(stances.toes)
    assert stances.leg[one] == 0 and stances.used[one]  # the next stances are 30 cm away and more
    monkeypatch.setattr(reconstruction, "NEAR", 0.5)
    np.testing.assert_array_equal(
        reconstruction.find_stances(clip).used, np.arange(len(stances.leg)) != one
    )
    assert not reconstruction.find_stances(lifted(0.05)).toes.any()


def test_frames_with_a_marker_pop_do_not_move_a_stance():
    clip = walker(slope)
    ((first, last), *_) = contacts.runs(clip.stance_labels()[:, 0])
    positions = clip.positions_ws.copy()
    toe = clip.rig.joints[0][3]
    positions[first + 2 : last - 2 : 3, toe] += [0.0, 0.2, 0.0]
    popped = reconstruction.find_stances(clip.with_motion(positions, clip.rotations_ws))
    np.testing.assert_allclose(
        popped.heights, reconstruction.find_stances(clip).heights, atol=0.002
    )


# The choice


def test_the_simplest_kind_that_is_not_clearly_worse_is_chosen():
    rng = np.random.default_rng(5)

    def with_errors(**sizes: float) -> dict[str, Prediction]:
        none = np.zeros(40, bool)
        return {
            kind: Prediction(rng.normal(0.0, sizes[kind], 40), none)
            for kind in reconstruction.SURFACE_KINDS
        }

    assert reconstruction.choose(with_errors(plane=0.01, smooth=0.0098, blocks=0.0099)) == "plane"
    assert reconstruction.choose(with_errors(plane=0.1, smooth=0.01, blocks=0.0099)) == "smooth"
    assert reconstruction.choose(with_errors(plane=0.1, smooth=0.05, blocks=0.01)) == "blocks"


def test_a_stance_is_predicted_without_itself():
    feet = plate()
    odd = replace(feet, heights=np.where(np.arange(30) == 7, 1.0, 0.0))
    tested = reconstruction.leave_one_out(surfaces.fit_plane, odd)
    assert tested.errors[7] == pytest.approx(-1.0, abs=1e-6) and not tested.alone.any()
    grid = block_grids.RankedGrids(
        (Grid(1e-3, 0.0, (0.0, 0.0)),), np.zeros(1), (0.0, 1.0), (0.0, 1.0)
    )
    alone = reconstruction.leave_one_out(lambda feet: surfaces.fit_blocks(grid, feet), feet)
    assert alone.alone.all() and np.isnan(alone.rms_shared) and alone.rms > 0.0


def test_a_made_slope_comes_out_as_a_plane(hurried):
    found = reconstruction.reconstruct(walker(slope, strides=6), sole=0.0)
    assert found.chosen == "plane" and found.predictions["plane"].rms < 0.003
    assert isinstance(found.surface, surfaces.Plane)
    assert found.surface.slope == pytest.approx((0.0, -0.1), abs=0.003)
    assert reconstruction.reconstruct(walker(slope), kind="smooth").chosen == "smooth"


def test_a_made_walk_on_uneven_ground_comes_out_smooth_and_near_it(hurried):
    found = reconstruction.reconstruct(clips.load_clip(UNEVEN), sole=gait.BALL_HEIGHT)
    assert found.chosen == "smooth"
    points = found.stances.points
    true = mesh_files.height_function(
        mesh_files.load_terrain(ROOT / "data" / "terrains" / "uneven_walk.ply")
    )(np.insert(points, 1, 0.0, axis=1))
    error = found.surface.heights(points) - true
    assert np.sqrt(np.mean(error**2)) < 0.04


# Captured clips


def test_the_blocks_of_subject_03_come_out_within_a_centimetre(mocap):
    """Our height in the middle of each cell of `terrain_subject03.json` against the one it has.

    Both take the ball joint to be 5.5 cm over the ground. Three of its 23 cells it has from stances
    on toes only.
    """
    told = json.loads((mocap / "blocks" / "terrain_subject03.json").read_text())
    assert told["ball_joint_height_above_surface"] == reconstruction.SOLE
    known = Grid(told["cell_size"], told["yaw_rad"], tuple(told["origin"]))
    cells = np.array([[cell["i"], cell["j"]] for cell in told["cells"]])
    heights = np.array([cell["height"] for cell in told["cells"]])
    clean = np.array([cell["n_clean"] > 0 for cell in told["cells"]])

    found = reconstruction.reconstruct(
        clips.load_clip(mocap / "clips" / "cmu_asfamc" / "03_03.amc")
    )
    assert found.chosen == "blocks" and isinstance(found.surface, surfaces.LevelBlocks)
    error = found.surface.heights(known.points(cells + 0.5)) - heights
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert np.sqrt(np.mean(error[clean] ** 2)) < 0.006
    grid = found.surface.grid
    assert grid.pitch == pytest.approx(0.60, abs=0.02)
    assert grid.heading == pytest.approx(known.heading, abs=np.radians(2.0))
    assert found.grids.pitches[0] < 0.60 < found.grids.pitches[1]
    assert len(found.surface.tops) == 23
    tested = found.predictions["blocks"]
    assert tested.rms_shared < 0.012 and tested.alone.sum() <= 10
    assert tested.rms < min(found.predictions[kind].rms for kind in ("plane", "smooth"))


@pytest.mark.parametrize("name", ["01_01", "02_01", "02_03"])
def test_a_captured_floor_is_a_plane(mocap, name, hurried):
    found = reconstruction.reconstruct(
        clips.load_clip(mocap / "clips" / "cmu_asfamc" / f"{name}.amc")
    )
    assert found.chosen == "plane" and found.predictions["plane"].rms < 0.008


# The command


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("given") / "walk.npz"
    clips.save_clip(path, walker(slope, strides=4))
    return path


def test_the_command_leaves_a_mesh_its_numbers_and_a_picture(clip, tmp_path, capsys, hurried):
    out = tmp_path / "hill.obj"
    words = ["terrain", clip, "-o", out, "--sole", "0.01", "--model", "blocks", "--margin", "0.5"]
    assert main.main([str(word) for word in words]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"hill.obj", "hill.json", "hill.png"}
    told, text = json.loads((tmp_path / "hill.json").read_text()), capsys.readouterr().out
    assert (told["chosen"], told["ball_over_sole"]) == ("blocks", 0.01)
    assert set(told["tested"]) == set(told["grounds"]) == set(reconstruction.SURFACE_KINDS)
    for row in told["stances"]:
        assert row["height"] == pytest.approx(0.29 - 0.1 * row["z"], abs=0.003)
        assert set(row["errors"]) == set(reconstruction.SURFACE_KINDS)
    for kind, one in told["tested"].items():
        rms = np.sqrt(np.mean([row["errors"][kind] ** 2 for row in told["stances"]]))
        assert one["rms"] == pytest.approx(rms, abs=2e-4)
    assert f"{len(told['stances'])} stances\n" in text and "blocks (chosen)" in text
    assert text.endswith(f"written to {out}\n")
    (surface,) = mesh_files.load_terrain(out).surfaces
    assert isinstance(surface, terrain.Mesh)
    z = np.asarray(surface.vertices_ws)[:, 2]
    stood = [row["z"] for row in told["stances"]]
    assert z.min() <= min(stood) - 0.5 and max(stood) + 0.5 <= z.max()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "a.glb"], "a.glb: wanted a name that ends in .ply, .obj, .stl"),
        (["-o", "no/a.ply"], "there is no folder no"),
        (["-o", "a.ply", "--sole", "-1"], "--sole is -1; wanted 0 or more metres"),
        (["-o", "a.ply", "--margin", "-1"], "--margin is -1; wanted 0 or more"),
        (["-o", "taken.ply"], "taken.json: cannot be written: it is a folder"),
    ],
)
def test_what_cannot_be_made_is_told_in_a_line_and_nothing_written(
    words, said, clip, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("taken.json").mkdir()
    assert main.main(["terrain", str(clip), *words]) == main.MISTAKE
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1 and said in told.err
    assert [path.name for path in tmp_path.iterdir()] == ["taken.json"]


def test_a_clip_that_is_not_there_or_hardly_stands_is_refused(clip, tmp_path, capsys):
    out = str(tmp_path / "a.ply")
    assert main.main(["terrain", str(tmp_path / "no.bvh"), "-o", out]) == main.MISTAKE
    assert "no.bvh: no such file" in capsys.readouterr().err
    short = clips.load_clip(clip).select(slice(0, 40))
    clips.save_clip(tmp_path / "short.npz", short)
    assert main.main(["terrain", str(tmp_path / "short.npz"), "-o", out]) == main.MISTAKE
    assert "stances; reconstruction needs 4 or more" in capsys.readouterr().err
    hanging = replace(short, stance=np.zeros((40, 2), bool))
    with pytest.raises(ValueError, match="no foot ever stands; wanted 4"):
        reconstruction.reconstruct(hanging)


def test_an_interrupt_leaves_nothing(clip, tmp_path, monkeypatch, hurried):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(style, "save", interrupt)
    words = ["terrain", str(clip), "-o", str(tmp_path / "a.ply")]
    assert main.main(words) == main.INTERRUPTED
    assert not list(tmp_path.iterdir())
