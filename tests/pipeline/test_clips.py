"""A clip gives what one step after another gives, and so does a live character.

Whatever happens along it, and however long it is: legs and frames that cannot be used, pauses,
teleports, parameters that change (tracks), and clips that are computed in blocks. Gradients through
all of it are finite, those of forward mode, and none from before a restart.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.clips.clip_frames import frames_from_clip
from fitting.synthetic import walker
from jaxik.maths import parameter_tree
from jaxik.pipeline import character, packing
from jaxik.pipeline.frames import Tracks
from jaxik.stages.fade import SpeedFade
from jaxik.stages.root import GroundRoot
from jaxik.world import terrain
from support import cases, clips, singular
from support.cases import QUICK, Either
from support.clips import assert_close, at, to_ik, to_rig

HALF = 12
COUNT = 2 * HALF
EXACT = 1e-9
RIG, GROUND = to_rig(clips.make_rig()), clips.to_terrain(clips.planes((0.06, 0.04, 0.1)))
SYSTEM = parameter_tree.replace(
    dataclasses.replace(to_ik({}, "record as it comes"), root=GroundRoot(), fade=SpeedFade()),
    {"contact.planted_speed": 5.0, "contact.raised_speed": 9.0},
)


def floats_as(dtype: Any, tree: Any) -> Any:
    return jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


@functools.cache
def parts() -> list[jaxik.Frame]:
    """Two clips that have nothing to do with each other, of numbers that 32 bits can hold."""
    rngs = [np.random.default_rng(seed) for seed in (2, 5)]
    walks = [clips.to_frames(clips.wandering(clips.make_rig(), rng, HALF)) for rng in rngs]
    return floats_as(np.float64, floats_as(np.float32, jax.tree.map(np.asarray, walks)))


def joined(first: int, second: int, restart: bool = True) -> jaxik.Frame:
    """One of the clips after another, with a teleport between them."""
    frames = jax.tree.map(lambda *x: np.concatenate(x), parts()[first], parts()[second])
    return dataclasses.replace(frames, restart=restart & (np.arange(COUNT) == HALF))


def eventful() -> jaxik.Frame:
    """A clip with a teleport, a frame that cannot be used, a leg likewise, and a pause."""
    frames = jax.tree.map(np.copy, joined(0, 1))
    frames.world_from_model.pos[5, 0] = np.nan
    frames.weight[-3, 0] = np.inf
    frames.dt[8] = 0.0
    return frames


@functools.cache
def tracks() -> dict[str, np.ndarray]:
    """A parameter of the contact, of the body and of the pose, the last for each leg."""
    time = np.arange(COUNT) / COUNT
    return {
        "contact.raised_height": 0.02 + 0.2 * time,
        "pelvis.limit": 0.2 * time,
        "lean.spring": time > 0.5,
        "foot.max_pitch": np.stack([0.5 * time, 0.4 - 0.4 * time], axis=-1),
    }


def constant() -> dict[str, np.ndarray]:
    """The same parameters, as they are in the middle of the clip."""
    return {name: np.repeat(x[HALF:][:1], COUNT, axis=0) for name, x in tracks().items()}


@functools.partial(jax.jit, compiler_options=QUICK)
def resumed(frames: jaxik.Frame, tracks: Tracks) -> tuple[jaxik.State, jaxik.Result]:
    start = jaxik.init(SYSTEM, RIG)
    return jaxik.resume(SYSTEM, RIG, GROUND, start, frames, tracks=tracks)


def stepped(frames: jaxik.Frame, tracks: dict[str, np.ndarray]) -> tuple[Any, jaxik.Result]:
    """The clip by live characters, each with the system that the tracks make of ours.

    Those of other tests share their program.
    """
    state, results, single = None, [], floats_as(np.float32, frames)
    for index in range(COUNT):
        ik = parameter_tree.replace(SYSTEM, at(tracks, index))
        figure = jaxik.Character(ik, RIG, GROUND, state=state)
        results.append(figure.step(at(single, index)))
        state = figure.state
    return state, cases.stacked(results)


def test_steps_are_the_clip_through_faults_teleports_and_changing_parameters():
    state, result = resumed(eventful(), tracks())
    assert result.faulty.sum() == 3
    after, steps = stepped(eventful(), tracks())
    assert_close(steps, dataclasses.replace(result, trace=None), EXACT)
    assert_close(after, state, EXACT)
    unchanging = resumed(eventful(), constant())[1]
    assert np.abs(unchanging.pose.ankle.rot - result.pose.ankle.rot).max() > 0.01


def test_a_step_leaves_memory_of_the_kind_it_found_so_that_the_next_needs_no_new_program():
    step = functools.partial(jaxik.step, SYSTEM, RIG, GROUND)
    before = jaxik.init(SYSTEM, RIG)
    after, _ = jax.eval_shape(step, before, at(parts()[0], 0))
    old, new = (jax.tree.leaves(state) for state in (before, after))
    kinds = [[(x.shape, x.dtype, x.weak_type) for x in leaves] for leaves in (old, new)]
    assert kinds[0] == kinds[1]


def test_after_a_restart_nothing_is_remembered():
    first, second = joined(0, 1), joined(1, 0)
    there = at(resumed(first, constant())[1], slice(HALF, None))
    begun = at(resumed(second, constant())[1], slice(HALF))
    assert_close(there, begun, EXACT)
    remembered = resumed(joined(0, 1, restart=False), constant())[1].pose.ankle.pos[HALF:]
    assert np.abs(remembered - there.pose.ankle.pos).max() > 1e-3


@pytest.mark.slow
def test_a_clip_in_blocks_of_checked_frames_equals_the_clip_as_a_whole():
    """Nothing is looked at in checked frames, so that none is faulty whatever it holds."""
    awake = {"contact.idle_speed": 10.0, "effector.latch": False}
    ik = parameter_tree.replace(jaxik.presets.unreal(), awake)
    run, step = (
        jax.jit(call, static_argnames=("checked", option), compiler_options=QUICK)
        for call, option in ((jaxik.run, "block"), (jaxik.step, "trace"))
    )
    blocks = functools.partial(run, ik, RIG, GROUND, block=7, checked=True)
    speeds = {"effector.speed": np.linspace(1.0, 9.0, COUNT)}
    expected = run(ik, RIG, GROUND, joined(0, 1), tracks=speeds)
    assert_close(blocks(joined(0, 1), tracks=speeds), expected, EXACT)
    assert not blocks(eventful(), tracks=speeds).faulty.any()
    first = parameter_tree.replace(ik, at(speeds, 0)), RIG, GROUND, jaxik.init(ik, RIG)
    begin = functools.partial(step, *first, checked=True, trace=True)
    assert_close(begin(at(joined(0, 1), 0))[1], at(expected, 0), EXACT)
    assert not begin(at(eventful(), 5))[1].faulty.any()


# Live characters.


LIVE = parameter_tree.replace(SYSTEM, at(constant(), 0))


@functools.cache
def frames() -> list[jaxik.Frame]:
    """With floats of 32 bits, while characters compute with the 64 of their rig."""
    clip = floats_as(np.float32, joined(0, 1))
    return [at(clip, index) for index in range(6)]


@functools.cache
def followed() -> tuple[list[jaxik.State], list[jaxik.Result]]:
    """Memory before each of these frames, and the results of a clip that begins with them."""
    result = jax.device_get(resumed(joined(0, 1), constant())[1])
    memory, untraced = result.trace.advanced.state, dataclasses.replace(result, trace=None)
    states = [jaxik.init(LIVE, RIG), *(at(memory, index) for index in range(6))]
    return states, [at(untraced, index) for index in range(6)]


def assert_same(ours, theirs) -> None:
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_allclose(x, y, rtol=0, atol=EXACT)


@pytest.mark.parametrize("start", [None, 3])
def test_a_character_moves_as_the_clip_and_keeps_its_memory(start):
    states, results = followed()
    memory = None if start is None else states[start]
    figure = jaxik.Character(LIVE, RIG, GROUND, state=memory)
    for frame, expected in list(zip(frames(), results, strict=True))[start:]:
        assert_same(figure.step(frame), expected)
    assert_same(figure.state, states[-1])


def test_results_are_numpy_arrays_that_later_steps_leave_alone_and_frames_may_be_jax_arrays():
    figure = jaxik.Character(LIVE, RIG, GROUND)
    first = figure.step(jax.tree.map(jnp.asarray, frames()[0]))
    figure.step(frames()[3])
    assert_same(first, followed()[1][0])
    leaves = jax.tree.leaves(first)
    assert all(isinstance(x, np.ndarray) and not x.flags.writeable for x in leaves)


def test_characters_with_other_numbers_share_a_program():
    result = jaxik.Character(LIVE, RIG, GROUND).step(frames()[0])
    compiled = character._step._cache_size()  # pyright: ignore[reportAttributeAccessIssue]
    steep = clips.to_terrain(clips.planes((0.3, 0.0, 0.0)))
    other = jaxik.Character(LIVE, RIG, steep).step(frames()[0])
    assert character._step._cache_size() == compiled  # pyright: ignore[reportAttributeAccessIssue]
    assert np.abs(result.pose.ankle.pos - other.pose.ankle.pos).max() > 0.01


def test_a_frame_of_another_shape_is_refused_by_name():
    figure = jaxik.Character(LIVE, RIG, GROUND)
    figure.step(frames()[0])
    with pytest.raises(ValueError, match=r"frame\.weight has shape \(3,\), wanted \(2,\)"):
        figure.step(dataclasses.replace(frames()[0], weight=np.ones(3)))
    assert_same(figure.step(frames()[1]), followed()[1][1])


def test_packing_keeps_types_and_leaves_large_arrays_as_they_are():
    large = jnp.arange(packing.LARGE + 1, dtype=jnp.float32)
    tree = {
        "flag": jnp.asarray(True),
        "large": large.reshape(-1, 1),
        "number": jnp.asarray(3, jnp.uint32),
        "none": None,
        "empty": jnp.zeros((0, 3)),
        "vectors": [jnp.arange(6.0).reshape(2, 3), jnp.asarray(2.0)],
    }
    packed = packing.pack(tree)
    assert len(packed.vectors) == 4
    assert any(vector is tree["large"] for vector in packed.vectors)
    assert_same(packed.unpack(), tree)
    assert_same(jax.jit(lambda x: packing.pack(x.unpack()))(packed).unpack(), tree)
    assert packing.pack(tree).layout is packed.layout


# Gradients.


@functools.partial(jax.jit, compiler_options=QUICK)
@jax.vmap
def both_modes(
    inputs: Any, tangents: Any, present: jax.Array, blurred: jax.Array, from_frame: jax.Array
) -> Any:
    """The derivative of a sum of all outputs along a way, and its gradient, rig included."""
    rig = dataclasses.replace(RIG, present=present)
    floats, rest = eqx.partition((*inputs, rig), eqx.is_inexact_array)

    def everything(floats: Any) -> jax.Array:
        ik, ground, frames, rig = eqx.combine(floats, rest)
        start = jaxik.init(ik, rig)
        result = jaxik.resume(ik, rig, ground, start, frames, Either(blurred))[1]
        outputs = result.pose, result.body, result.trace.advanced.state
        late = jnp.arange(COUNT) >= from_frame
        return cases.total(jax.tree.map(lambda x: (late * x.T).T, outputs))

    along = jax.linearize(everything, floats)[1]
    still = jax.tree.map(jnp.zeros_like, floats[-1])
    gradient = jax.linear_transpose(along, floats)(jnp.ones(()))[0]
    return along((*tangents, still)), gradient


def gradient_rows(system: str) -> list[singular.Row]:
    """The eventful clip, and those where formulas are singular: rows of one batch."""
    inputs = singular.inputs_of(system, singular.Situation(eventful(), GROUND))
    rows = [singular.Row("eventful", inputs, None, blurred=True)]
    for row in singular.singular_rows(system):
        frames = at(row.inputs[2], slice(COUNT))
        frames = dataclasses.replace(frames, restart=np.zeros(COUNT, bool))
        tangents = *row.tangents[:2], at(row.tangents[2], slice(COUNT))
        rows.append(row._replace(inputs=(*row.inputs[:2], frames), tangents=tangents))
    still = jax.tree.map(np.zeros_like, rows[1].tangents)
    return [rows[0]._replace(tangents=still), *rows[1:]]


@pytest.mark.slow
@pytest.mark.parametrize("system", ["record", "ozz", "unreal", "mec", "stride"])
def test_gradients_are_finite_those_of_forward_mode_and_stop_at_a_restart(system: str):
    rows = gradient_rows(system)
    inputs, tangents = (cases.stacked(x) for x in zip(*(row[1:3] for row in rows), strict=True))
    modes = [np.array([getattr(row, name) for row in rows]) for name in ("present", "blurred")]
    from_frame = np.array([HALF] + [0] * (len(rows) - 1))
    slopes, gradients = jax.device_get(both_modes(inputs, tangents, *modes, from_frame))
    of_root = gradients[2].world_from_model.pos[0]
    assert np.abs(of_root[HALF:]).max() > 0.01
    np.testing.assert_array_equal(of_root[:HALF], 0.0)
    for index, row in enumerate(rows):
        gradient = at(gradients, index)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
            assert np.isfinite(leaf).all(), (str(row), jax.tree_util.keystr(path))
        if system == "stride" and row.name == "hardly any velocity":
            continue  # the time ahead changes by 1e24 s for each m/s, and both modes round
        pairs = zip(jax.tree.leaves(gradient[:-1]), jax.tree.leaves(row.tangents), strict=True)
        parts = [np.sum(leaf * tangent) for leaf, tangent in pairs]
        exact = {"rtol": 1e-9, "atol": 1e-9 * np.abs(parts).max()}
        np.testing.assert_allclose(sum(parts), slopes[index], err_msg=str(row), **exact)


# Long clips.


@functools.cache
def walk() -> tuple[jaxik.Rig, jaxik.Frame]:
    clip = walker.walk(3.0, 60.0, seed=4)
    return clip.rig, frames_from_clip(clip)


def repeated(count: int) -> jaxik.Frame:
    """The walk repeated to `count` frames; it jumps at each repetition."""
    return jax.tree.map(lambda leaf: leaf[jnp.arange(count) % leaf.shape[0]], walk()[1])


def summed(height: jax.Array, frames: jaxik.Frame, block: int | None = None) -> jax.Array:
    """Of a clip on a slope that begins at a height, a number with a derivative."""
    slope = terrain.plane(point=jnp.stack([0.0, height, 0.0]), normal=(0.1, 1.0, 0.05))
    result = jaxik.run(jaxik.presets.mec(faithful=True), walk()[0], slope, frames, block=block)
    return jnp.sum(result.pose.knee.pos**2)


@pytest.mark.slow
def test_reverse_mode_works_through_blocks_and_keeps_one_in_memory():
    short, long = (
        jax.jit(lambda height, frames: jax.grad(summed)(height, frames, 32))
        .lower(0.02, repeated(count))
        .compile(QUICK)
        for count in (128, 1024)
    )
    beside = jax.jit(summed)
    above, below = (beside(0.02 + step, repeated(128)) for step in (1e-6, -1e-6))
    slope = short(0.02, repeated(128))
    assert abs(slope) > 0.1
    np.testing.assert_allclose(slope, (above - below) / 2e-6, rtol=1e-6)
    small, large = (x.memory_analysis().temp_size_in_bytes for x in (short, long))
    assert large < 2 * small


@pytest.mark.slow
def test_a_hundred_thousand_frames_in_single_precision_stay_accurate():
    """Within a tenth of a millimetre."""
    ground = terrain.plane(normal=(0.1, 1.0, 0.05))
    inputs = (jaxik.presets.record(), walk()[0], ground, repeated(100_000))
    wide = jaxik.run(*inputs, block=5000)
    narrow = jaxik.run(*floats_as(np.float32, inputs), block=5000)
    for name in ("hip", "knee", "ankle", "toe"):
        places, rough = (np.asarray(getattr(x.pose, name).pos) for x in (wide, narrow))
        assert rough.dtype == np.float32
        assert np.linalg.norm(rough - places, axis=-1).max() < 1e-4
    lifted = np.asarray(wide.body.pos) - np.asarray(narrow.body.pos)
    assert np.linalg.norm(lifted, axis=-1).max() < 1e-4
