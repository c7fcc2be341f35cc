"""Comparisons: which systems, what is measured, at which frame rates, and what is written."""

import dataclasses
import io
import json
import re
import struct
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from fitting import clips
from fitting.cli import main
from fitting.cli.parser import make_parser
from fitting.clips import edit
from fitting.experiment.systems import preset_system
from fitting.ground import meshes
from fitting.motion import measures
from fitting.motion.flat_animation import load_flat_animation
from fitting.motion.measures import MEASURES
from fitting.report import pages, style
from fitting.runtime import program_cache
from fitting.studies import animations, comparison
from fitting.studies.animations import Animation, every_frame, measure
from fitting.synthetic import walker
from fitting.synthetic.walker import WalkStyle
from jaxik.maths import parameter_tree
from jaxik.world import terrain
from stairs.walks import stepping
from support import comparisons
from support.commands import refusal
from support.experiments import ROOT
from support.pages import Page

pytestmark = pytest.mark.filterwarnings("always::fitting.studies.animations.PlacementWarning")

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
TERRACES = ROOT / "data" / "terrains" / "terraces.ply"
STILL = "[leg]\nweight = 0.0\n"  # changes nothing in the animation


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two seconds of a walk, and a parameter file."""
    path = tmp_path_factory.mktemp("files")
    clips.save_clip(path / "walk.npz", edit.trim(load_flat_animation(BASE), 3.0, 5.0))
    (path / "still.toml").write_text(STILL)
    return path


class Compared(NamedTuple):
    """What the command wrote, and what it printed."""

    folder: Path
    out: str
    err: str


@pytest.fixture(scope="module")
def compared(folder) -> Compared:
    """The preset `record` and a system that changes nothing; tests must not change the folder."""
    out, systems = folder / "new" / "compared", ["--parameters", folder / "still.toml"]
    words = ["compare", folder / "walk.npz", "--terrain", GROUND, "-o", out, *systems]
    with redirect_stdout(io.StringIO()) as shown, redirect_stderr(io.StringIO()) as warned:
        assert main.main([*map(str, words), "--presets", "record"]) == 0
    return Compared(out, shown.getvalue(), warned.getvalue())


def numbers(folder: Path) -> dict[str, dict]:
    content = json.loads((folder / comparison.NUMBERS).read_text())
    return {system.pop("name"): system for system in content["systems"]}


# Which systems


def test_systems_are_in_the_order_of_the_options_and_have_as_long_names_as_they_need(tmp_path):
    runs = ["walk/parameters.toml", "stairs/parameters.toml"]
    others = ["a/own.toml", "b/own.toml", "c.toml"]
    for place in runs + others:
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text(STILL)
    files = [str(tmp_path / place) for place in ("walk", runs[1], *others)]
    words = ["compare", "clip", "--parameters", ", ".join(files), "--presets", "record"]
    systems = comparison.named_systems(make_parser().parse_args(words).systems)
    assert list(systems) == ["walk", "stairs", "a/own", "b/own", "c", "record"]
    assert [float(ik.leg.weight) for ik in systems.values()] == [0.0] * 5 + [1.0]
    with pytest.raises(ValueError, match="already is a system named 'walk'"):
        comparison.named_systems([("--parameters", f"{files[0]},{files[0]}/parameters.toml")])
    with pytest.raises(ValueError, match="parameters.toml: no such file"):
        comparison.named_systems([("--parameters", str(tmp_path))])


# What is measured


def test_a_system_without_weight_measures_as_the_animation_and_another_brings_feet_down(compared):
    systems = numbers(compared.folder)
    assert list(systems) == [comparison.ANIMATED, "still", "record"]
    animated, still, record = systems.values()
    assert animated["reached"] is None and still["reached"] is not None
    for key in set(MEASURES) - {"reached"}:
        assert still[key] == pytest.approx(animated[key], rel=1e-4, abs=1e-5), key
    assert animated["pops"] == animated["pop"] == animated["slide"] == 0.0
    assert record["penetration_depth"] < 0.2 * animated["penetration_depth"]
    # The ground is up to 32 cm from the floor that the root stays on: some feet do not reach it.
    assert record["floating_height"] < 0.25 * animated["floating_height"]
    assert record["reached"] > 0.45


def test_the_measures_are_those_of_the_clip_that_run_writes(compared, folder):
    out = folder / "run.npz"
    words = ["run", folder / "walk.npz", "--terrain", GROUND, "-o", out, "--preset", "record"]
    assert main.main([str(word) for word in words]) == 0
    solved, record = clips.load_clip(out), numbers(compared.folder)["record"]
    with np.load(out) as arrays:
        placed = json.loads(str(arrays["placement"]))
    for key in MEASURES:
        assert record[key] == pytest.approx(placed[key], rel=1e-6), key
    jerk = measures.jerk(solved.positions_ws[:, solved.rig.pelvis, 1], solved.fps)
    assert record["pelvis_jerk"] == pytest.approx(jerk, rel=1e-6)


def test_clips_are_played_in_few_lengths_and_get_results_of_their_own(folder, monkeypatch):
    """Here the result is what goes in: whatever is added comes last and is taken away."""
    lengths = []

    def play(ik, rig, ground, frames, tracks):
        lengths.append(len(frames.dt))
        return frames, tracks

    monkeypatch.setattr(program_cache, "_run", play)
    walk = clips.load_clip(folder / "walk.npz")
    for count in (20, 60):
        part = edit.trim(walk, 0.0, count / walk.fps)
        weights = {"leg.weight": np.linspace(0.0, 1.0, part.frame_count)}
        animation = Animation(part, terrain.plane(), tracks=weights)
        result: Any = animation.run(preset_system("record"))
        frames, tracks = result
        np.testing.assert_array_equal(frames.pose.ankle.pos, animation.frames.pose.ankle.pos)
        np.testing.assert_array_equal(tracks["leg.weight"], weights["leg.weight"])
    assert lengths == [program_cache.LENGTH] * 2


def test_a_walk_neither_sinks_nor_floats_on_ground_at_the_height_of_its_floor(folder):
    walk = clips.load_clip(folder / "walk.npz")
    lifted = walk.with_motion(walk.positions_ws + [0.0, 0.3, 0.0], walk.rotations_ws)
    ground = terrain.plane(point=(0.0, 0.3, 0.0), normal=(0.0, 1.0, 0.0))
    on_floor = comparison.run_systems({}, Animation(lifted, ground, floor=0.3))
    measured = on_floor.animated.measures
    assert measured.floating_height < 1e-3 and measured.penetration_depth < 1e-3
    below_ground = comparison.run_systems({}, Animation(walk, ground))
    measured = below_ground.animated.measures
    assert measured.worst["penetration"].value == pytest.approx(0.3, abs=0.01)
    assert measured.floating_height == 0.0


def test_points_without_ground_are_left_out_and_mentioned(folder, tmp_path):
    """Beyond the end of the ground of the comparison, for which there is a program."""
    walk, ground = clips.load_clip(folder / "walk.npz"), meshes.load_terrain(GROUND)
    systems = {"record": preset_system("record")}
    end = np.max(meshes.mesh_of(ground).vertices[:, 2]) - np.median(walk.joints_ws(2)[..., 2])

    def compare(shift: float) -> comparison.Comparison:
        moved = walk.with_motion(walk.positions_ws + [0.0, 0.0, shift], walk.rotations_ws)
        return comparison.run_systems(systems, Animation(moved, ground))

    half = compare(end)
    assert 0.3 < half.animated.measures.groundless < 0.7
    assert np.isfinite(half.animated.measures.floating_height)
    comparison.document(half).write(tmp_path)
    assert "have no ground under them" in (tmp_path / comparison.TABLE).read_text()
    comparison.document(compare(999.0)).write(tmp_path)
    assert numbers(tmp_path)[comparison.ANIMATED]["floating_height"] is None


# What is written


def test_the_folder_holds_a_page_a_table_its_numbers_and_a_figure(compared):
    folder = compared.folder
    table, figure = folder / comparison.TABLE, folder / comparison.FIGURE
    page, files = folder / pages.PAGE, {path.name for path in folder.iterdir()}
    assert files == {page.name, table.name, figure.name, comparison.NUMBERS}
    (clip,) = Page(page).data["clips"]
    labels = [skeleton["label"] for skeleton in clip["skeletons"]]
    assert clip["frames"] == 61 and labels == ["flat animation", "still", "record"]
    text, systems = table.read_text(), numbers(folder)
    assert text.startswith(
        "# walk.npz on uneven_walk.ply\n\nFoot IK systems compared on one clip: "
    )
    assert "- **Frames**: 61, 2.00 s at 30 Hz\n" in text
    assert f"]({figure.name})" in text and "soles' points have no ground" not in text
    for column in MEASURES.values():
        assert f"- **{column.heading} ({column.unit})**: {column.meaning}" in text
    for key, column in MEASURES.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| {column.title} |")]
        values = [np.nan if system[key] is None else system[key] for system in systems.values()]
        cells = re.sub(r"<[^>]*>|[*!]", "", row).split(" | ")[2:]
        assert [cell.strip(" |") for cell in cells] == [*map(column.format, values)]
    assert all(pixels > 1000 for pixels in struct.unpack(">II", figure.read_bytes()[16:24]))


def test_the_terminal_shows_the_table_and_warnings(compared):
    headings = [
        line.split() for line in compared.out.splitlines() if line.strip().startswith("bound")
    ]
    assert headings == [["bound", "as", "animated", "still", "record"]]
    assert f"read {compared.folder / comparison.TABLE}" in compared.out
    assert "\n- Root: as animated: the ground is " in compared.out
    lines = compared.err.splitlines()
    assert lines and all(line.startswith(("jaxik: record: ", "jaxik: still: ")) for line in lines)


def test_a_figure_distinguishes_more_systems_than_there_are_colours():
    names = [f"system {index}" for index in range(15)]
    styles = comparison._line_styles(names)
    assert len({(style_["color"], style_["linestyle"]) for style_ in styles.values()}) == len(names)
    assert styles["system 0"]["color"] == style.BEFORE


def test_a_figure_has_a_panel_for_each_leg_the_pelvis_and_each_measure():
    compared = comparisons.invented_comparison(comparisons.walk(9.0))
    figure = comparison.overview(compared)
    upper, lower = figure.subfigs
    assert len(upper.axes) == 2 * (2 + 1) and len(lower.axes) == len(MEASURES)
    reached = lower.axes[list(MEASURES).index("reached")]
    assert [text.get_text() for text in reached.texts] == ["–", "–", "–"]
    for axes, column in zip(lower.axes, MEASURES.values(), strict=True):
        assert axes.get_title(loc="left").endswith(f", {column.unit}")
        lowest, highest = axes.get_ylim()
        assert all(highest < row < lowest for row in axes.get_yticks())
    (legend,) = figure.legends
    names = [text.get_text() for text in legend.texts]
    assert names == [comparison.ANIMATED, "close", "deep", "ground"]


def test_poses_that_are_not_finite_name_their_system_and_are_not_written(folder, tmp_path, capsys):
    (tmp_path / "mad.toml").write_text("lean.forward_rate = inf\n")
    words = ["compare", folder / "walk.npz", "--terrain", GROUND, "-o", tmp_path / "out"]
    line = refusal([*words, "--parameters", tmp_path / "mad.toml"], tmp_path, capsys)
    assert line.startswith("jaxik compare: mad: these parameters give poses that are not finite")


def test_presets_that_leave_heights_to_their_game_stand_on_the_ground_by_default():
    systems = comparison.named_systems([("--presets", "mec,ozz,unreal")])
    assert all(parameter_tree.get(ik, "root.enabled") for ik in systems.values())


# Another speed or direction


def test_strides_of_another_speed_and_direction_are_no_pops(tmp_path):
    clips.save_clip(tmp_path / "walk.npz", stepping(0.6))
    corners = np.array([[-20.0, 0.0, -20.0], [-20, 0, 20], [20, 0, 20], [20, 0, -20]])
    meshes.save_mesh(tmp_path / "floor.ply", corners, np.array([[0, 1, 2], [0, 2, 3]]))
    files = animations.AnimationFiles(
        tmp_path / "walk.npz", tmp_path / "floor.ply", speed=0.6, direction=1.0
    )
    animation = animations.load_animation(files)
    ik = preset_system("record", faithful=True)  # compiles sooner than others
    result, solved = animation.solve(parameter_tree.replace(ik, {"lock.enabled": False}))
    assert animation.place(solved, result).measures.pop < 0.005
    assert animation.place(solved).measures.pop > measures.VISIBLE, "off the animation itself"
    jump = np.where(np.arange(len(solved.positions_ws)) < 60, 0.0, 0.05)
    raised = solved.positions_ws.copy()
    raised[:, solved.rig.joints[0][2], 1] += jump
    jumping = solved.with_motion(raised, solved.rotations_ws)
    assert animation.place(jumping, result).measures.pop > 0.04


# Frame rates


@pytest.fixture(scope="module")
def fast() -> Animation:
    """A walk at 120 Hz over the first terraces."""
    clip = walker.walk(3.0, 120.0, 6, (), WalkStyle(knees=1.0))
    return Animation(clip, meshes.load_terrain(TERRACES))


def raised_by_frame_time(animation, ik):
    """A result that needs no pipeline: everything is raised by ten times the frame time, m."""
    clip, up = animation.clip, [0.0, 10.0 / animation.clip.fps, 0.0]
    return None, clip.with_motion(clip.positions_ws + up, clip.rotations_ws)


def test_every_fourth_frame_is_played_with_the_strides_speeds_and_restarts_of_the_clip(fast):
    restart = np.isin(np.arange(fast.clip.frame_count), [5, 8])
    own = dataclasses.replace(fast.frames, restart=restart)
    played = every_frame(dataclasses.replace(fast, given_frames=own), 4)
    frames = played.frames
    assert played.clip.fps == 30.0 and len(frames.dt) == 90
    np.testing.assert_allclose(frames.dt, 1 / 30, rtol=1e-6)
    np.testing.assert_array_equal(frames.stride.fraction, own.stride.fraction[::4])
    np.testing.assert_array_equal(frames.toe_speed, own.toe_speed[::4])
    np.testing.assert_array_equal(frames.pose.ankle.pos, own.pose.ankle.pos[::4])
    assert frames.restart is not None
    assert np.flatnonzero(frames.restart).tolist() == [2], "at the next frame that is played"


def test_a_rate_of_which_the_clips_is_no_multiple_is_refused(fast):
    for fps in (50.0, 240.0, 119.0):
        message = f"{fps:g} Hz; wanted a part .*: 120, 60, 40, 30, ... Hz"
        with pytest.raises(ValueError, match=message):
            measure({"ozz": preset_system("ozz")}, fast, [fps])


@pytest.mark.slow
def test_the_command_writes_the_table_of_frame_rates(fast, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(Animation, "solve", raised_by_frame_time)
    monkeypatch.setattr(Animation, "reached", lambda *_: np.ones((360, 2)))
    clips.save_clip(tmp_path / "walk.npz", fast.clip)
    words = ["compare", tmp_path / "walk.npz", "--terrain", TERRACES, "--presets", "ozz"]
    words += ["--rates", "60,30", "-o", tmp_path / "out"]
    assert main.main([str(word) for word in words]) == 0
    row = "ozz 60 Hz 83.3 83.3 83.3 83.3 83.3"
    assert row in " ".join(capsys.readouterr().out.split())
    text = (tmp_path / "out" / comparison.TABLE).read_text()
    assert "## At other frame rates" in text
    assert "h2 At other frame rates" in Page(tmp_path / "out" / pages.PAGE).headings
    assert "| ozz | 60 Hz | 83.3 | 83.3 | 83.3 | 83.3 | 83.3 |" in text
    half, quarter = json.loads((tmp_path / "out/compare.json").read_text())["rates"]
    assert (half["system"], half["fps"], quarter["fps"]) == ("ozz", 60.0, 30.0)
    for joint in animations.JOINTS:
        assert half["rms"][joint] == pytest.approx(10 / 60 - 10 / 120)
        assert half["largest"][joint] == pytest.approx(10 / 60 - 10 / 120)
        assert quarter["rms"][joint] == pytest.approx(10 / 30 - 10 / 120)
