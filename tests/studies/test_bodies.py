"""Defaults on bodies for which nobody chose them, and on ground that no animation knows of.

The bodies are a child, a giant, a robot with short shins, and one whose legs are unlike.
"""

from dataclasses import replace
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.clips import Clip, edit, load_clip, save_clip
from fitting.clips.clip_frames import clip_from_result, frames_from_clip, raised
from fitting.experiment import parameter_files, systems
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import make_problem
from fitting.ground.ground_path import AS_ANIMATED, place_root
from fitting.ground.meshes import save_mesh
from fitting.motion import measures
from fitting.runtime import program_cache
from fitting.studies.animations import Animation
from fitting.synthetic import walker
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.stages.inputs import Inputs, Moment
from jaxik.world import body, terrain
from support.bodies import scaled, with_shins, without_t_pose
from support.experiments import ROOT, write
from support.grounds import edges_between_footfalls, flight, hill, terrain_of

CLIPS = ROOT / "data" / "clips"
CAPTURED = ROOT.parent / "shared" / "mocap" / "clips" / "cmu_bvh_mb" / "cmu_12_01_walk.bvh"
PRESETS = ["record", "ozz", "unreal", "mec", "stride"]
BODIES = {
    "child": lambda clip: scaled(clip, 0.55, froude=True),
    "giant": lambda clip: scaled(clip, 2.5, froude=True),
    "robot with short shins": lambda clip: with_shins(clip, 0.6, 0.6),
    "left and right unlike": lambda clip: with_shins(clip, 0.75, 0.6),
}
FLOOR = terrain.plane()


@pytest.fixture(scope="module")
def walk() -> Clip:
    return edit.trim(load_clip(CLIPS / "uneven_walk_base.npz"), 0.0, 3.0)


@pytest.fixture(scope="module")
def captured() -> Clip:
    if not CAPTURED.is_file():
        pytest.skip(f"captured clips are not at {CAPTURED.parent}")
    return edit.resample(without_t_pose(load_clip(CAPTURED)), 60.0)


@jax.jit
def contact_weights(ik: jaxik.FootIK, rig: jaxik.Rig, frames: jaxik.Frame) -> jax.Array:
    """0..1, (frames legs), of the contact rule by itself."""

    def advance(memory: tuple, frame: jaxik.Frame) -> tuple[tuple, jax.Array]:
        started, state = memory
        contact = ik.contact.sense(Inputs(rig, FLOOR, frame, jaxik.HARD))
        now = Moment(frame.dt, started, jaxik.HARD)
        state, contact = ik.contact.advance(now, contact, state)
        return (jnp.ones((), bool), state), contact.weight

    start = jnp.zeros((), bool), ik.contact.init(rig)
    return jax.lax.scan(advance, start, frames)[1]


def contact_share(clip: Clip, preset: str) -> float:
    ik = getattr(presets, preset)(clip.rig)
    return float(jnp.mean(contact_weights(ik, clip.rig, frames_from_clip(clip))))


@pytest.mark.parametrize("source", ["walk", "captured"])
def test_feet_stand_as_long_as_an_adults_whatever_the_body(source, request):
    clip = request.getfixturevalue(source)
    bodies = {name: make(clip) for name, make in BODIES.items()}
    for preset in PRESETS:
        share = contact_share(clip, preset)
        for name, other in bodies.items():
            assert contact_share(other, preset) == pytest.approx(share, abs=0.02), (preset, name)


@pytest.mark.slow
def test_with_ozz_soles_are_on_a_flat_floor_untouched(walk):
    run = jax.jit(jaxik.run)
    for name, make in BODIES.items():
        other = make(walk)
        result = run(presets.ozz(other.rig), other.rig, FLOOR, frames_from_clip(other))
        soles = measures.sole_points(clip_from_result(other, result))
        lowest = soles[..., 1].min(axis=-1)[other.stance_labels()]
        assert np.abs(lowest).max() < 0.005, name


def test_stances_are_detected_alike_at_the_same_and_at_an_equal_froude_speed(captured):
    share = captured.stance_labels().mean()
    assert 0.3 < share < 0.7
    for size in (0.55, 2.5):
        for froude in (False, True):
            other = replace(scaled(captured, size, froude=froude), stance=None)
            assert other.stance_labels().mean() == pytest.approx(share, abs=0.025)


def test_a_root_follows_ground_that_is_as_large_as_its_body():
    steps = np.repeat(0.15 * np.arange(8.0), 4)[:, None] * np.ones(40)  # m, a tread is 1 m long
    clip = edit.trim(load_clip(CLIPS / "uneven_walk_base.npz"), 0.0, 6.0)
    rises = []
    for size in (1.0, 0.5, 3.0):
        stairs = terrain.heightfield(size * steps, size * 0.25, origin=(-5.0 * size, 0.0, 0.0))
        _, choice = place_root(scaled(clip, size), stairs)
        assert choice.root == "ground" and choice.rise is not None
        rises.append(choice.rise / size)
    np.testing.assert_allclose(rises[1:], [rises[0]] * 2, atol=1e-4)


def test_what_is_visible_of_a_foot_is_as_large_as_its_body(walk):
    shares = []
    for size in (1.0, 0.5, 3.0):
        clip = scaled(walk, size)
        lowered = clip.with_motion(clip.positions_ws - [0.0, 0.03 * size, 0.0], clip.rotations_ws)
        measured = measures.place(lowered, clip, clip, FLOOR).measures
        assert measured.misplaced and measured.visible == pytest.approx(0.02 * size, rel=0.02)
        shares.append(measured.penetration)
    np.testing.assert_allclose(shares, shares[0])


def test_an_experiment_is_for_the_body_of_its_clip_unless_it_says_adult(tmp_path):
    corners = np.array([[-100.0, 0.0, -100.0], [-100, 0, 100], [100, 0, 100], [100, 0, -100]])
    save_mesh(tmp_path / "floor.ply", corners, np.array([[0, 1, 2], [0, 2, 3]]))
    save_clip(tmp_path / "giant.npz", scaled(load_clip(CLIPS / "uneven_walk_base.npz"), 2.5))
    files = f'reference = "{CLIPS / "uneven_walk.npz"}"\nbase = "giant.npz"\n'
    clips = f'[[clips]]\n{files}terrain = "floor.ply"\nroot = "animation"\n'

    def limits(top: str) -> tuple[float, float]:
        path = write(tmp_path, top=top, clips=clips, free="pelvis.limit = {}\nlean.half_life = {}")
        space = make_problem(load_experiment(path)).space
        assert space.parameters[1].high == 0.5
        return space.parameters[0].high, float(parameter_tree.get(space.system, "pelvis.limit"))

    assert limits("") == pytest.approx((1.5, 0.75), rel=0.01)
    assert limits('body = "adult"') == pytest.approx((0.6, 0.3))
    with pytest.raises(ValueError, match="body is 'child'; wanted one of"):
        limits('body = "child"')


def test_a_parameter_file_is_for_the_body_of_the_clip_unless_it_says_adult(walk, tmp_path):
    path, rig = tmp_path / "mine.toml", scaled(walk, 2.5).rig
    path.write_text('[rules]\npelvis = "ReachPelvis"\n[lock]\nrelease_distance = 0.1\n')
    ik, _ = parameter_files.load_system(path, rig)
    assert float(parameter_tree.get(ik, "lock.release_distance")) == pytest.approx(0.1)
    assert float(parameter_tree.get(ik, "probe.ray_up")) == pytest.approx(1.25, rel=0.01)
    assert float(parameter_tree.get(ik, "pelvis.softness")) == pytest.approx(0.0625, rel=0.01)
    path.write_text('body = "adult"\n')
    adult, _ = parameter_files.load_system(path, rig)
    for name in systems.leaf_names(ik := presets.record()):
        value, expected = (parameter_tree.get(each, name) for each in (adult, ik))
        np.testing.assert_array_equal(value, expected)


@pytest.mark.parametrize("name", PRESETS)
def test_a_system_with_a_number_for_each_leg_is_read_as_it_was_written(name, walk, tmp_path):
    unlike = replace(walk.rig, thigh=walk.rig.thigh * jnp.array([1.0, 0.5]))
    ik = getattr(presets, name)(unlike)
    path = tmp_path / "written.toml"
    path.write_text(parameter_files.system_to_toml(ik, systems.Preset(name)), encoding="utf-8")
    for reader in (None, walk.rig, unlike):
        again, _ = parameter_files.load_system(path, reader)
        assert jax.tree.structure(again) == jax.tree.structure(ik)
        for value, expected in zip(jax.tree.leaves(again), jax.tree.leaves(ik), strict=True):
            assert value.dtype == expected.dtype and np.array_equal(value, expected)


def test_a_quadruped_has_numbers_of_its_own_and_stands_as_long_when_it_is_larger():
    clip = load_clip(CLIPS / "quadruped_base.npz").select(slice(0, 60))
    larger = scaled(clip, 3.0)
    assert body.ratio(larger.rig) == pytest.approx(3.0 * body.ratio(clip.rig), rel=1e-6)
    for preset in PRESETS:
        share = contact_share(clip, preset)
        assert contact_share(larger, preset) == pytest.approx(share, abs=0.02)
    assert contact_share(clip, "record") > 0.3


# Ground


@pytest.fixture(scope="module")
def on_a_floor() -> Clip:
    return walker.walk(10.0, 60.0, style=walker.WalkStyle(bend=0.0))


def test_the_root_rises_without_pops_on_a_hill_and_on_stairs(on_a_floor):
    edges = edges_between_footfalls(on_a_floor, 8)
    for ground in (hill(), flight(edges[:4]), flight(edges)):
        _, root = place_root(on_a_floor, terrain_of(ground))
        assert root.root == "ground" and root.rise is not None
        assert np.abs(np.diff(root.rise)).max() < 0.02 and root.rise.max() > 0.5


@pytest.mark.slow
def test_a_body_that_starts_to_walk_down_sinks_gradually():
    clip = load_clip(CLIPS / "stop_and_go_base.npz").select(slice(90, 150))  # stands until 115
    ball, landing = clip.joints_ws(3)[:, 1, 2], 135 - 90
    animation = Animation(clip, terrain_of(flight([ball[landing] - 0.18], rise=-0.18)))
    solved = animation.solve(presets.stride())[1]
    sunk = (clip.positions_ws - solved.positions_ws)[:, clip.rig.pelvis, 1]
    assert np.diff(sunk).max() < 0.03 and sunk.max() > 0.1  # m in 1/30 s


def test_a_root_left_on_its_floor_is_named_as_the_cause(on_a_floor):
    animation = Animation(on_a_floor, terrain_of(hill()), root=AS_ANIMATED)
    placed = animation.place(on_a_floor)
    assert placed.measures.misplaced and placed.measures.penetration > 0.5
    cause = animation.cause(placed)
    assert cause is not None and cause.kind == "root"


@pytest.mark.parametrize("first, last", [(0.0, 0.5), (-0.04, 0.0)])
def test_a_clip_whose_feet_are_off_its_own_floor_is_named_as_the_cause(on_a_floor, first, last):
    uneven = raised(on_a_floor, np.linspace(first, last, on_a_floor.frame_count))
    animation = Animation(uneven, terrain.plane())
    cause = animation.cause(animation.place(uneven), presets.stride())
    assert cause is not None and cause.kind == "clip"
    assert cause.amount == pytest.approx(max(-first, last), abs=0.02)


def test_the_limit_that_refuses_a_step_is_named_with_a_value_that_accepts_it(on_a_floor):
    walk = edit.resample(edit.trim(on_a_floor, 0.0, 4.0), 30.0)
    steps = terrain_of(flight(edges_between_footfalls(walk, 4)[:2], rise=0.45))
    clip, root = place_root(walk, steps, "ground")
    animation = Animation(clip, steps, root=root)
    low = parameter_tree.replace(presets.record(clip.rig), {"probe.max_step_up": 0.1})

    def play(ik: jaxik.FootIK) -> measures.PlacedMotion:
        result, solved = animation.solve(ik)
        return animation.place(solved, result)

    refused = play(low)
    cause = animation.cause(refused, low)
    assert cause is not None and cause.kind == "limit"
    name, limit, accepted = cause.limit
    assert (name, limit) == ("probe.max_step_up", "0.1 m")
    assert f"{name} is {limit}, and feet stand on it with {accepted}" in cause.words
    accepting = parameter_tree.replace(low, {name: float(accepted.removesuffix(" m"))})
    raised = play(accepting)
    assert raised.measures.contact > refused.measures.contact + 0.1
    late = animation.cause(raised, accepting)
    assert late is not None and late.kind == "late" and late.amount < 0.45
    assert late.sentence.startswith("likely cause of the pop: rays met the step only once")
    pelvis = {"pop": raised.measures.worst["pop"]._replace(leg=measures.PELVIS)}
    body = replace(raised, measures=replace(raised.measures, worst=pelvis))
    of_body = animation.cause(body, accepting)
    assert of_body is not None and of_body.kind == "late" and of_body.amount >= late.amount
    assert animation.cause(raised) is None
    even = replace(raised.soles, ground=np.zeros_like(raised.soles.ground))
    assert animation.cause(replace(raised, soles=even), accepting) is None
    without_system = animation.cause(refused)
    assert without_system is not None and without_system.kind == "unknown"
    never = parameter_tree.replace(low, {name: 0.45, "leg.weight": 0.0})
    idle = animation.cause(play(never), never)
    assert idle is not None and idle.kind == "off" and idle.amount == 1.0


def test_a_system_with_a_root_rule_of_its_own_leaves_a_placed_root_alone(walk, monkeypatch):
    ground = terrain.plane(point=(0.0, 1.0, 0.0))
    clip, root = place_root(walk, ground, "ground")
    run = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(program_cache, "run", run)
    with pytest.raises(KeyboardInterrupt):
        Animation(clip, ground, root=root).solve(presets.ozz())
    assert not parameter_tree.get(run.call_args.args[0], "root.enabled")
