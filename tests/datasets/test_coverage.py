"""Terrain that does not lie below a clip: each mistake is made, and its remedy must be named."""

from pathlib import Path

import numpy as np
import pytest

from fitting.datasets import coverage
from fitting.datasets.clips import save_clip
from fitting.datasets.clips.clip import Clip
from fitting.datasets.coverage import GroundWarning
from fitting.datasets.synthetic import walker
from fitting.datasets.terrain.mesh_files import AS_IS, TerrainOptions, load_terrain, save_mesh
from fitting.experiments import experiment_files, problems
from fitting.studies.animations import AnimationFiles, load_animation
from jaxik.world import terrain
from support import experiments
from support.grounds import hill

Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def walk() -> Clip:
    """A walk from the origin along z."""
    return walker.walk(8.0, 30.0, style=walker.WalkStyle(bend=0.0))


def covered(
    walk: Clip, folder: Path, vertices: np.ndarray, options: TerrainOptions = AS_IS
) -> coverage.Coverage:
    """The coverage of the walk by a hill with these vertices."""
    save_mesh(folder / "hill.obj", vertices, hill().faces)

    def load(options: TerrainOptions) -> terrain.Terrain:
        return load_terrain(folder / "hill.obj", **vars(options))

    measured = coverage.measure(walk, load(options), options, load)
    remedy = measured.remedy
    assert remedy is None or coverage.measure(walk, load(remedy), remedy).is_enough
    return measured


def test_a_terrain_in_place_needs_no_remedy(walk, tmp_path):
    measured = covered(walk, tmp_path, hill().vertices)
    assert measured.share == 1.0 and measured.remedy is None and measured.is_enough
    np.testing.assert_allclose(measured.terrain, [[-2, 0, -2], [2, 2, 30]], atol=0.6)
    assert measured.feet.low[2] < 0.2 and measured.feet.high[2] > 5.0


def z_up(vertices: np.ndarray) -> np.ndarray:
    return vertices @ Z_UP_FROM_Y_UP.T


def test_the_other_axis_and_other_units_are_named(walk, tmp_path):
    for change, options, words in (
        (z_up, AS_IS, "--file-up z"),
        (lambda v: v, TerrainOptions(file_up="z"), "--file-up y"),
        (lambda v: v / 100, AS_IS, "--terrain-scale 100"),
        (lambda v: 100 * v, TerrainOptions(scale=0.0001), "--terrain-scale 0.01"),
        (lambda v: (v * [1, 1, 0.3] + [0, 0, 1]) / 0.0254, AS_IS, "--terrain-scale 0.0254"),
        (lambda v: (v + [0, 0, 2.1]) * 100, AS_IS, "--terrain-scale 0.01"),
        (
            lambda v: z_up(v * [1, 0.01, 1] + [0, 0, 2.1]) * 100,
            AS_IS,
            "--file-up z --terrain-scale 0.01",
        ),
    ):
        measured = covered(walk, tmp_path, change(hill().vertices), options)
        assert measured.share < 0.5
        assert measured.text().endswith(f"; likely remedy: {words}")


def test_a_terrain_far_from_the_origin_is_moved_below_the_feet(walk, tmp_path):
    far = np.array([480_000.0, 120.0, -5_200_000.0])
    measured = covered(walk, tmp_path, hill().vertices + far)
    assert measured.share == 0.0 and measured.remedy is not None
    moved = np.array(measured.remedy.offset)
    np.testing.assert_allclose((moved + far)[[0, 2]], [0.0, 0.0], atol=16.0)
    assert abs((moved + far)[1]) < 2.5
    words = [f"{value:.10g}" for value in moved]
    assert measured.text().endswith(f"; likely remedy: --terrain-offset {' '.join(words)}")
    in_keys = f"; likely remedy: terrain_offset = [{', '.join(words)}]"
    assert measured.text(as_keys=True).endswith(in_keys)


def test_a_terrain_that_is_aside_is_moved_from_a_given_offset_or_after_it_is_laid_down(
    walk, tmp_path
):
    upright = z_up(hill().vertices + [500.0, 0.0, 0.0])
    aside = TerrainOptions(offset=(300.0, 0.0, 0.0))
    cases = (upright, AS_IS, "z", -500.0), (hill().vertices, aside, "y", 0.0)
    for vertices, options, file_up, moved in cases:
        remedy = covered(walk, tmp_path, vertices, options).remedy
        assert remedy is not None and remedy.file_up == file_up
        assert remedy.offset[0] == pytest.approx(moved, abs=0.5)


def test_a_terrain_below_no_or_only_a_part_of_the_path_has_no_remedy(walk, tmp_path):
    measured = covered(walk, tmp_path, hill().vertices * [1.0, 1.0, 0.01] + [50.0, 0.0, 0.0])
    assert measured.remedy is None
    assert measured.text().endswith("offset helps: does the terrain cover the whole path?")
    measured = covered(walk, tmp_path, hill().vertices * [1.0, 1.0, 0.1] + [0.0, 0.0, 1.0])
    assert 0.2 < measured.share < 0.5 and measured.remedy is None


def test_a_plane_is_everywhere_and_a_heightfield_has_a_box(walk):
    assert coverage.measure(walk, terrain.plane()).share == 1.0
    field = terrain.heightfield(np.arange(6.0).reshape(2, 3), (0.5, 2.0), (10.0, 1.0, 0.0))
    box = coverage.bounds(field)
    np.testing.assert_allclose(box, [[10.0, 1.0, 0.0], [11.0, 6.0, 2.0]])
    assert coverage.measure(walk, field).share == 0.0


@pytest.fixture
def wrong(walk, tmp_path) -> AnimationFiles:
    """A flat walk and a hill in centimetres, read as metres, out of its reach."""
    save_clip(tmp_path / "walk.npz", walk)
    mesh = hill()
    save_mesh(tmp_path / "hill.obj", (mesh.vertices + [0.0, 0.0, 2.1]) * 100, mesh.faces)
    return AnimationFiles(tmp_path / "walk.npz", tmp_path / "hill.obj")


def test_a_flat_animation_without_ground_is_a_warning_and_an_error_where_it_is_fitted_to(wrong):
    remedy = "ground under .* % of its standing feet: .*likely remedy: --terrain-scale 0.01"
    with pytest.warns(GroundWarning, match=remedy):
        load_animation(wrong)
    with pytest.raises(ValueError, match=remedy):
        load_animation(wrong, to_fit=True)


def test_an_experiment_without_ground_is_an_error_before_anything_is_fitted(wrong, tmp_path):
    clips = f'[[clips]]\nreference = "{wrong.clip}"\nterrain = "{wrong.terrain}"\n'
    for base in ("", f'base = "{wrong.clip}"\n'):
        path = experiments.write(tmp_path, clips=clips + base)
        with pytest.raises(ValueError, match=r"walker.*likely remedy: terrain_scale = 0\.01$"):
            problems.make_problem(experiment_files.load_experiment(path))
    path = experiments.write(tmp_path, clips=f"{clips}{base}terrain_scale = 0.01\n")
    entry = experiment_files.load_experiment(path).clips[0]
    assert problems.load_clip_data(entry, None).base.frame_count == 240
