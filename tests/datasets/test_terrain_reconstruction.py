"""Terrain reconstructed from a clip: stances, the choice of a surface, and the command."""

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fitting.cli import main
from fitting.datasets import clips
from fitting.datasets.clips import contacts
from fitting.datasets.synthetic import gait
from fitting.datasets.terrain import block_grids, mesh_files, reconstruction, surfaces
from fitting.datasets.terrain.block_grids import Grid
from fitting.datasets.terrain.reconstruction import Prediction
from fitting.report import terrain_report
from fitting.report.plots import style
from jaxik.world.surfaces import Mesh
from support.experiments import ROOT
from support.footprints import hill_footprints
from support.sample_clips import stair_walk

UNEVEN = ROOT / "data" / "clips" / "uneven_walk.npz"


def slope(points: np.ndarray) -> np.ndarray:
    """Ground height, m, that falls by 10 cm per metre of z."""
    return 0.3 - 0.1 * points[:, 2]


# Stances


def test_stances_are_at_the_balls_with_the_ground_a_sole_below():
    clip = stair_walk(slope)
    stances = reconstruction.find_stances(clip, sole=0.02)
    assert len(stances.leg) == 6 or len(stances.leg) == 7
    assert (np.diff(stances.first) >= 0).all() and stances.used.all()
    points_ws = np.insert(stances.points, 1, 0.0, axis=1)
    np.testing.assert_allclose(stances.heights, slope(points_ws) - 0.02, atol=0.002)


def test_surfaces_are_fitted_to_a_bounded_number_of_stances_evenly_chosen(monkeypatch):
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
    clip = stair_walk(slope, strides=6)
    repeats = 600
    motion = (np.concatenate([part] * repeats) for part in (clip.positions_ws, clip.rotations_ws))
    long = replace(clip.with_motion(*motion), stance=np.tile(clip.stance_labels(), (repeats, 1)))
    tracemalloc.start()
    stances = reconstruction.find_stances(long)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(stances.leg) > 5000 and peak < 10 * long.positions_ws.nbytes


def lifted(heel: float, leg: int = 0) -> clips.Clip:
    """A walk on a floor whose third stance of a foot is on its toes, 5 cm above the floor."""
    clip = stair_walk(lambda points: 0.0 * points[:, 0], strides=6)
    ((first, last),) = [contacts.runs(clip.stance_labels()[:, leg])[2]]
    positions = clip.positions_ws.copy()
    _, _, ankle, toe = clip.rig.joints[leg]
    positions[first : last + 1, ankle, 1] += heel
    positions[first : last + 1, toe, 1] += 0.05
    return clip.with_motion(positions, clip.rotations_ws)


def test_a_stance_on_toes_is_used_only_if_no_flat_one_is_near(monkeypatch):
    clip = lifted(0.12)
    stances = reconstruction.find_stances(clip)
    (on_toes,) = np.flatnonzero(stances.toes)
    assert stances.leg[on_toes] == 0 and stances.used[on_toes]  # others are 30 cm away or more
    monkeypatch.setattr(reconstruction, "NEAR", 0.5)
    np.testing.assert_array_equal(
        reconstruction.find_stances(clip).used, np.arange(len(stances.leg)) != on_toes
    )
    assert not reconstruction.find_stances(lifted(0.05)).toes.any()


def test_marker_pops_do_not_move_a_stance():
    clip = stair_walk(slope)
    ((first, last), *_) = contacts.runs(clip.stance_labels()[:, 0])
    positions = clip.positions_ws.copy()
    toe = clip.rig.joints[0][3]
    positions[first + 2 : last - 2 : 3, toe] += [0.0, 0.2, 0.0]
    popped = reconstruction.find_stances(clip.with_motion(positions, clip.rotations_ws))
    np.testing.assert_allclose(
        popped.heights, reconstruction.find_stances(clip).heights, atol=0.002
    )


# Choice of a surface


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
    expected = mesh_files.height_function(
        mesh_files.load_terrain(ROOT / "data" / "terrains" / "uneven_walk.ply")
    )(np.insert(points, 1, 0.0, axis=1))
    error = ground.surface.heights(points) - expected
    assert np.sqrt(np.mean(error**2)) < 0.04


# Captured clips


@pytest.mark.slow
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

    ground = reconstruction.reconstruct(
        clips.load_clip(mocap / "clips" / "cmu_asfamc" / "03_03.amc")
    )
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
    ground = reconstruction.reconstruct(
        clips.load_clip(mocap / "clips" / "cmu_asfamc" / f"{name}.amc")
    )
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "a.glb"], "a.glb: wanted a name that ends in .ply, .obj, .stl"),
        (["-o", "no/a.ply"], "there is no folder no"),
        (["-o", "taken.ply"], "taken.json: cannot be written: it is a folder"),
    ],
)
def test_impossible_requests_give_a_one_line_error_and_write_nothing(
    words, message, clip, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("taken.json").mkdir()
    assert main.main(["terrain", str(clip), *words]) == main.MISTAKE
    output = capsys.readouterr()
    assert output.out == "" and output.err.count("\n") == 1 and message in output.err
    assert [path.name for path in tmp_path.iterdir()] == ["taken.json"]


def test_a_missing_clip_or_one_with_few_stances_is_refused(clip, tmp_path, capsys):
    out = str(tmp_path / "a.ply")
    assert main.main(["terrain", str(tmp_path / "no.bvh"), "-o", out]) == main.MISTAKE
    assert "no.bvh: no such file" in capsys.readouterr().err
    short = clips.load_clip(clip).select(slice(0, 40))
    clips.save_clip(tmp_path / "short.npz", short)
    assert main.main(["terrain", str(tmp_path / "short.npz"), "-o", out]) == main.MISTAKE
    assert "stances; reconstruction needs 4 or more" in capsys.readouterr().err
    without_stance = replace(short, stance=np.zeros((40, 2), bool))
    with pytest.raises(ValueError, match="no foot ever stands; wanted 4"):
        reconstruction.reconstruct(without_stance)


def test_an_interrupt_leaves_no_files(clip, tmp_path, monkeypatch, coarse_search):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(style, "save", interrupt)
    words = ["terrain", str(clip), "-o", str(tmp_path / "a.ply")]
    assert main.main(words) == main.INTERRUPTED
    assert not list(tmp_path.iterdir())
