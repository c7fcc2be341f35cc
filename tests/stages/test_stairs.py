"""Random flights of stairs, the quick sibling of `python -m stairs`, and a few other grounds."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxik
from fitting.clips import Clip, load_clip
from fitting.ground import ground_path
from fitting.studies.animations import Animation
from fitting.synthetic import actions, walker
from stairs import grounds
from stairs.__main__ import BOUNDS
from stairs.flights import Flight, field_of, sample
from stairs.walks import SETTLED, Verdict, walked


def beyond(chosen: Sequence[Flight]) -> list[tuple[Flight, Verdict]]:
    """Those on which a walk by `stride` is beyond its bounds."""
    verdicts = walked(jaxik.presets.stride(), chosen)
    return [pair for pair in verdicts if np.any(np.array(pair[1]) > BOUNDS)]


def test_feet_stand_on_treads_and_swing_in_one_arc_on_thirty_random_flights():
    """Heightfields alone, by the program of the suite; the program of stairs has meshes, too."""
    rng = np.random.default_rng(0)
    assert not beyond([sample(rng, field=True) for _ in range(30)])


def test_they_do_so_on_rubble_curbs_ledges_and_ramps():
    rng, kinds = np.random.default_rng(0), ("rubble", "curb", "ledge", "ramp")
    chosen = [ground for ground in (grounds.sample(rng) for _ in range(20)) if ground.kind in kinds]
    assert len(chosen) >= 10
    assert not beyond(chosen[:10])


@pytest.mark.slow
def test_feet_stand_on_treads_that_nothing_foretells():
    """From the first stride on; one walk of eight bends more, one of forty dips."""
    rng = np.random.default_rng(0)
    chosen = [sample(rng, field=True) for _ in range(500)]
    pairs = walked(jaxik.presets.stride(foretold=False), chosen, known=False)
    verdicts = np.array([verdict for _, verdict in pairs])
    share = (verdicts <= np.array(BOUNDS)).mean(0)
    assert (share >= Verdict(off=0.99, pop=0.96, dip=0.96, bend=0.85, sunk=1.0)).all()
    assert (verdicts[:, 1:4] <= [0.05, 0.06, 0.10]).all()


def off_ground(clip: Clip, ground: grounds.Ground) -> float:
    """How far the ball of a standing foot is off ground that nothing foretells, m, at most."""
    frames = fitting.frames_from_clip(clip)
    way = np.asarray(frames.world_from_model.pos)
    moves = np.tile([0.0, 0.0, -0.3 - way[:, 2].min()], (len(way), 1))
    moves[:, 1] = ground_path.smooth(ground.levels(way[:, 2] + moves[:, 2]), 0.35 * clip.fps)
    stride = replace(frames.stride, known=0.0 * frames.stride.known)
    frames = replace(frames.translated(jnp.asarray(moves)), stride=stride)
    animation = Animation(clip, field_of(ground.field_heights()), given_frames=frames)
    toe = animation.run(jaxik.presets.stride(clip.rig, foretold=False)).pose.toe
    ball = np.asarray(jax.vmap(jaxik.Transform.apply)(frames.world_from_model, toe.pos))
    soles = ball - np.asarray(clip.rig.ball_height)[:, None] * [0.0, 1.0, 0.0]
    off = np.maximum(*ground.clearances(soles))
    stands = np.asarray(stride.standing)[SETTLED:-SETTLED] > 0.5
    return off[SETTLED:-SETTLED][stands].max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "goes_back"),
    [("02_03.amc", False), ("02_01.amc", True), (None, False), (None, True)],
    ids=["captured run", "captured walk backwards", "run", "walk backwards"],
)
def test_feet_of_runners_and_of_walkers_back_stand_on_ground_that_nothing_foretells(
    request, file, goes_back
):
    """Balls of the captured people are up to 2.6 cm off their own floor."""
    if file is not None:
        clip = load_clip(request.getfixturevalue("mocap") / "clips/cmu_asfamc" / file)
    else:
        clip = walker.walk(4.0, 60.0, 1) if goes_back else actions.run(2.0)
    clip = clip.select(np.s_[::-1]) if goes_back else clip
    rng = np.random.default_rng(2)
    chosen = [grounds.sample(rng) for _ in range(16)]
    off = [off_ground(clip, x) for x in chosen if x.kind not in ("gaps", "roots")]
    assert len(off) == 10
    assert np.mean(off) < (0.015 if file is None else 0.04)
    assert max(off) < (0.06 if file is None else 0.12)
