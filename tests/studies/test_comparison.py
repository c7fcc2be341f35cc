"""Systems side by side: which are compared, what is measured, what is written, what is refused."""

import json
import struct
from pathlib import Path

import jax
import numpy as np
import pytest

from fitting.analysis import measures
from fitting.analysis.measures import Measures
from fitting.analysis.playback import Motion
from fitting.cli import main
from fitting.datasets import clips
from fitting.datasets.clips import edit
from fitting.datasets.flat_animation import load_flat_animation
from fitting.report.labels import MEASURES
from fitting.report.plots import comparison_plots, style
from fitting.runtime import program_cache
from fitting.studies import comparison
from jaxik.world import terrain
from support.experiments import ROOT

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
STILL = "lock.enabled = false\n[leg]\nweight = 0.0\n"  # leaves the animation as it is


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """The commands' folder for compiled programs, which are compiled in a hurry."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path_factory.mktemp("compiled")))
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.config.update("jax_compilation_cache_dir", None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two seconds of a walk, and parameters."""
    path = tmp_path_factory.mktemp("given")
    clips.save_clip(path / "walk.npz", edit.trim(load_flat_animation(BASE), 3.0, 5.0))
    (path / "still.toml").write_text(STILL)
    return path


@pytest.fixture(scope="module")
def compared(folder) -> Path:
    """What the command leaves; not to be written to."""
    out = folder / "new" / "compared"
    words = ["compare", folder / "walk.npz", "--terrain", GROUND, "-o", out]
    words += ["--parameters", folder / "still.toml", "--presets", "record"]
    assert main.main([str(word) for word in words]) == 0
    return out


def numbers(folder: Path) -> dict[str, dict]:
    told = json.loads((folder / comparison.NUMBERS).read_text())
    return {system.pop("name"): system for system in told["systems"]}


# Which systems


def test_systems_come_in_the_order_in_which_they_are_asked_for(tmp_path):
    for name in ("b", "a"):
        (tmp_path / f"{name}.toml").write_text(STILL)
    files = f"{tmp_path / 'b.toml'}, {tmp_path / 'a.toml'}"
    options = main.parser().parse_args(
        ["compare", "c", "--terrain", "t", "-o", "d", "--parameters", files, "--presets", "record"]
    )
    systems = comparison.name_systems(options.systems)
    assert list(systems) == ["b", "a", "record"]
    assert float(systems["a"].leg.weight) == 0.0 and float(systems["record"].leg.weight) == 1.0


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ([], "nothing to compare; wanted --presets or --parameters"),
        ([("--presets", "")], "--presets '': wanted names with commas between them"),
        ([("--presets", "record,")], "--presets 'record,': wanted names"),
        ([("--presets", "recrod")], "no preset named 'recrod'; there are"),
        ([("--presets", "record,record")], "already is a system named 'record'"),
        ([("--presets", "record"), ("--parameters", "record.toml")], "system named 'record'"),
        ([("--parameters", "as animated.toml")], "system named 'as animated'"),
        ([("--parameters", "no.toml")], "no.toml: no such file, wanted a parameter file"),
        ([("--parameters", "odd.toml")], "odd.toml: unknown key 'lok'"),
    ],
)
def test_systems_that_cannot_be_are_refused(asked, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("record", "as animated"):
        Path(f"{name}.toml").write_text(STILL)
    Path("odd.toml").write_text("[lok]\nx = 1")
    with pytest.raises(ValueError, match=said):
        comparison.name_systems(asked)


# What is measured


def test_a_system_without_weight_measures_as_the_animation_does(compared):
    told = numbers(compared)
    assert list(told) == [comparison.ANIMATED, "still", "record"]
    animated, still = told[comparison.ANIMATED], told["still"]
    assert animated.pop("reached") is None and still.pop("reached") is not None
    assert still == pytest.approx(animated, rel=1e-4, abs=1e-6)
    assert animated["pops"] == animated["pop_max"] == 0.0


def test_foot_ik_brings_feet_out_of_the_ground_and_down_to_it(compared):
    told = numbers(compared)
    animated, record = told[comparison.ANIMATED], told["record"]
    assert record["penetration_mean"] < 0.2 * animated["penetration_mean"]
    assert record["clearance"] < 0.2 * animated["clearance"]
    assert record["reached"] > 0.5


def test_what_is_measured_is_what_run_writes(compared, folder):
    out = folder / "run.npz"
    words = ["run", folder / "walk.npz", "--terrain", GROUND, "-o", out, "--preset", "record"]
    assert main.main([str(word) for word in words]) == 0
    solved, walk = clips.load_clip(out), clips.load_clip(folder / "walk.npz")
    told, stance = numbers(compared)["record"], walk.stance_labels()
    way = measures.slide_per_stance(solved.joints_ws(3), stance)
    assert told["slide"] == pytest.approx(way, rel=1e-6)
    jerk = measures.jerk(solved.positions_ws[:, solved.rig.pelvis, 1], solved.fps)
    assert told["pelvis_jerk"] == pytest.approx(jerk, rel=1e-6)


def test_a_walk_neither_sinks_nor_floats_on_ground_at_the_height_of_its_floor(folder):
    walk = clips.load_clip(folder / "walk.npz")
    lifted = walk.with_motion(walk.positions_ws + [0.0, 0.3, 0.0], walk.rotations_ws)
    ground = terrain.plane(point=(0.0, 0.3, 0.0), normal=(0.0, 1.0, 0.0))
    told = comparison.compare({}, lifted, ground, floor=0.3).measures[comparison.ANIMATED]
    assert told.clearance < 1e-3 and told.penetration_mean < 1e-3
    told = comparison.compare({}, walk, ground).measures[comparison.ANIMATED]
    assert told.penetration_max == pytest.approx(0.3, abs=0.01) and told.clearance == 0.0


def test_a_point_deep_in_a_hill_finds_its_top_where_another_system_stands_on_it():
    ground = terrain.plane(point=(0.0, 5.0, 0.0), normal=(0.0, 1.0, 0.0))
    points = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 5.1, 0.0], [1.0, 0.0, 0.0]]])
    np.testing.assert_array_equal(
        comparison.heights_under(ground, points), [[5.0, np.nan], [5.0, np.nan]]
    )


def test_what_has_no_ground_below_is_left_out_and_told(folder, tmp_path):
    walk = clips.load_clip(folder / "walk.npz")
    middle = float(np.median(walk.joints_ws(2)[..., 2]))
    corners = np.array([[-9.0, 0.0, middle], [9.0, 0.0, middle], [0.0, 0.0, middle - 99.0]])
    half = comparison.compare({}, walk, terrain.mesh(corners, np.array([[0, 1, 2]])), title="half")
    assert 0.3 < half.unseen < 0.7 and np.isnan(half.ground).any()
    assert np.isfinite(half.measures[comparison.ANIMATED].clearance)
    comparison.write(tmp_path, half)
    assert "No ground is under" in (tmp_path / comparison.TABLE).read_text()
    none = comparison.compare({}, walk, terrain.mesh(corners - 999.0, np.array([[0, 1, 2]])))
    comparison.write(tmp_path, none)
    assert numbers(tmp_path)[comparison.ANIMATED]["clearance"] is None


# What is written


def test_the_folder_holds_a_table_its_numbers_and_a_figure(compared):
    assert {path.name for path in compared.iterdir()} == {
        comparison.TABLE, comparison.NUMBERS, comparison.FIGURE
    }  # fmt: skip
    text, told = (compared / comparison.TABLE).read_text(), numbers(compared)
    assert text.startswith("# walk.npz on uneven_walk.ply\n\n61 frames, 2.00 s at 30 Hz.")
    assert f"]({comparison.FIGURE})" in text and "No ground" not in text
    for column in MEASURES.values():
        assert f"- **{column.heading}** ({column.unit}): {column.meaning}" in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    for row, (name, system) in zip(rows[2:], told.items(), strict=True):
        values = [np.nan if value is None else value for value in system.values()]
        words = [MEASURES[key].format(one) for key, one in zip(MEASURES, values, strict=True)]
        assert row == "| " + " | ".join([name, *words]) + " |"
    assert all(one > 1000 for one in size_of_png(compared / comparison.FIGURE))


def size_of_png(path: Path) -> tuple[int, int]:
    return struct.unpack(">II", path.read_bytes()[16:24])


@pytest.mark.slow
def test_the_terminal_shows_the_table_and_how_long_each_system_took(folder, compared, capsys):
    words = ["compare", folder / "walk.npz", "--terrain", GROUND, "--presets", "record"]
    assert main.main([*map(str, words), "-o", str(folder / "again")]) == 0
    told = capsys.readouterr()
    assert told.out.splitlines()[0].split() == ["system", "as", "animated", "record"]
    assert f"read {folder / 'again' / comparison.TABLE}" in told.out
    name, dots, seconds, unit = told.err.split()
    assert (name, dots, unit) == ("record", "...", "s") and float(seconds) >= 0.0
    assert numbers(folder / "again")["record"] == numbers(compared)["record"]


def test_an_interrupt_leaves_nothing(folder, tmp_path, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(program_cache, "run", interrupt)
    words = ["compare", folder / "walk.npz", "--terrain", GROUND, "--presets", "record"]
    assert main.main([*map(str, words), "-o", str(tmp_path / "out")]) == main.INTERRUPTED
    assert capsys.readouterr().err == "record ... stopped\n\njaxik compare: interrupted\n"
    assert not list(tmp_path.iterdir())


def test_a_figure_tells_more_systems_apart_than_there_are_colours():
    names = [f"system {index}" for index in range(15)]
    looks = comparison_plots._line_styles(names)
    assert len({(look["color"], look["linestyle"]) for look in looks.values()}) == len(names)
    assert looks["system 0"]["color"] == style.BEFORE


@pytest.mark.parametrize("legs", [2, 4])
def test_a_figure_has_a_panel_a_leg_one_for_the_pelvis_and_one_a_measure(legs):
    still = [np.zeros((300, legs, 3)) for _ in range(4)]
    motion = Motion(np.zeros((300, 3)), *still)
    unknown = Measures(**{key: float("nan") for key in MEASURES})
    zero = Measures(**{key: 0.0 for key in MEASURES})
    compared = comparison.Comparison(
        "title", tuple(f"leg {leg}" for leg in range(legs)), 30.0, np.full((300, legs), np.nan), 0.0,
        {"as animated": motion, "other": motion}, {"as animated": unknown, "other": zero},
    )  # fmt: skip
    figure = comparison_plots.overview(compared)
    upper, lower = figure.subfigs
    assert len(upper.axes) == 2 * (legs + 1) and len(lower.axes) == len(MEASURES)
    assert [text.get_text() for text in lower.axes[0].texts] == ["–", "0.00"]
    for axes, column in zip(lower.axes, MEASURES.values(), strict=True):
        assert axes.get_title(loc="left").endswith(f", {column.unit}")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.texts] == ["as animated", "other", "ground"]


# What is refused


@pytest.mark.parametrize(
    ("clip", "ground", "out", "more", "said"),
    [
        ("no.npz", GROUND, "d", ["--presets", "record"], "no.npz: no such file"),
        (BASE, "no.ply", "d", ["--presets", "record"], "no.ply: there is no such file"),
        (BASE, GROUND, "file", ["--presets", "record"], "file: no folder for the run can be made"),
        (BASE, GROUND, "file/d", ["--presets", "record"], "/file is a file"),
        (BASE, GROUND, "d", [], "nothing to compare"),
        (BASE, GROUND, "d", ["--presets", "record,none"], "no preset named 'none'; there are"),
        (BASE, GROUND, "d", ["--presets", "record,record"], "already is a system named 'record'"),
        (BASE, GROUND, "d", ["--parameters", "legs.toml"], "legs: foot.max_roll has 3 values"),
    ],
)
def test_what_cannot_be_compared_is_told_in_a_line_and_nothing_written(
    clip, ground, out, more, said, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("kept")
    Path("legs.toml").write_text("foot.max_roll = [1, 2, 3]")
    words = ["compare", clip, "--terrain", ground, "-o", out, *more]
    assert main.main([str(word) for word in words]) == main.MISTAKE
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1 and said in told.err
    assert {path.name for path in tmp_path.iterdir()} == {"file", "legs.toml"}


def test_parameters_that_give_no_finite_pose_are_named_and_write_nothing(folder, tmp_path, capsys):
    (tmp_path / "mad.toml").write_text("pelvis.tick_hz = -inf\nleg.soften = inf\n")
    words = ["compare", folder / "walk.npz", "--terrain", GROUND, "-o", tmp_path / "out"]
    words += ["--parameters", tmp_path / "mad.toml"]
    assert main.main([str(word) for word in words]) == main.MISTAKE
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("jaxik compare: mad: these parameters give poses that are not finite")
    assert not (tmp_path / "out").exists()


def test_presets_that_leave_heights_to_their_game_stand_on_the_ground_unless_told_otherwise():
    asked = [("--presets", "mec,ozz,record")]
    grounded = comparison.name_systems(asked)
    animated = comparison.name_systems(asked, grounded=False)
    assert grounded["mec"].root.enabled and not animated["mec"].root.enabled
    assert grounded["ozz"].root.enabled and animated["ozz"].root.enabled
