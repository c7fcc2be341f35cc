"""What is not known of a capture, as a part of a problem: ground, time, offsets, scale."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips.clip_frames import frames_from_clip
from fitting.experiment import experiment_files, parameter_files, problems
from fitting.experiment.experiment import Experiment
from fitting.problem import capture_system, residuals
from fitting.problem.capture_system import CapturedSystem, parted
from fitting.problem.scene import Capture
from fitting.studies.fit import run_folder
from fitting.synthetic import walker
from jaxik.world import terrain as terrains
from jaxik.world.skeleton import Transform
from support.experiments import CLIP, SECOND, write

CENTRE = np.array([0.3, 0.0, -0.2])  # m
HEIGHT, TILT_X, TILT_Z = 0.04, 0.05, -0.03  # m, rad


def load(folder: Path, **parts: str) -> Experiment:
    return experiment_files.load_experiment(write(folder, **parts))


def raised_points(points: np.ndarray) -> np.ndarray:
    """Points where the raised ground has them."""
    offset = points - CENTRE
    rise = HEIGHT + np.tan(TILT_X) * offset[..., 0] + np.tan(TILT_Z) * offset[..., 2]
    return points + rise[..., None] * np.array([0.0, 1.0, 0.0])


def test_rays_meet_raised_ground_where_a_mesh_with_moved_vertices_is():
    with jax.enable_x64(True):
        vertices, triangles = hill_mesh()
        terrain, moved = (
            terrains.mesh(points, triangles) for points in (vertices, raised_points(vertices))
        )
        numbers = (jnp.asarray(HEIGHT), (jnp.asarray(TILT_X), jnp.asarray(TILT_Z)))
        raised = capture_system.raised(terrain, jnp.asarray(CENTRE), *numbers)
        rays = jnp.asarray(np.random.default_rng(1).uniform(-0.8, 0.8, (200, 3)) + [0, 2, 0])
        found, wanted = (terrains.cast(each, rays, 5.0) for each in (raised, moved))
        assert np.asarray(wanted.found).all()
        for name in ("point", "normal", "distance", "found"):
            assert np.allclose(getattr(found, name), getattr(wanted, name), atol=1e-9), name
        by_ws = jnp.array([16.0, 0.0, -16.0])
        there = terrains.cast(raised.moved(by_ws), rays + by_ws, 5.0)
        assert np.allclose(there.point - by_ws, found.point, atol=1e-9)


def hill_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of uneven ground about the origin, 2 m wide."""
    side = np.linspace(-1.0, 1.0, 9)
    x, z = np.meshgrid(side, side)
    vertices = np.stack([x, 0.2 * np.sin(3 * x) * np.cos(2 * z), z], axis=-1).reshape(-1, 3)
    corner = np.arange(81).reshape(9, 9)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    return vertices, np.stack([a, c, b, b, c, d], axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def walk() -> tuple[jaxik.Rig, jaxik.Frame, jaxik.LegPose, Transform]:
    """A walk as a system might have solved it, and the frames it was made from."""
    with jax.enable_x64(True):
        clip = walker.walk(seconds=1.0, fps=30.0)
        legs = clip.leg_pose_ws()
        pelvis = clip.rig.pelvis
        joint = Transform(
            jnp.asarray(clip.positions_ws[:, pelvis]), jnp.asarray(clip.rotations_ws[:, pelvis])
        )
        return clip.rig, frames_from_clip(clip), legs, joint


def recorded(walk: Any, **numbers: float) -> tuple[jaxik.LegPose, Transform]:
    with jax.enable_x64(True):
        return compiled(dataclasses.replace(Capture(), **numbers), *walk)


compiled = eqx.filter_jit(capture_system.recorded)  # one program for all tests


def rotations(joint: Transform) -> Rotation:
    return Rotation.from_quat(np.array(joint.rot).reshape(-1, 4), scalar_first=True)


def test_a_capture_that_is_as_it_seems_shows_the_motion(walk):
    _, _, legs, pelvis = walk
    same, same_pelvis = recorded(walk)
    for joint, other in ((same.ankle, legs.ankle), (same.knee, legs.knee), (same_pelvis, pelvis)):
        assert np.allclose(joint.pos, other.pos, atol=1e-12)
        assert np.allclose(joint.rot, other.rot, atol=1e-12)


def test_offsets_are_along_the_axes_of_each_foot_and_outward_on_its_own_side(walk):
    rig, _, legs, _ = walk
    captured = recorded(walk, ankle_forward=0.01, ankle_up=0.02, ankle_outward=0.03)[0].ankle
    feet = Rotation.from_quat(
        np.tile(np.array(rig.ankle_from_foot), (len(legs.ankle.pos), 1)), scalar_first=True
    )
    offset = np.array(captured.pos - legs.ankle.pos).reshape(-1, 3)
    in_foot = (rotations(legs.ankle) * feet).inv().apply(offset).reshape(-1, 2, 3)
    outward = 0.03 * np.asarray(rig.side)
    assert np.allclose(in_foot, np.stack([outward, 0 * outward + 0.02, 0 * outward + 0.01], -1))
    assert np.allclose(captured.rot, legs.ankle.rot)


def test_a_ball_that_seems_elsewhere_turns_the_foot_towards_it(walk):
    rig, _, legs, _ = walk
    captured = recorded(walk, ball_up=0.02, ball_outward=0.01)[0].ankle
    assert np.allclose(captured.pos, legs.ankle.pos, atol=1e-12)
    ankle_from_foot = Rotation.from_quat(np.array(rig.ankle_from_foot), scalar_first=True)
    drop = np.asarray(rig.ball_height - rig.ankle_height)
    reach = np.sqrt(np.asarray(rig.foot) ** 2 - drop**2)
    ball = np.stack([0 * drop, drop, reach], axis=-1)
    seen = ball + np.stack([0.01 * np.asarray(rig.side), 0 * drop + 0.02, 0 * drop], axis=-1)
    aim, wanted = ankle_from_foot.apply(ball), ankle_from_foot.apply(seen)
    frames = len(legs.ankle.pos)
    aimed = rotations(captured).apply(np.tile(aim, (frames, 1)))
    target = rotations(legs.ankle).apply(np.tile(wanted, (frames, 1)))
    lengths = np.linalg.norm(aimed, axis=1) * np.linalg.norm(target, axis=1)
    assert np.allclose(np.sum(aimed * target, axis=1) / lengths, 1.0, atol=1e-9)


def test_lengths_are_scaled_about_the_middle_of_the_clip_on_its_floor(walk):
    _, frames, legs, pelvis = walk
    captured, captured_pelvis = recorded(walk, scale=1.02)
    centre = np.asarray(frames.world_from_model.pos).mean(axis=0)
    for joint, other in ((captured.knee, legs.knee), (captured_pelvis, pelvis)):
        assert np.allclose(joint.pos, centre + 1.02 * (other.pos - centre), atol=1e-9)


@pytest.mark.parametrize("shift", [0.05, -0.02])
def test_a_late_capture_shows_what_was_before(walk, shift):
    _, frames, _, pelvis = walk
    pos, fps = np.asarray(pelvis.pos), 30.0
    time = np.arange(len(pos)) / fps
    slopes = np.gradient(pos, 1 / fps, axis=0)
    wanted = CubicHermiteSpline(time, pos, slopes)(time - shift)  # Catmull and Rom's, independently
    got = np.asarray(recorded(walk, time_shift=shift)[1].pos)
    assert np.allclose(got[4:-4], wanted[4:-4], atol=1e-9)
    weights = jnp.arange(len(pos), dtype=float)
    with jax.enable_x64(True):
        capture = dataclasses.replace(Capture(), time_shift=shift)
        later = capture_system.delayed(capture, frames, weights)
    assert np.allclose(np.asarray(later)[4:-4], np.arange(len(pos))[4:-4] - shift * fps)


TABLE = """[capture]
ground_height = {}
time_shift = { low = -0.05, high = 0.05 }
"ankle_up[1]" = {}
[prior.capture]
ground_height = { centre = 0.03 }
"ankle_up[1]" = { spread = 0.1 }
[start.capture]
"ground_height[1]" = 0.02
"""


def test_every_clip_has_numbers_of_its_own_with_narrow_priors(tmp_path):
    experiment = load(tmp_path, rest=TABLE, clips=(CLIP + SECOND) * 2)
    (tmp_path / "again.toml").write_text(experiment_files.experiment_to_toml(experiment))
    again = experiment_files.load_experiment(tmp_path / "again.toml")
    assert again.capture == experiment.capture and again.free_count == 7
    with jax.enable_x64(True):
        space = again.space(again.starting_system())
    assert space.names[2:] == (
        "capture.ground_height[0]",
        "capture.ground_height[1]",
        "capture.time_shift[0]",
        "capture.time_shift[1]",
        "capture.ankle_up[1]",
    )
    assert np.allclose(space.prior.spread[2:], [0.55, 0.55, 0.55, 0.55, 0.1])
    centre, start = (np.asarray(space.values(u)) for u in (space.prior.centre, space.start))
    assert np.allclose(centre[2:], [0.03, 0.03, 0, 0, 0], atol=1e-12)
    assert np.allclose(start[2:], [0, 0.02, 0, 0, 0], atol=1e-12)
    low, high = space.prior_interval()[4]
    assert low == pytest.approx(-high) and 0.024 < high < 0.025  # half of 50 ms


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"rest": '[capture]\n"scale[1]" = {}'}, r"no clip for 'scale\[1\]'; wanted .*'\[0\]'"),
        ({"rest": "[prior.capture]\nscale = { spread = 1 }"}, "unknown key 'capture.scale'"),
        ({"rest": "[capture]\nscale = {}\n[start.capture]\nscale = 2.0"}, "scale: start is 2, wan"),
        (
            {"rest": "[capture]\ntime_shift = { low = -0.6, high = 0.6 }"},
            "nothing is left of clip 1",
        ),
    ],
)
def test_a_table_that_makes_no_sense_costs_one_sentence(tmp_path, parts, message):
    with pytest.raises(ValueError, match=message) as error:
        problems.make_problem(load(tmp_path, **parts))
    assert "\n" not in str(error.value)


def test_the_ends_of_a_clip_that_may_be_shifted_do_not_count(tmp_path):
    whole, cut = (
        problems.make_problem(load(tmp_path, rest=rest, top="fps = 30"))
        for rest in ("", "[capture]\ntime_shift = { low = -0.05, high = 0.1 }")
    )
    observed = [np.asarray(p.data[0].reference.observed) for p in (whole, cut)]
    assert observed[0].all()
    assert list(np.flatnonzero(~observed[1])) == [0, 1, 2, 3, 27, 28, 29, 30]


@pytest.mark.slow
def test_errors_are_those_from_what_the_capture_would_show(tmp_path):
    """At the numbers that displaced a reference nothing is left; without them, they are."""
    rest = "[capture]\nground_height = {}\nankle_up = {}\nscale = {}"
    problem = problems.make_problem(load(tmp_path, rest=rest))
    with jax.enable_x64(True):
        (scene,), system = problem.data, problem.space.system
        assert isinstance(system, CapturedSystem)
        moved = dataclasses.replace(
            system.capture, **{"ankle_up": jnp.array([0.02]), "scale": jnp.array([1.01])}
        )
        ik, (captured,) = parted(dataclasses.replace(system, capture=moved), problem.data)
        world = scene.frames.world_from_model
        legs = scene.frames.pose.transformed(Transform(world.pos[:, None], world.rot[:, None]))
        pelvis = world @ scene.pelvis
        recorded_legs, recorded_pelvis = compiled(
            moved.of_clip(0), scene.rig, scene.frames, legs, pelvis
        )
        reference = dataclasses.replace(
            scene.reference,
            ankle=recorded_legs.ankle,
            knee_ws=recorded_legs.knee.pos,
            pelvis=recorded_pelvis,
        )
        largest = {}
        for name, each in (("captured", captured), ("as it seems", scene)):
            each = dataclasses.replace(each, reference=reference)
            errors = residuals.errors_of_pose(each, legs, pelvis)
            largest[name] = {kind: np.abs(values).max() for kind, values in errors.items()}
    assert max(largest["captured"].values()) < 1e-9
    assert largest["as it seems"]["ankle"] > 0.015 and largest["as it seems"]["pelvis"] > 0.001
    assert type(ik) is jaxik.FootIK
    assert isinstance(captured.terrain.surfaces[0], capture_system.RaisedSurface)


def test_the_parameters_of_a_run_are_those_of_the_system_alone(tmp_path):
    experiment = load(tmp_path, rest="[capture]\nground_height = {}")
    problem = problems.make_problem(experiment)
    solution = SimpleNamespace(u=np.asarray(problem.space.start))
    run_folder.save_solution(tmp_path / "run", experiment, problem, solution)  # type: ignore[arg-type]
    content = (tmp_path / "run" / run_folder.PARAMETERS).read_text()
    ik, _ = parameter_files.load_system(tmp_path / "run" / run_folder.PARAMETERS)
    assert "capture" not in content and type(ik) is jaxik.FootIK
    assert "[capture.ground_height]" in (tmp_path / "run" / run_folder.EXPERIMENT).read_text()
