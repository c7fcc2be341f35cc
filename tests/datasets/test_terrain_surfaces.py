"""Block grids found from footprints, and the surfaces fitted to them."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from fitting.datasets.terrain import block_grids, mesh_files, reconstruction, surfaces
from fitting.datasets.terrain.block_grids import Footprints, Grid
from jaxik.world import terrain
from support.footprints import TILTED, WIDE, block_footprints, block_heights, hill_footprints
from support.sample_clips import stair_walk

# Grids


def test_cells_lie_between_their_corners():
    inside = np.array([[2.0, -3.0], [0.0, 0.0], [-1.0, 4.0]])
    np.testing.assert_array_equal(TILTED.cells(TILTED.points(inside + [0.01, 0.99])), inside)
    corners = TILTED.points(np.array([[0.0, 0.0], [1.0, 0.0]]))
    np.testing.assert_allclose(
        corners[1] - corners[0], 0.45 * np.array([np.cos(TILTED.heading), np.sin(TILTED.heading)])
    )


@pytest.mark.parametrize("quarters", [-2, -1, 0, 1, 2, 3])
def test_a_grid_rotated_by_quarter_turns_has_one_canonical_form(quarters):
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    heading = TILTED.heading + quarters * np.pi / 2
    corner = TILTED.points(np.zeros((1, 2))) @ block_grids._uv_from_xz(heading).T
    grid = block_grids._canonical(TILTED.pitch, heading, corner[0])
    assert grid.heading == pytest.approx(TILTED.heading)
    np.testing.assert_allclose(grid.origin, TILTED.origin, atol=1e-9)
    np.testing.assert_array_equal(grid.cells(points), TILTED.cells(points))


@pytest.mark.slow
@pytest.mark.parametrize("grid", [TILTED, WIDE], ids=["45 cm", "80 cm"])
def test_an_unknown_grid_is_found(grid, narrow_search):
    feet = block_footprints(grid)
    ranked = block_grids.search(feet)
    surface = surfaces.fit_blocks(ranked, feet)
    assert surface.grid.pitch == pytest.approx(grid.pitch, rel=0.02)
    assert surface.grid.heading == pytest.approx(grid.heading, abs=np.radians(2.0))
    assert ranked.pitches[0] <= grid.pitch <= ranked.pitches[1]
    step = np.radians(1.0)  # about that of the lattice from which the range is taken
    assert ranked.headings[0] - step <= grid.heading <= ranked.headings[1] + step
    error = surface.heights(feet.balls[3:]) - block_heights(grid, feet.balls[3:])
    assert np.median(np.abs(error)) < 0.003 and np.mean(np.abs(error) < 0.01) > 0.9


@pytest.mark.slow
def test_rotating_and_shifting_the_feet_rotates_and_shifts_the_grid(narrow_search):
    feet, angle, shift = block_footprints(TILTED), np.radians(-13.0), np.array([4.0, -7.0])
    rot = block_grids._uv_from_xz(angle)
    moved = Footprints(feet.balls @ rot.T + shift, feet.heights + 1.0, feet.ankles @ rot.T + shift)
    surface = surfaces.fit_blocks(block_grids.search(moved), moved)
    assert surface.grid.pitch == pytest.approx(TILTED.pitch, rel=0.02)
    assert surface.grid.heading == pytest.approx(TILTED.heading - angle, abs=np.radians(2.0))


def test_the_search_is_deterministic(coarse_search):
    feet = block_footprints(TILTED, count=20)
    assert block_grids.search(feet).grids == block_grids.search(feet).grids


# Surfaces


def test_a_block_without_footprints_has_the_mean_height_of_its_neighbours():
    square = Grid(1.0, 0.0, (0.0, 0.0))
    cells, tops = np.array([[0, 0], [1, 0], [4, 0]]), np.array([0.1, 0.3, 0.5])
    surface = surfaces.LevelBlocks(square, cells, tops, np.array([1, 2, 1]))
    points = np.array([[0.5, 0.5], [0.5, 1.5], [2.5, 0.5], [3.5, 0.5], [9.5, 0.5]])
    np.testing.assert_allclose(surface.heights(points), [0.1, 0.2, 0.3, 0.5, 0.5])
    np.testing.assert_array_equal(surface.supported(points), [True, False, False, False, False])


def test_a_plane_is_robust_to_an_outlier():
    feet = hill_footprints()
    heights = 0.2 + feet.balls @ [0.1, -0.05]
    heights[3] += 0.4
    surface = surfaces.fit_plane(replace(feet, heights=heights))
    assert surface.slope == pytest.approx((0.1, -0.05), abs=1e-3)
    assert surface.level == pytest.approx(0.2, abs=2e-3)


def test_a_plane_below_feet_in_a_line_is_level_across_it():
    balls = np.stack([np.zeros(8), np.linspace(0.0, 5.0, 8)], axis=-1)
    surface = surfaces.fit_plane(Footprints(balls, 0.1 * balls[:, 1], balls))
    assert surface.slope == pytest.approx((0.0, 0.1), abs=1e-4)


def test_leave_one_out_errors_agree_with_plates_fitted_to_the_others():
    feet = hill_footprints(12)
    errors = surfaces._leave_one_out_error(feet.balls, feet.heights)
    for smoothing in (1e-6, 0.01, 1.0):
        each = [
            RBFInterpolator(others.balls, others.heights, smoothing=smoothing)(feet.balls[[i]])[0]
            - feet.heights[i]
            for i, others in enumerate(map(feet.without, range(12)))
        ]
        assert errors(smoothing) == pytest.approx(np.sum(np.square(each)), rel=1e-6)


def test_noisier_heights_give_a_smoother_plate():
    feet = hill_footprints(60)
    noisy = replace(feet, heights=np.random.default_rng(2).normal(0.0, 0.01, 60))
    assert surfaces.fit_thin_plate(feet).smoothing < 0.01 < surfaces.fit_thin_plate(noisy).smoothing
    with pytest.raises(ValueError, match="all stances are in a line"):
        surfaces.fit_thin_plate(Footprints(feet.balls * [1.0, 0.0], feet.heights, feet.balls))


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl"])
@pytest.mark.parametrize("kind", reconstruction.SURFACE_KINDS)
def test_a_mesh_has_the_heights_of_its_surface(kind, suffix, tmp_path):
    feet = block_footprints(TILTED)
    surface: surfaces.Surface = {
        "plane": surfaces.fit_plane(feet),
        "smooth": surfaces.fit_thin_plate(hill_footprints()),
        "blocks": surfaces.fit_blocks(
            block_grids.RankedGrids((TILTED,), np.zeros(1), (0.4, 0.5), (0.3, 0.4)), feet
        ),
    }[kind]
    low, high = np.array([-2.0, -1.5]), np.array([2.0, 2.5])
    mesh = surface.mesh(low, high)
    mesh_files.save_mesh(tmp_path / f"ground.{suffix}", mesh.vertices, mesh.faces)
    points = np.random.default_rng(3).uniform(low, high, (500, 2))
    if kind == "blocks":
        inner = np.abs(np.mod(surface.grid.coordinates(points), 1.0) - 0.5).max(axis=1) < 0.49  # pyright: ignore
        points = points[inner]
    origins = np.stack([points[:, 0], np.full(len(points), 9.0), points[:, 1]], axis=-1)
    hit = terrain.cast(
        mesh_files.load_terrain(tmp_path / f"ground.{suffix}"), jnp.asarray(origins), jnp.inf
    )
    assert (np.asarray(hit.found) > 0).all()
    np.testing.assert_allclose(
        np.asarray(hit.point)[:, 1],
        surface.heights(points),
        atol=0.005 if kind == "smooth" else 1e-4,
    )


def test_the_mesh_of_blocks_has_vertical_risers_between_blocks():
    feet = block_footprints(TILTED)
    ranked = block_grids.RankedGrids((TILTED,), np.zeros(1), (0.4, 0.5), (0.3, 0.4))
    mesh = surfaces.fit_blocks(ranked, feet).mesh(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    corners = np.round(mesh.vertices, 6)[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.abs(normals[:, 1]) > 1e-9
    assert (normals[flat, 1] > 0).all() and np.ptp(corners[flat, :, 1], axis=1).max() < 1e-9
    assert (np.linalg.norm(normals, axis=-1) > 1e-6).all() and 0.2 < flat.mean() < 0.6
    # A riser faces the lower block: just in front of it the ground is at the riser's foot.
    middle = corners[~flat].mean(axis=1)
    away = normals[~flat] / np.linalg.norm(normals[~flat], axis=-1, keepdims=True)
    surface = surfaces.fit_blocks(ranked, feet)
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


def test_stances_a_thousand_kilometres_apart_are_refused():
    clip = stair_walk()
    far = clip.positions_ws.copy()
    far[100:] += [1e6 / 2, 0.0, 0.0]
    with pytest.raises(ValueError, match="stances are up to 5e.05 m apart; wanted at most 1000"):
        reconstruction.reconstruct(replace(clip, positions_ws=far))
