"""Footholds that nothing foretells: predicted from each swing so far, and from no later frame."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from jaxik.maths import parameter_tree
from jaxik.pipeline.frames import Clip
from jaxik.pipeline.phases import watch
from jaxik.stages.effector import DirectEffector
from jaxik.stages.fade import NoFade
from jaxik.stages.foot import KeepFoot
from jaxik.stages.inputs import Inputs
from jaxik.stages.lean import NoLean
from jaxik.stages.lock import NoLock
from jaxik.stages.probe.foresight import Foresight
from jaxik.stages.separation import NoSeparation
from jaxik.world.frame import Stride
from jaxik.world.terrain import Terrain
from reference import characters, maths
from reference.stages import foresight as reference
from support.cases import QUICK, RIG
from support.clips import assert_close, at, to_frames, to_rig, to_terrain
from support.gradients import finite_jacobian
from support.probing import level_blocks
from support.strides import walk

COUNT, HALF = 120, 60
BALL_HEIGHT = float(to_rig(RIG).ball_height[0])
START = (0.0, 0.0, -0.5)
PREDICTED = dataclasses.replace(  # with few rules beside its probe, so that it compiles soon
    parameter_tree.with_option(jaxik.presets.stride(foretold=False), "probe.limited", False),
    lean=NoLean(),
    lock=NoLock(),
    separation=NoSeparation(),
    effector=DirectEffector(),
    foot=KeepFoot(),
    fade=NoFade(),
)
PREDICTED = parameter_tree.replace(PREDICTED, {"probe.use_strides": False})
# Feet that land where they are predicted to.
AS_PREDICTED = parameter_tree.with_option(PREDICTED, "probe.slide_to_support", False)
NOTHING = jaxik.init(PREDICTED, to_rig(RIG)).probe
STEP = to_terrain(level_blocks((-3.0, 0.3, 0.0), (0.3, 3.0, 0.2)))

compiled = jax.jit(jaxik.run, compiler_options=QUICK)


def frames_of(speed: float = 0.9) -> jaxik.Frame:
    return to_frames(walk(RIG, COUNT, start=START, speed=speed))


def run(frames: jaxik.Frame, ground: Terrain = STEP) -> jaxik.Result:
    """Without slides to support, which make the program half as large again."""
    return compiled(AS_PREDICTED, to_rig(RIG), ground, frames)


def foreseen(
    ik: jaxik.FootIK, frames: jaxik.Frame, memory: Foresight = NOTHING, started: bool = False
) -> tuple[Foresight, Any]:
    """What the probe remembers, and the strides by which it goes, in each frame."""
    return resumed(ik, frames, memory, started)


@jax.jit
def resumed(
    ik: jaxik.FootIK, frames: jaxik.Frame, memory: Foresight, started: Any
) -> tuple[Foresight, Stride]:
    inputs = Inputs(to_rig(RIG), STEP, frames, jaxik.HARD)
    contacts = jax.vmap(lambda frame: ik.contact.sense(inputs.at(frame)))(frames)
    state = dataclasses.replace(jaxik.init(ik, to_rig(RIG)), started=started, probe=memory)
    return Clip(ik, inputs, state, None, {}).ahead("probe", watch, contacts, None)


@pytest.mark.slow
def test_nothing_changes_on_a_flat_floor():
    result = run(frames_of(), to_terrain(level_blocks((-3.0, 3.0, 0.0))))
    effector, sensed = result.trace.advanced.effector, result.trace.sensed
    assert_close(effector.target_ws, sensed.ankle_ws, 1e-9)
    assert np.abs(result.body.pos).max() < 1e-9


@pytest.mark.slow
def test_no_later_frame_is_read():
    """Whatever follows frame 70: another walk, at another speed, with other labels."""
    seen = 70
    first, other = frames_of(), frames_of(speed=0.5)
    mixed = jax.tree.map(lambda a, b: jnp.concatenate([a[:seen], b[seen:]]), first, other)
    (expected, with_slides), (got, others) = (
        (run(frames), foreseen(PREDICTED, frames)) for frames in (first, mixed)
    )
    pairs = jax.tree.leaves((expected, with_slides)), jax.tree.leaves((got, others))
    for a, b in zip(*pairs, strict=True):
        np.testing.assert_array_equal(a[:seen], b[:seen])
    later = np.abs(np.asarray(expected.pose.ankle.pos - got.pose.ankle.pos))[seen:]
    assert later.max() > 0.05


@pytest.mark.slow
def test_labelled_footholds_are_not_read():
    frames = frames_of()
    places = 0.0 * frames.stride.last_ws
    elsewhere = {"last_ws": places + 7.0, "next_ws": places - 7.0, "fraction": places[..., 0] + 0.3}
    other = dataclasses.replace(frames, stride=dataclasses.replace(frames.stride, **elsewhere))
    np.testing.assert_array_equal(run(other).pose.ankle.pos, run(frames).pose.ankle.pos)


@pytest.mark.slow
def test_footholds_that_are_known_are_as_without_memory():
    frames = frames_of()
    strides = foreseen(parameter_tree.replace(PREDICTED, {"probe.use_strides": True}), frames)[1]
    for field in dataclasses.fields(Stride):
        assert_close(getattr(strides, field.name), getattr(frames.stride, field.name), 1e-12)
    assert_close(strides.moved_ws, jnp.zeros_like(strides.moved_ws), 0.0)


def flickering(frame: characters.Frame, n: int) -> characters.Frame:
    """The frame with a contact that flickers at the end of each stance."""
    assert frame.stride is not None
    lifted = (n % 60 in (32, 34), n % 60 in (2, 4))  # stances last from 0 to 35 and from 30 to 65
    standing = np.where(lifted, 0.0, frame.stride.standing)
    return dataclasses.replace(frame, stride=dataclasses.replace(frame.stride, standing=standing))


def turning(frame: characters.Frame, n: int) -> characters.Frame:
    """The frame with a character that turns to and fro as it walks, and by 2 rad in a frame."""
    turn = maths.from_axis_angle(maths.Y, 0.5 * np.sin(n / 15) + 2.0 * (n >= 70))
    world = frame.world_from_model
    world = world._replace(rot=maths.multiply(turn, world.rot))
    return dataclasses.replace(frame, world_from_model=world)


def by_reference(
    frames: list[characters.Frame], times: dict[str, float]
) -> Iterator[tuple[tuple[int, int], reference.Swing, float, np.ndarray, np.ndarray]]:
    """For each frame and leg the memory after it, `regularity`, and last and next foothold."""
    before, regular = [], 0.0
    for n, frame in enumerate(frames):
        swings = [
            reference.follow(
                times,
                RIG,
                frame,
                leg,
                bool(frame.stride.standing[leg] > 0.5),
                maths.Y,
                BALL_HEIGHT,
                before[leg] if before else None,
                regular,
            )
            for leg in range(2)
        ]
        before = [swing for swing, *_ in swings]
        reference.take_first_steps(before)
        regular = reference.regularity(before)
        for leg, (swing, last, following) in enumerate(swings):
            yield (n, leg), swing, regular, last, following


def faster(frame: characters.Frame, factor: float, toes_up: float) -> characters.Frame:
    """The frame of a motion by a factor faster, below 0 backwards, with toes higher, rad."""
    velocity = factor * np.asarray(frame.travel_ws)
    up = maths.from_axis_angle(maths.X, -toes_up)
    ankle = frame.ankle._replace(rot=np.array([maths.multiply(up, x) for x in frame.ankle.rot]))
    return dataclasses.replace(frame, dt=frame.dt / abs(factor), velocity_ws=velocity, ankle=ankle)


@pytest.mark.parametrize(
    ("factor", "toes_up", "even"),
    [
        pytest.param(1.0, 0.0, False, id="walks"),
        pytest.param(1.0, 0.0, True, id="walks evenly"),
        pytest.param(1.0, 0.3, False, id="walks flat"),
        pytest.param(2.5, 0.0, False, id="nearly runs"),
        pytest.param(4.0, 0.0, False, id="runs"),
        pytest.param(4.0, 0.15, False, id="on the heels"),
        pytest.param(-0.25, 0.0, False, id="hardly back"),
        pytest.param(-1.0, 0.0, False, id="back"),
    ],
)
def test_memory_agrees_with_the_reference(factor, toes_up, even):
    """Also where a foot hardly leaves its foothold, while contact flickers, and in turns."""
    walked = walk(RIG, COUNT, start=START, heading=0.3)[:: int(np.sign(factor))]
    frames = [faster(frame, factor, toes_up) for frame in walked]
    if not even:
        frames = [turning(flickering(frame, n), n) for n, frame in enumerate(frames)]
    times = {"probe.stance_time": 0.6, "probe.swing_time": 0.5 / abs(factor)}
    ik = parameter_tree.replace(AS_PREDICTED, times)
    memory, stride = jax.tree.map(np.asarray, foreseen(ik, to_frames(frames)))
    swings, regularities = memory.swings, []
    for at_leg, swing, regular, last, following in by_reference(frames, times):
        regularities.append(regular)
        assert float(swings.fraction[at_leg]) == pytest.approx(swing.fraction, abs=1e-9)
        assert float(swings.time[at_leg]) == pytest.approx(swing.time, abs=1e-9)
        assert float(swings.further[at_leg]) == pytest.approx(swing.further, abs=1e-9)
        assert float(swings.swing_time[at_leg]) == pytest.approx(swing.usual, abs=1e-9)
        assert float(swings.lead[at_leg]) == pytest.approx(swing.lead, abs=1e-9)
        assert float(swings.missed[at_leg]) == pytest.approx(swing.missed, abs=1e-9)
        first = swings.first_way_ws, swing.first_way
        for got, wanted in (first, (stride.last_ws, last), (stride.next_ws, following)):
            np.testing.assert_allclose(got[at_leg][[0, 2]], wanted[[0, 2]], atol=1e-9)
    assert (max(regularities) > 0.9) == even


@pytest.mark.slow
def test_a_swing_goes_on_and_leads_nearer_and_nearer_to_its_foothold():
    frames = frames_of()
    memory, stride = jax.tree.map(np.asarray, foreseen(PREDICTED, frames))
    fraction, swinging = memory.swings.fraction, np.asarray(frames.stride.standing) < 0.5
    assert (np.diff(fraction, axis=0)[swinging[1:] & swinging[:-1]] >= 0).all()
    # Feet turn otherwise than people's.
    assert np.abs(fraction - np.asarray(frames.stride.fraction))[swinging].mean() < 0.15
    off = np.linalg.norm((stride.next_ws - frames.stride.next_ws)[..., [0, 2]], axis=-1)
    early, late = (off[swinging & (low <= fraction) & (fraction < high)].mean()
                   for low, high in ((0.2, 0.5), (0.8, 1.0)))  # fmt: skip
    assert late < 0.6 * early and early < 0.18 and late < 0.1


@pytest.mark.slow
def test_how_sure_a_swing_is_of_its_foothold_agrees_with_the_reference():
    """On a walk whose swings lead elsewhere by up to a third of their way."""
    frames = walk(RIG, COUNT, start=START)
    sure = np.asarray(foreseen(PREDICTED, to_frames(frames))[1].sure)
    times = {"probe.stance_time": 0.65, "probe.swing_time": 0.55}
    for at_leg, swing, regular, last, following in by_reference(frames, times):
        way = reference.across(following - last, maths.Y)
        expected = reference.sureness(swing, way, regular)
        assert float(sure[at_leg]) == pytest.approx(expected, abs=1e-6)
    assert ((sure > 0.05) & (sure < 0.95)).sum() > 5


@pytest.mark.slow
def test_a_clip_resumed_from_the_memory_of_one_of_its_frames_goes_on_as_the_whole():
    frames = frames_of()
    whole = foreseen(PREDICTED, frames)
    rest = at(frames, np.minimum(np.arange(HALF, HALF + COUNT), COUNT - 1))  # as many frames
    later = foreseen(PREDICTED, rest, at(whole[0], HALF - 1), started=True)
    assert_close(at(later, slice(HALF)), at(whole, slice(HALF, None)), 1e-12)


def next_footholds(times: jax.Array, velocity_ws: jax.Array, still: jax.Array) -> jax.Array:
    """Of a character that walks, or that stands still in the pose of the first frame."""
    names = ("probe.stance_time", "probe.swing_time")
    ik = parameter_tree.replace(AS_PREDICTED, dict(zip(names, times, strict=True)))
    frames = at(frames_of(), slice(20, 60, 2))
    frames = jax.tree.map(lambda x: jnp.where(still > 0, x[:1], x), frames)
    frames = dataclasses.replace(frames, velocity_ws=velocity_ws)
    return foreseen(ik, frames)[1].next_ws[::4]


@pytest.mark.slow
@pytest.mark.parametrize("moves", [True, False])
def test_strides_have_equal_and_finite_derivatives_in_forward_and_reverse_mode(moves):
    velocity_ws = moves * frames_of().velocity_ws[20:60:2]
    jacobian = finite_jacobian(next_footholds, np.array([0.65, 0.55]), velocity_ws, 1.0 - moves)
    assert (np.abs(jacobian[:, 1]).max() > 1e-3) == moves


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ahead", "slides"),
    [(-0.06, 0.0), (-0.02, -1.0), (0.01, 1.0), (0.05, 0.0), (0.3, 0.0)],
    ids=["before the step", "toes in the step", "toes over its edge", "ball over it", "on it"],
)
def test_a_foot_that_landed_where_hardly_anything_holds_it_slides_by_a_tenth(ahead, slides):
    """The foot comes from a swing, its ball so far ahead of the edge of the step, m."""
    frame = at(frames_of(), slice(0, 1))
    ball = frame.world_from_model.apply(frame.pose.toe.pos)[0, 0]
    moved = frame.translated(jnp.array([0.0, 0.0, 0.3 + ahead]) - ball * jnp.array([0.0, 0.0, 1.0]))
    frames = jax.tree.map(lambda x: jnp.repeat(x, 30, 0), moved)
    frames = dataclasses.replace(frames, velocity_ws=0.0 * frames.velocity_ws)
    moves = np.asarray(foreseen(PREDICTED, frames, started=True)[1].moved_ws)[:, 0, 2]
    assert abs(moves[0]) <= 0.2 * 0.026 * abs(slides)  # it sets out smoothly
    assert_close(moves[-1], 0.026 * slides, 1e-3)
