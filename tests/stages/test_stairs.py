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
from stairs.walks import SETTLED, STEPPED, Verdict, placed, solve, stepping, walked
from support.experiments import ROOT


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
@pytest.mark.parametrize(
    ("start", "least"),
    [
        pytest.param(SETTLED, Verdict(0.99, 0.985, 0.995, 0.955, 1.0), id="from the first stride"),
        pytest.param(STEPPED, Verdict(0.998, 0.998, 1.0, 0.99, 1.0), id="after a step"),
    ],
)
def test_feet_stand_on_treads_that_nothing_foretells(start, least):
    """On as many of 500 flights; a foot whose first step was seen knows how it steps."""
    rng = np.random.default_rng(0)
    chosen = [sample(rng, field=True) for _ in range(500)]
    ik = jaxik.presets.stride(foretold=False)
    verdicts = np.array([verdict for _, verdict in walked(ik, chosen, known=False, start=start)])
    assert ((verdicts <= np.array(BOUNDS)).mean(0) >= least).all()
    assert (verdicts[:, 1:4] <= [0.05, 0.06, 0.082]).all()


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False], ids=["foretold", "not foretold"])
def test_a_body_sinks_to_lower_stairs_no_faster_than_it_falls(known):
    """At 30 Hz, over its animation: captured pelves come to 1.2 g."""
    rng, falls = np.random.default_rng(0), []
    for flight in [sample(rng, field=True) for _ in range(60)]:
        frames, level = placed(flight)
        stride = replace(frames.stride, known=known * frames.stride.known)
        ik = jaxik.presets.stride(foretold=known)
        hip = solve(ik, flight, replace(frames, stride=stride)).hip[..., 1].mean(1)
        world, animated = level.world_from_model, np.asarray(level.pose.hip.pos)[..., 1].mean(1)
        rise = hip - animated - np.asarray(world.pos)[:, 1]
        bends = (rise[4:] - 2.0 * rise[2:-2] + rise[:-4]) * 30.0**2
        falls.append(-bends[SETTLED:-SETTLED].min() / 9.81)
    assert 0.5 < max(falls) < 1.4


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


def walked_back(clip: Clip) -> Clip:
    """The clip, played backwards."""
    return clip.select(np.s_[::-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "file", ["02_03.amc", "02_01.amc"], ids=["captured run", "captured walk backwards"]
)
def test_feet_of_captured_runners_and_of_walkers_back_stand_on_ground_that_nothing_foretells(
    mocap, file
):
    """Balls of the captured people are up to 2.6 cm off their own floor."""
    clip = load_clip(mocap / "clips/cmu_asfamc" / file)
    off = off_grounds(walked_back(clip) if file == "02_01.amc" else clip)
    assert off.mean() < 0.045 and off.max() < 0.12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clip", "mean"),
    [
        (lambda: actions.run(2.0), 0.015),
        (lambda: walked_back(walker.walk(4.0, 60.0, 1)), 0.015),
        (lambda: stepping(0.45, toe_off=0.0), 0.02),
        (lambda: load_clip(ROOT / "data/clips/stop_and_go_base.npz"), 0.02),
    ],
    ids=["run", "walk backwards", "level soles", "stop and go"],
)
def test_feet_of_other_gaits_stand_on_ground_that_nothing_foretells(clip, mean):
    off = off_grounds(clip())
    assert off.mean() < mean and off.max() < 0.07


def off_grounds(clip: Clip) -> np.ndarray:
    """`off_ground` of ten random grounds."""
    rng = np.random.default_rng(2)
    chosen = [grounds.sample(rng) for _ in range(16)]
    off = [off_ground(clip, x) for x in chosen if x.kind not in ("gaps", "roots")]
    assert len(off) == 10
    return np.array(off)
